"""Checkpoints: the whole training state, the config and a little JSON, a folder for each step.

    RUN/checkpoints/run                   random name of the run, which its checkpoints repeat
    RUN/checkpoints/STEP/state/...        arrays, by Orbax
    RUN/checkpoints/STEP/config, extra    JSON, by Orbax
    RUN/checkpoints/STEP/manifest.sha256  digest of every file above
    RUN/checkpoints/set-aside/STEP        one that was passed over on resuming, or saved once more

A step is written under another name and renamed once its manifest is there: it appears complete or
not at all. Orbax restores flipped bits and casts other dtypes silently. So every file is checked
against the manifest, and every leaf's shape and dtype against what the program expects.
"""

import collections
import contextlib
import functools
import hashlib
import itertools
import json
import logging
import math
import re
import secrets
import shutil
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp
import tensorstore

from csac_jax.config import Config
from csac_jax.errors import DataWarning, FailedError
from csac_jax.io import configs, files, leaves, renames
from csac_jax.runtime import cluster, provenance

FOLDER = "checkpoints"
MANIFEST = "manifest.sha256"
SET_ASIDE = "set-aside"
KEPT = 2
_RUN = "run"
_PATTERNS = "*?[\\"  # Orbax globs; TensorStore takes a backslash for a slash
_DRAFT = ".saving"


class CheckpointError(FailedError):
    """A checkpoint that is missing, damaged or another program's; the message has the remedy."""


def check_path(run_dir: Path) -> None:
    """Raises CheckpointError where Orbax would read or write other folders than the run's."""
    path = str(_root(run_dir))
    bad = [sign for sign in path if sign in _PATTERNS or "\ud800" <= sign <= "\udfff"]
    if bad:
        raise CheckpointError(
            f"{run_dir!a}: no checkpoint can be saved in a path with {bad[0]!a}; name another one"
        )


def save(run_dir: Path, step: int, state: Any, cfg: Config, extra: dict[str, Any]) -> Path:
    """Writes `state` (a pytree of arrays and typed keys) as `step`; returns once it is complete.
    The last two are kept.

    Removes what a killed process left; sets a folder of that step aside. `extra` is anything that
    JSON can hold. With several processes all must call it. Raises CheckpointError where it cannot
    be written, as on a full disc; earlier checkpoints stay as they are.
    """
    root = _root(run_dir)
    draft, folder = root / _DRAFT, root / str(step)
    arrays = {name: _untyped(leaf) for name, leaf in leaves.named(state).items()}
    if _own_step(arrays) not in (None, step):
        raise ValueError(f"a state of step {_own_step(arrays)} cannot be saved as step {step}")
    try:
        if cluster.is_first():
            _clean(root)
        cluster.wait(f"cleaned {root}")
        origin = {"step": step, "run": _name_run(root), "versions": provenance.versions()}
        record = {"layout": leaves.layout(state), "extra": extra, **origin}
        items = ocp.args.Composite(
            state=ocp.args.StandardSave(arrays),
            config=ocp.args.JsonSave(configs.to_dict(cfg)),
            extra=ocp.args.JsonSave(record),
        )
        with _checkpointer() as checkpointer:
            checkpointer.save(draft, args=items)
        if cluster.is_first():
            _check_complete(draft, arrays)
            files.write_json(draft / MANIFEST, _digests(draft))
            _publish(draft, folder)
    except Exception as error:  # TensorStore and Orbax raise nearly anything for a full disc
        if cluster.is_first():
            _clean(root, times=10)
        raise CheckpointError(
            f"step {step} could not be saved in {root} ({files.first_line(error)}); earlier "
            "checkpoints are intact; make room there and go on with --resume"
        ) from error
    cluster.wait(f"saved {folder}")
    return folder


def _check_complete(draft: Path, arrays: dict[str, Any]) -> None:
    """Raises OSError where Orbax wrote less than all arrays without an error of its own: one call
    that a full disc refuses is enough."""
    spec = {"driver": "ocdbt", "base": {"driver": "file", "path": f"{draft / 'state'}/"}}
    store = tensorstore.KvStore.open(spec).result()
    parts = collections.Counter(key.rpartition(b"/")[0].decode() for key in store.list().result())
    for name, array in arrays.items():
        form = store.read(f"{name}/.zarray").result().value
        if not form:
            raise OSError(f"{name} was not written")
        sides = json.loads(form)["chunks"]
        chunks = math.prod(-(-n // m) for n, m in zip(array.shape, sides, strict=True))
        if parts[name] < chunks + 1:
            raise OSError(f"{name} was not written whole")


def load_config(run_dir: Path, step: int | None = None) -> Config:
    """The config of a checkpoint; see `restore`."""
    folder = sound(run_dir, step)
    try:
        return configs.from_dict(_read(folder, config=ocp.args.JsonRestore())["config"])
    except ValueError as error:
        raise CheckpointError(
            f"checkpoint {folder} was made by another version of csac_jax ({error}); "
            "use that version or train again"
        ) from error


def restore(
    run_dir: Path, abstract_state: Any, step: int | None = None
) -> tuple[Any, dict[str, Any]]:
    """State and `extra`, as they were given to `save`, of a step, by default the newest sound one.

    `abstract_state` has the state's structure, shapes and dtypes, as `jax.eval_shape` gives them. A
    leaf that has a sharding is laid out by it, however it was when it was saved; the others go to
    the first device. Raises CheckpointError; warns of damaged steps that it passes over.
    """
    folder = sound(run_dir, step)
    record = _read(folder, extra=ocp.args.JsonRestore())["extra"]
    every, layout = leaves.named(abstract_state), leaves.layout(abstract_state)
    added = [name for name in renames.ADDED if name in every and name not in record["layout"]]
    wanted = {name: leaf for name, leaf in every.items() if name not in added}
    old = {name: _old_name(name, record["layout"]) for name in wanted}
    found = leaves.difference(record["layout"], {old[name]: layout[name] for name in wanted})
    if found is not None:
        name, has, needs = found
        raise CheckpointError(
            f"checkpoint {folder} holds {name} as {has}, the program needs {needs}; "
            "use the version of csac_jax that saved it"
        )
    provenance.warn_if_other(record.get("versions"), f"checkpoint {folder}")
    arrays = {old[name]: _abstract_array(leaf) for name, leaf in wanted.items()}
    arrays = _read(folder, state=ocp.args.StandardRestore(arrays))["state"]
    if (found_step := _own_step(arrays)) not in (None, int(folder.name)):
        raise CheckpointError(f"checkpoint {folder} holds step {found_step}; remove that folder")
    state = [
        _zeros(leaf) if name in added else _typed(arrays[old[name]], leaf)
        for name, leaf in every.items()
    ]
    return jax.tree.unflatten(jax.tree.structure(abstract_state), state), record["extra"]


def sound(run_dir: Path, step: int | None = None) -> Path:
    """Folder of a step, by default of the newest one whose files are what was saved.

    Raises CheckpointError where there is none; warns of newer ones that are damaged.
    """
    root = _root(run_dir)
    steps = [step] if step is not None else _steps(run_dir)[::-1]
    faults: list[str] = []
    for number in steps:
        folder = root / str(number)
        if (fault := _fault(folder)) is None:
            for said in faults:
                warnings.warn(f"{said}; going back to step {number}", DataWarning, stacklevel=2)
            return folder
        faults.append(f"checkpoint {folder} {fault}")
    if not faults:
        raise CheckpointError(
            f"there is no checkpoint under {root}; give the folder of a run that saved one"
        )
    others = [number for number in _steps(run_dir) if number not in steps]
    remedy = f"saved are: {', '.join(map(str, others))}" if others else "train again"
    raise CheckpointError(f"{faults[0]}; {remedy}")


def set_aside(run_dir: Path, step: int | None = None) -> None:
    """Moves the steps that are newer than `step`, by default the newest sound one, out of the
    way."""
    set_aside_after(run_dir, int(sound(run_dir, step).name))


def set_aside_after(run_dir: Path, step: int) -> None:
    """Moves the steps that are newer than `step` out of the way, sound or not."""
    for number in [number for number in _steps(run_dir) if number > step]:
        _set_aside(_root(run_dir) / str(number))


def load_extra(run_dir: Path) -> dict[str, Any]:
    """The `extra` of the newest sound step, see `save`."""
    return _read(sound(run_dir), extra=ocp.args.JsonRestore())["extra"]["extra"]


def latest_step(run_dir: Path) -> int | None:
    """The newest step that was saved under `run_dir`, sound or not; None if there is none."""
    return max(_steps(run_dir), default=None)


def _set_aside(folder: Path) -> None:
    place = folder.parent / SET_ASIDE
    place.mkdir(exist_ok=True)
    names = itertools.chain([folder.name], (f"{folder.name}-{i}" for i in itertools.count(2)))
    folder.rename(next(place / name for name in names if not (place / name).exists()))


def _publish(draft: Path, folder: Path) -> None:
    """Gives a complete step its name and drops those before the last two."""
    if folder.exists():
        _set_aside(folder)  # not removed: a kill may come before the next line has run
    draft.rename(folder)
    files.sync_folder(folder.parent)
    for number in _steps(folder.parents[1])[:-KEPT]:
        shutil.rmtree(folder.parent / str(number))


def _clean(root: Path, times: int = 1) -> None:
    """Removes what a save that did not end has left, again and again for half a second: threads of
    Orbax's may still be on their way, and a full disc may refuse to open a folder."""
    for number in range(times):
        if number:
            time.sleep(0.05)
        for path in [*root.glob("*.orbax-checkpoint-tmp*"), root / _DRAFT]:
            shutil.rmtree(path, ignore_errors=True)


def _name_run(root: Path) -> str:
    """The name of the run that saves here; a new one where there is none."""
    if cluster.is_first() and _run_name(root) is None:
        sound = (root / str(step) for step in _steps(root.parent)[::-1])
        saved = next((_record(folder) for folder in sound if _fault(folder) is None), {})
        name = str(saved.get("run") or secrets.token_hex(8))
        files.replace(root / _RUN, f"{name} {hashlib.sha256(name.encode()).hexdigest()}")
    cluster.wait(f"named {root}")
    return _run_name(root) or ""


def _run_name(root: Path) -> str | None:
    """The name of the run whose checkpoints these are; None without one, or a damaged one."""
    if not (root / _RUN).is_file():
        return None
    name, _, digest = (root / _RUN).read_bytes().partition(b" ")
    return name.decode() if hashlib.sha256(name).hexdigest().encode() == digest else None


def _root(run_dir: Path) -> Path:
    return Path(run_dir).resolve() / FOLDER


@contextlib.contextmanager
def _checkpointer() -> Iterator[ocp.Checkpointer]:
    """Orbax's; it may raise, but not print tracebacks of what it raises as well.

    Folders are made at once: where that fails in a thread of Orbax's, it waits for 5 minutes.
    """
    at_once = ocp.AsyncOptions(create_directories_asynchronously=False)
    options = ocp.CompositeOptions(async_options=at_once)
    logger, hook = logging.getLogger("absl"), sys.unraisablehook
    was, logger.disabled = logger.disabled, True
    sys.unraisablehook = functools.partial(_unraisable, hook)
    handler = ocp.CompositeCheckpointHandler(composite_options=options)
    with ocp.Checkpointer(handler) as checkpointer:
        yield checkpointer
    # Not after an error: its threads may still be on their way.
    logger.disabled, sys.unraisablehook = was, hook


def _unraisable(hook: Callable[[Any], object], unraisable: Any) -> None:
    """Passes on what cannot be raised, but for writes that end after another one has failed."""
    if "Event loop is closed" not in str(unraisable.exc_value):
        hook(unraisable)


def _read(folder: Path, **items: Any) -> Any:
    try:
        with _checkpointer() as checkpointer:
            return checkpointer.restore(folder, args=ocp.args.Composite(**items))
    except Exception as error:  # its files are what was saved, so another program saved them
        raise CheckpointError(
            f"checkpoint {folder} cannot be read ({files.first_line(error)}); "
            "use the version of csac_jax that saved it"
        ) from error


def _steps(run_dir: Path) -> list[int]:
    """Saved steps, the oldest first."""
    names = [path.name for path in _root(run_dir).glob("*")]
    return sorted(int(name) for name in names if re.fullmatch("0|[1-9][0-9]{0,17}", name))


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


def _zeros(leaf: Any) -> jax.Array:
    array = _abstract_array(leaf)
    return jnp.zeros(array.shape, array.dtype, device=array.sharding)


def _typed(array: Any, leaf: Any) -> Any:
    """An array as it was saved, a key again if the abstract leaf is one."""
    if not _is_key(leaf):
        return array
    impl = jax.random.key_impl(jax.lax.full((), 0, leaf.dtype))
    return jax.random.wrap_key_data(array, impl=impl)


def _record(folder: Path) -> dict[str, Any]:
    """What a step says of itself. Raises OSError, and ValueError for what `save` never wrote."""
    record = files.read_object(folder / "extra" / "metadata")
    if not all(isinstance(record.get(name), dict) for name in ("layout", "extra")):
        raise ValueError("it is no checkpoint of csac_jax")
    return record


def _own_step(arrays: dict[str, Any]) -> int | None:
    """The step that a state says it is of; None if it does not say."""
    step = arrays.get("step")
    return int(step) if step is not None and step.shape == () else None


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
        wanted = files.read_object(folder / MANIFEST)
        found = _digests(folder)
        for name in sorted(wanted.keys() | found.keys()):
            if found.get(name) != wanted.get(name):
                return f"is damaged ({name} {'has changed' if name in found else 'is missing'})"
        record = _record(folder)
        run = _run_name(folder.parent)
    except (FileNotFoundError, NotADirectoryError):
        return "is missing or half-written (it has no manifest)"
    except ValueError as error:
        return f"is damaged ({error})"
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    if str(record.get("step", folder.name)) != folder.name:
        return f"is that of step {record['step']}, so rename it to {record['step']}"
    if run is not None and record.get("run", run) != run:  # older ones name no run
        return "is another run's"
    return None
