"""Checkpoints: the whole training state, the config and a little JSON, a folder for each step.

    RUN/checkpoints/STEP/state/...        arrays, by Orbax
    RUN/checkpoints/STEP/config, extra    JSON, by Orbax
    RUN/checkpoints/STEP/manifest.sha256  digest of every file above, written last

Orbax makes a step's folder appear all at once, but restores flipped bits and casts other dtypes
silently. So every file is checked against the manifest, and every leaf's shape and dtype against
what the program expects. A step that fails is an error, never a reason to take an older one.
"""

import hashlib
import json
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp
from orbax.checkpoint.checkpoint_managers import LatestN

from csac_jax.config import Config
from csac_jax.errors import FailedError
from csac_jax.io import configs, files, leaves, renames
from csac_jax.runtime import cluster

FOLDER = "checkpoints"
MANIFEST = "manifest.sha256"
KEPT = 2


class CheckpointError(FailedError):
    """A checkpoint that is missing, damaged or another program's; the message has the remedy."""


def save(run_dir: Path, step: int, state: Any, cfg: Config, extra: dict[str, Any]) -> Path:
    """Writes `state` (a pytree of arrays and typed keys) as `step`; returns once it is complete.
    The last two are kept.

    Temporary folders that a killed process left are removed. `extra` is anything that JSON can
    hold. With several processes all must call it.
    """
    arrays = {name: _untyped(leaf) for name, leaf in leaves.named(state).items()}
    record = {"layout": leaves.layout(state), "extra": extra}
    folder = _root(run_dir) / str(step)
    with _manager(run_dir, writes=True) as manager:
        items = ocp.args.Composite(
            state=ocp.args.StandardSave(arrays),
            config=ocp.args.JsonSave(configs.to_dict(cfg)),
            extra=ocp.args.JsonSave(record),
        )
        manager.save(step, args=items)
        manager.wait_until_finished()  # a failed save raises here
    cluster.wait(f"saved {folder}")
    if cluster.is_first():
        files.write_json(folder / MANIFEST, _digests(folder))
    cluster.wait(f"manifest of {folder}")
    return folder


def latest_step(run_dir: Path) -> int | None:
    """The newest step that was saved under `run_dir`, sound or not; None if there is none."""
    return max(_steps(run_dir), default=None)


def load_config(run_dir: Path) -> Config:
    """The config of the newest checkpoint."""
    folder = _newest(run_dir)
    stored = _read(run_dir, folder, config=ocp.args.JsonRestore())
    try:
        return configs.from_dict(stored["config"])
    except ValueError as error:
        raise CheckpointError(
            f"checkpoint {folder} was made by another version of csac_jax ({error}); "
            "use that version or train again"
        ) from error


def restore(run_dir: Path, abstract_state: Any) -> tuple[Any, dict[str, Any]]:
    """State and `extra` of the newest step, as they were given to `save`.

    `abstract_state` has the state's structure, shapes and dtypes, as `jax.eval_shape` gives them. A
    leaf that has a sharding is laid out by it, however it was when it was saved; the others go to
    the first device.
    """
    folder = _newest(run_dir)
    record = _read(run_dir, folder, extra=ocp.args.JsonRestore())["extra"]
    wanted, layout = leaves.named(abstract_state), leaves.layout(abstract_state)
    old = {name: _old_name(name, record["layout"]) for name in wanted}
    found = leaves.difference(record["layout"], {old[name]: layout[name] for name in wanted})
    if found is not None:
        name, has, needs = found
        raise CheckpointError(
            f"checkpoint {folder} holds {name} as {has}, the program needs {needs}; "
            "use the version of csac_jax that saved it"
        )
    arrays = {old[name]: _abstract_array(leaf) for name, leaf in wanted.items()}
    arrays = _read(run_dir, folder, state=ocp.args.StandardRestore(arrays))["state"]
    state = [_typed(arrays[old[name]], leaf) for name, leaf in wanted.items()]
    return jax.tree.unflatten(jax.tree.structure(abstract_state), state), record["extra"]


def _root(run_dir: Path) -> Path:
    return Path(run_dir).resolve() / FOLDER


def _manager(run_dir: Path, writes: bool) -> ocp.CheckpointManager:
    options = ocp.CheckpointManagerOptions(
        create=writes,
        cleanup_tmp_directories=writes,  # a reader must leave a running writer alone
        preservation_policy=LatestN(KEPT),
        enable_async_checkpointing=False,
    )
    return ocp.CheckpointManager(_root(run_dir), options=options)


def _read(run_dir: Path, folder: Path, **items: Any) -> Any:
    with _manager(run_dir, writes=False) as manager:
        return manager.restore(int(folder.name), args=ocp.args.Composite(**items))


def _steps(run_dir: Path) -> list[int]:
    """Saved steps, the oldest first."""
    return sorted(int(path.name) for path in _root(run_dir).glob("*") if path.name.isdigit())


def _old_name(name: str, layout: dict[str, str]) -> str:
    """Name of a leaf in a checkpoint of this layout, which may be an older one."""
    older = {new: old for old, new in renames.STATE.items()}
    return name if name in layout else older.get(name, name)


# Orbax gets a flat dict of plain arrays; typed keys travel as their bits.


def _is_key(leaf: Any) -> bool:
    return jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _untyped(leaf: Any) -> Any:
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _abstract_array(leaf: Any) -> jax.ShapeDtypeStruct:
    place = leaf.sharding or jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    array = jax.eval_shape(_untyped, leaf)
    return jax.ShapeDtypeStruct(array.shape, array.dtype, sharding=place)


def _typed(array: Any, leaf: Any) -> Any:
    """An array as it was saved, a key again if the abstract leaf is one."""
    if not _is_key(leaf):
        return array
    impl = jax.random.key_impl(jax.lax.full((), 0, leaf.dtype))
    return jax.random.wrap_key_data(array, impl=impl)


def _digests(folder: Path) -> dict[str, str]:
    """SHA-256 of each file of a step but the manifest."""
    digests = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.name != MANIFEST:
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            digests[path.relative_to(folder).as_posix()] = digest
    return digests


def _fault(folder: Path) -> str | None:
    """What is wrong with the files of a step, None if nothing is."""
    try:
        wanted = json.loads((folder / MANIFEST).read_text())
    except FileNotFoundError:
        return "is half-written (it has no manifest)"
    except ValueError:
        return "is damaged (its manifest cannot be read)"
    found = _digests(folder)
    for name in sorted(wanted.keys() | found.keys()):
        if found.get(name) != wanted.get(name):
            return f"is damaged ({name} {'has changed' if name in found else 'is missing'})"
    return None


def _newest(run_dir: Path) -> Path:
    """Folder of the newest step. Raises CheckpointError if there is none, or it is not sound."""
    root = _root(run_dir)
    folders = [root / str(step) for step in _steps(run_dir)]
    if not folders:
        raise CheckpointError(
            f"there is no checkpoint under {root}; give the folder of a run that saved one"
        )
    *older, folder = folders
    fault = _fault(folder)
    if fault is None:
        return folder
    remedy = "train again"
    if sound := [other.name for other in older if _fault(other) is None]:
        remedy = f"to go on from step {sound[-1]}, the newest sound one, delete that folder"
    raise CheckpointError(f"checkpoint {folder} {fault}; {remedy}")
