"""Checkpoints: the whole training state, the config and a little JSON, each step in a folder of its
own.

    RUN/checkpoints/STEP/state/...        arrays, by Orbax
    RUN/checkpoints/STEP/config, extra    JSON, by Orbax
    RUN/checkpoints/STEP/manifest.sha256  digest of every file above, written last

Orbax makes a step's folder appear all at once, but restores flipped bits and casts other dtypes
without a word. So every file is checked against the manifest, and every leaf's shape and dtype
against what the program expects. A step that fails is an error, never a reason to go back to an
older one silently.
"""

import hashlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp
from orbax.checkpoint.checkpoint_managers import LatestN

from csac_jax.config import Config
from csac_jax.errors import FailedError
from csac_jax.io import configs, renames
from csac_jax.runtime import cluster

FOLDER = "checkpoints"
MANIFEST = "manifest.sha256"
KEPT = 2


class CheckpointError(FailedError):
    """A checkpoint that is missing, damaged or made for another program; the message is one line
    with the remedy."""


def save(run_dir: Path, step: int, state: Any, cfg: Config, extra: dict[str, Any]) -> Path:
    """Writes `state` (a pytree of arrays and typed keys) as `step`; returns once it is complete.
    The last two are kept.

    Temporary folders that a killed process left are removed. `extra` is anything that JSON can
    hold. With several processes all must call it.
    """
    leaves = _raw_leaves(state)
    record = {"layout": _layout(state), "extra": extra}
    folder = _root(run_dir) / str(step)
    with _manager(run_dir, writes=True) as manager:
        manager.save(
            step,
            args=ocp.args.Composite(
                state=ocp.args.StandardSave(leaves),
                config=ocp.args.JsonSave(configs.to_dict(cfg)),
                extra=ocp.args.JsonSave(record),
            ),
        )
        manager.wait_until_finished()  # a failed save raises here
    cluster.wait(f"saved {folder}")
    if cluster.is_first():
        _write_manifest(folder)
    cluster.wait(f"manifest of {folder}")
    return folder


def latest_step(run_dir: Path) -> int | None:
    """The newest step that was saved under `run_dir`, sound or not; None if there is none."""
    return max(_steps(run_dir), default=None)


def load_config(run_dir: Path) -> Config:
    """The config of the newest checkpoint."""
    folder = _verified(run_dir, None)
    with _manager(run_dir, writes=False) as manager:
        stored = manager.restore(
            int(folder.name), args=ocp.args.Composite(config=ocp.args.JsonRestore())
        )
    try:
        return configs.from_dict(stored["config"])
    except ValueError as error:
        raise CheckpointError(
            f"checkpoint {folder} was made by another version of csac_jax ({error}); "
            "use that version or train again"
        ) from error


def restore(
    run_dir: Path, abstract_state: Any, step: int | None = None
) -> tuple[Any, dict[str, Any]]:
    """State and `extra` of `step` (the newest if None), as they were given to `save`.

    `abstract_state` has the state's structure, shapes and dtypes, as `jax.eval_shape` gives them. A
    leaf that has a sharding is laid out by it, however it was when it was saved; the others go to
    the first device.
    """
    folder = _verified(run_dir, step)
    number = int(folder.name)
    with _manager(run_dir, writes=False) as manager:
        record = manager.restore(number, args=ocp.args.Composite(extra=ocp.args.JsonRestore()))[
            "extra"
        ]
        stored = _stored_names(abstract_state, record["layout"])
        _compare(folder, record["layout"], _layout(abstract_state, stored))
        raw = {stored[name]: leaf for name, leaf in _raw_abstract(abstract_state).items()}
        wanted = ocp.args.StandardRestore(raw)
        leaves = manager.restore(number, args=ocp.args.Composite(state=wanted))["state"]
    named = {name: leaves[old] for name, old in stored.items()}
    return _with_leaves(abstract_state, named), record["extra"]


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


def _steps(run_dir: Path) -> list[int]:
    root = _root(run_dir)
    return (
        sorted(int(path.name) for path in root.iterdir() if path.name.isdigit())
        if root.is_dir()
        else []
    )


# Leaves. Orbax gets a flat dict of plain arrays; typed keys travel as their bits.


def _named(tree: Any) -> Iterator[tuple[str, Any]]:
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        yield jax.tree_util.keystr(path, simple=True, separator="."), leaf


def _is_key(leaf: Any) -> bool:
    return jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _raw_leaves(state: Any) -> dict[str, Any]:
    return {
        name: jax.random.key_data(leaf) if _is_key(leaf) else leaf for name, leaf in _named(state)
    }


def _raw_abstract(abstract_state: Any) -> dict[str, jax.ShapeDtypeStruct]:
    one = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    places = {name: leaf.sharding or one for name, leaf in _named(abstract_state)}
    raw = jax.eval_shape(_raw_leaves, abstract_state)
    return {
        name: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=places[name])
        for name, leaf in raw.items()
    }


def _with_leaves(abstract_state: Any, raw: dict[str, Any]) -> Any:
    """The tree of `abstract_state` with the leaves `raw`, keys wrapped again."""
    leaves = [
        jax.random.wrap_key_data(raw[name], impl=_key_impl(leaf)) if _is_key(leaf) else raw[name]
        for name, leaf in _named(abstract_state)
    ]
    return jax.tree.unflatten(jax.tree.structure(abstract_state), leaves)


def _key_impl(abstract_key: Any) -> Any:
    """The generator of an abstract key; JAX tells it of a traced key only."""
    found: list[Any] = []
    jax.eval_shape(lambda key: found.append(jax.random.key_impl(key)), abstract_key)
    return found[0]


def _layout(tree: Any, names: dict[str, str] | None = None) -> dict[str, str]:
    """Name of each leaf, or what `names` has for it -> dtype and shape, as in `float32[8, 3]`."""
    layout = {name: f"{leaf.dtype}{list(leaf.shape)}" for name, leaf in _named(tree)}
    return layout if names is None else {names[name]: kind for name, kind in layout.items()}


def _stored_names(tree: Any, layout: dict[str, str]) -> dict[str, str]:
    """Name of each leaf -> its name in a checkpoint, which may be an older one."""
    older = {new: old for old, new in renames.STATE.items()}
    return {name: name if name in layout else older.get(name, name) for name, _ in _named(tree)}


def _compare(folder: Path, stored: dict[str, str], wanted: dict[str, str]) -> None:
    for name in dict.fromkeys([*wanted, *stored]):
        if stored.get(name) != wanted.get(name):
            raise CheckpointError(
                f"checkpoint {folder} holds {name} as {stored.get(name, 'nothing')}, the program "
                f"needs {wanted.get(name, 'nothing')}; use the version of csac_jax that saved it"
            )


# Manifest.


def _files(folder: Path) -> Iterator[Path]:
    return (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != MANIFEST)


def _digests(folder: Path) -> dict[str, str]:
    digests = {}
    for path in _files(folder):
        with path.open("rb") as file:
            digests[path.relative_to(folder).as_posix()] = hashlib.file_digest(
                file, "sha256"
            ).hexdigest()
    return digests


def _write_manifest(folder: Path) -> None:
    temporary = folder / f".{MANIFEST}.tmp"
    digests = _digests(folder)
    with temporary.open("w") as file:
        json.dump(digests, file, indent=0)
        file.flush()
        os.fsync(file.fileno())
    temporary.rename(folder / MANIFEST)


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
        if name not in found:
            return f"is damaged ({name} is missing)"
        if found[name] != wanted.get(name):
            return f"is damaged ({name} has changed)"
    return None


def _verified(run_dir: Path, step: int | None) -> Path:
    """Folder of a sound step, the newest if `step` is None."""
    root, steps = _root(run_dir), _steps(run_dir)
    if not steps:
        raise CheckpointError(
            f"there is no checkpoint under {root}; give the folder of a run that saved one"
        )
    number = steps[-1] if step is None else step
    if number not in steps:
        raise CheckpointError(
            f"there is no checkpoint of step {number} under {root}; there are {steps}"
        )
    folder = root / str(number)
    fault = _fault(folder)
    if fault is None:
        return folder
    older = [other for other in steps if other < number and _fault(root / str(other)) is None]
    remedy = (
        f"to go on from step {older[-1]}, the newest sound one, delete that folder"
        if older
        else "train again"
    )
    raise CheckpointError(f"checkpoint {folder} {fault}; {remedy}")
