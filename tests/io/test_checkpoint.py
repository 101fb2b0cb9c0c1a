"""Checkpoints: what comes back, and what is refused."""

import contextlib
import dataclasses
import json
import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tensorstore
from flax import struct

from csac_jax import presets
from csac_jax.errors import DataWarning
from csac_jax.evaluation import policies
from csac_jax.io import checkpoint, files
from csac_jax.io.checkpoint import CheckpointError

CFG = presets.smoke()


class Moments(NamedTuple):
    mean: jax.Array
    count: jax.Array


@struct.dataclass
class State:
    key: jax.Array
    keys: jax.Array
    step: jax.Array
    moments: tuple[Moments, tuple[()]]
    params: dict[str, jax.Array]


def _state(seed: int = 0) -> State:
    """Returns a state with keys, nested containers, small dtypes and NaN."""
    key = jax.random.key(seed)
    drawn = np.random.default_rng(seed)
    return State(
        key=key,
        keys=jax.random.split(jax.random.fold_in(key, 1), 3),
        step=jnp.int32(seed),
        moments=(Moments(jnp.asarray(drawn.normal(size=(3, 5)), jnp.float32), jnp.uint8(200)), ()),
        params={
            "w.x": jnp.asarray(drawn.normal(size=4), jnp.bfloat16),
            "b": jnp.array([True, False]),
            "nan": jnp.array([jnp.nan, -0.0], jnp.float32),
            "heights": jnp.asarray(drawn.integers(0, 2**16, (2, 64, 64)), jnp.uint16),
        },
    )


def _bits(leaf: jax.Array) -> tuple[str, tuple[int, ...], bytes]:
    is_key = jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    raw = jax.random.key_data(leaf) if is_key else leaf
    return str(leaf.dtype), leaf.shape, np.asarray(raw).tobytes()


def _same(a: State, b: State) -> bool:
    bits = [list(map(_bits, jax.tree.leaves(tree))) for tree in (a, b)]
    return jax.tree.structure(a) == jax.tree.structure(b) and bits[0] == bits[1]


def _abstract(seed: int = 0) -> State:
    return jax.eval_shape(lambda: _state(seed))


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    """A run with checkpoints of steps 4 and 8."""
    for step in (4, 8):
        checkpoint.save(tmp_path, step, _state(step), CFG, {"seconds": step / 2, "grasps": [0, 1]})
    return tmp_path


def _data_file(run_dir: Path, step: int) -> Path:
    """Returns the largest file of a step: array data."""
    paths = (run_dir / "checkpoints" / str(step) / "state").rglob("*")
    return max(filter(Path.is_file, paths), key=lambda path: path.stat().st_size)


def test_state_comes_back_bit_for_bit(run_dir: Path):
    """Claim: every leaf comes back with its bits, dtype and place; keys are typed keys again."""
    state, extra = checkpoint.restore(run_dir, _abstract())
    assert _same(state, _state(8))
    assert not _same(state, _state(4))
    assert extra == {"seconds": 4.0, "grasps": [0, 1]}
    assert jax.random.bits(state.key) == jax.random.bits(_state(8).key)


def test_last_two_are_kept(run_dir: Path):
    """Claim: the last two steps are kept."""
    checkpoint.save(run_dir, 12, _state(12), CFG, {})
    names = {path.name for path in (run_dir / "checkpoints").iterdir()}
    assert {name for name in names if name.isdigit()} == {"8", "12"}
    assert checkpoint.latest_step(run_dir) == 12


@pytest.mark.parametrize("name", ["checkpoints", "set-aside", ".saving", "2", "12"])
def test_links_are_not_followed(run_dir: Path, tmp_path_factory: pytest.TempPathFactory, name: str):
    """Claim: a link among a run's checkpoints is refused, or replaced, and its target stays."""
    other, root = tmp_path_factory.mktemp("other"), run_dir / "checkpoints"
    checkpoint.save(other, 3, _state(3), CFG, {})
    (other / "checkpoints" / "run").unlink()  # an old one, which no name gives away
    place, target = root / name, other / "checkpoints" / "3"
    if name == "checkpoints":
        place, target = root, other / "checkpoints"
        root.rename(run_dir / "away")
    place.symlink_to(target)
    before = [(path, path.read_bytes()) for path in sorted(other.rglob("*")) if path.is_file()]
    with contextlib.suppress(files.LinkError):
        checkpoint.save(run_dir, 12, _state(12), CFG, {})
        checkpoint.set_aside_after(run_dir, 8)
        checkpoint.remove(run_dir)
    after = [(path, path.read_bytes()) for path in sorted(other.rglob("*")) if path.is_file()]
    assert after == before
    assert place.is_symlink() == (name in ("checkpoints", "set-aside"))


@pytest.mark.parametrize("name", ["a*", "a?", "[a]", "a\\b", "a\udcff"])
def test_paths_that_orbax_misreads_are_refused(tmp_path: Path, name: str):
    """Claim: a path with a sign of a pattern, or that is no UTF-8, is refused in one line."""
    checkpoint.check_path(tmp_path / "a b")
    with pytest.raises(CheckpointError, match="no checkpoint can be saved in a path with"):
        checkpoint.check_path(tmp_path / name)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda step: (step / "extra" / "metadata").write_text("{}"), "is no checkpoint of csac"),
        (lambda step: (step / "state" / "manifest.ocdbt").write_text("x"), "cannot be read"),
    ],
)
def test_sound_files_of_another_program_are_refused(
    run_dir: Path, damage: Callable[[Path], None], message: str
):
    """Claim: files whose digests are right and whose content is another's are one line."""
    step = run_dir / "checkpoints" / "8"
    damage(step)
    files.write_json(step / checkpoint.MANIFEST, {})
    files.write_json(step / checkpoint.MANIFEST, checkpoint._digests(step))
    with pytest.raises(CheckpointError, match=message) as caught:
        checkpoint.restore(run_dir, _abstract(), 8)
    assert "\n" not in str(caught.value)


def test_temporary_folders_are_removed(run_dir: Path):
    """Claim: what a killed save left behind is no step, and the next save removes it."""
    left = run_dir / "checkpoints" / "10.orbax-checkpoint-tmp"
    left.mkdir()
    assert checkpoint.latest_step(run_dir) == 8
    assert _same(checkpoint.restore(run_dir, _abstract())[0], _state(8))
    assert left.exists()  # a reader leaves a running writer alone
    checkpoint.save(run_dir, 12, _state(12), CFG, {})
    assert not left.exists()


def _falls_back(run_dir: Path, message: str) -> None:
    """Checks that step 8 is refused with this message, and step 4 restored with a warning."""
    with pytest.raises(CheckpointError, match=rf"8 {message}.*; saved are: 4") as caught:
        checkpoint.restore(run_dir, _abstract(), 8)
    assert "\n" not in str(caught.value)
    with pytest.warns(DataWarning, match=rf"8 {message}.*; going back to step 4"):
        state, _ = checkpoint.restore(run_dir, _abstract())
    assert _same(state, _state(4))
    with pytest.warns(DataWarning, match="going back to step 4"):
        assert checkpoint.load_config(run_dir) == CFG


def test_a_step_that_is_saved_again_is_never_away(run_dir: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: a save of a step that exists removes no sound copy of it, even where it fails."""

    def fail(_: Path, __: Path) -> None:
        raise OSError("no space")

    with monkeypatch.context() as patched:
        patched.setattr(Path, "rename", _failing_from(".saving", Path.rename, fail))
        with pytest.raises(CheckpointError, match="could not be saved"):
            checkpoint.save(run_dir, 8, _state(8), CFG, {})
    checkpoint.save(run_dir, 12, _state(12), CFG, {})  # which clears what a save has left
    assert (run_dir / "checkpoints" / checkpoint.SET_ASIDE / "8" / checkpoint.MANIFEST).exists()


@pytest.mark.parametrize("lost", [".zarray", "0"])
def test_what_orbax_left_out_is_no_checkpoint(
    run_dir: Path, monkeypatch: pytest.MonkeyPatch, lost: str
):
    """Claim: where a part of an array is not there after a save that raised nothing, it is no
    checkpoint, and those before stay."""
    save, found = checkpoint.ocp.Checkpointer.save, checkpoint.latest_step(run_dir)

    def save_less(self: Any, folder: Path, *given: Any, **named: Any) -> None:
        save(self, folder, *given, **named)
        spec = {"driver": "ocdbt", "base": {"driver": "file", "path": f"{folder / 'state'}/"}}
        store = tensorstore.KvStore.open(spec).result()
        part = next(key for key in store.list().result() if key.split(b"/")[-1] == lost.encode())
        store.write(part, None).result()

    monkeypatch.setattr(checkpoint.ocp.Checkpointer, "save", save_less)
    with pytest.raises(CheckpointError, match="was not written"):
        checkpoint.save(run_dir, 99, _state(99), CFG, {})
    assert checkpoint.latest_step(run_dir) == found


def test_threads_that_write_on_leave_no_draft(run_dir: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: what Orbax's threads still write after a save has failed is removed too."""
    late = run_dir / "checkpoints" / ".saving.orbax-checkpoint-tmp" / "state"

    def write() -> None:
        for _ in range(3):
            time.sleep(0.3)
            late.mkdir(parents=True, exist_ok=True)

    writer = threading.Thread(target=write)

    def fail(*_: Any, **__: Any) -> None:
        writer.start()
        raise OSError("no space left")

    monkeypatch.setattr(checkpoint.ocp.Checkpointer, "save", fail)
    with pytest.raises(CheckpointError, match="no space left"):
        checkpoint.save(run_dir, 99, _state(99), CFG, {})
    writer.join()
    assert not late.parent.exists()


def _failing_from(name: str, call: Any, fail: Any) -> Any:
    """Returns `call`, or `fail` for a first argument of this name."""
    return lambda path, target: (fail if path.name == name else call)(path, target)


def test_steps_of_others_are_seen(run_dir: Path, tmp_path_factory: pytest.TempPathFactory):
    """Claim: the whole folder of another run's step, or of another step, is not restored."""
    other = tmp_path_factory.mktemp("other")
    checkpoint.save(other, 8, _state(8), CFG, {})
    steps = run_dir / "checkpoints"
    (steps / "8").rename(steps / "12")
    shutil.copytree(other / "checkpoints" / "8", steps / "8")
    _falls_back(run_dir, "is another run's")
    with pytest.raises(CheckpointError, match="12 is that of step 8"):
        checkpoint.restore(run_dir, _abstract(), 12)


def test_earlier_step_is_chosen(run_dir: Path):
    """Claim: an earlier step is restored where it is asked for; one that was not saved is refused
    with those that were."""
    assert _same(checkpoint.restore(run_dir, _abstract(), 4)[0], _state(4))
    with pytest.raises(CheckpointError, match=r"5 is missing.*saved are: 4, 8"):
        checkpoint.restore(run_dir, _abstract(), 5)


def test_damaged_step_is_set_aside(run_dir: Path):
    """Claim: a run that goes on from an older step moves the damaged one out of the way, whole."""
    _data_file(run_dir, 8).unlink()
    with pytest.warns(DataWarning, match="going back to step 4"):
        checkpoint.set_aside_after(run_dir, int(checkpoint.sound(run_dir).name))
    assert (run_dir / "checkpoints" / checkpoint.SET_ASIDE / "8" / checkpoint.MANIFEST).is_file()
    assert _same(checkpoint.restore(run_dir, _abstract())[0], _state(4))


@pytest.mark.parametrize("name", ["csac-jax", "jax", "mujoco"])
def test_other_versions_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str):
    """Claim: a checkpoint of another version of the package, JAX or MuJoCo comes back with a
    warning that names both versions."""
    here = checkpoint.provenance.versions()
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint.provenance, "versions", lambda: {**here, name: "0.0.1"})
        checkpoint.save(tmp_path, 4, _state(4), CFG, {})
    with pytest.warns(DataWarning, match=rf"with {name} 0\.0\.1, this is {here[name]}"):
        assert _same(checkpoint.restore(tmp_path, _abstract())[0], _state(4))


def test_no_sound_step_is_left(run_dir: Path, tmp_path_factory: pytest.TempPathFactory):
    """Claim: without a sound step, or without any, the message says so."""
    for step in (4, 8):
        _data_file(run_dir, step).unlink()
    with pytest.raises(CheckpointError, match="train again"):
        checkpoint.restore(run_dir, _abstract())
    empty = tmp_path_factory.mktemp("empty")
    assert checkpoint.latest_step(empty) is None
    with pytest.raises(CheckpointError, match="there is no checkpoint under"):
        checkpoint.load_config(empty)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"step": jax.ShapeDtypeStruct((), jnp.float32)}, r"as int32\[\], .* needs float32\[\]"),
        ({"step": jax.ShapeDtypeStruct((2,), jnp.int32)}, r"as int32\[\], .* needs int32\[2\]"),
        ({"params": {"b": jax.ShapeDtypeStruct((2,), jnp.bool_)}}, "the program needs nothing"),
        ({"moments": (jax.ShapeDtypeStruct((), jnp.int32),)}, r"moments\.0 as nothing"),
        ({"key": jax.eval_shape(lambda: jax.random.key(0, impl="rbg"))}, r"key as key<fry>\[\]"),
    ],
)
def test_other_dtype_or_shape_is_refused(run_dir: Path, change: dict[str, Any], message: str):
    """Claim: a leaf of another dtype or shape, one too many or too few is an error, not a cast."""
    with pytest.raises(CheckpointError, match=message):
        checkpoint.restore(run_dir, dataclasses.replace(_abstract(), **change))


def test_config_of_another_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: a config with a setting that this version does not know is an error that names it."""
    good = checkpoint.configs.to_dict
    monkeypatch.setattr(checkpoint.configs, "to_dict", lambda cfg: {**good(cfg), "sweep": 1})
    folder = checkpoint.save(tmp_path, 4, _state(4), CFG, {})
    assert json.loads((folder / checkpoint.MANIFEST).read_text())
    with pytest.raises(CheckpointError, match=r"another version.*sweep: unknown setting"):
        checkpoint.load_config(tmp_path)


def test_a_run_acts_whatever_its_replay_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: of a run with another value of a former setting of the replay the policy's config
    loads; to resume it is refused by the setting's name."""
    stored = checkpoint.configs.to_dict(CFG)
    stored["replay"] |= {"rank_by": "reward"}
    monkeypatch.setattr(checkpoint.configs, "to_dict", lambda _: stored)
    checkpoint.save(tmp_path, 4, _state(4), CFG, {})
    assert policies.load_config(tmp_path) == CFG
    with pytest.raises(CheckpointError, match=r"replay\.rank_by: must be 'error'"):
        checkpoint.load_config(tmp_path)
