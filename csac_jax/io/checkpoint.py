"""Checkpoints: the whole training state, the config and a little JSON, a folder for each step.

    RUN/checkpoints/run                   random name of the run, which its checkpoints repeat
    RUN/checkpoints/STEP/state/...        arrays, by Orbax
    RUN/checkpoints/STEP/config, extra    JSON, by Orbax
    RUN/checkpoints/STEP/manifest.sha256  digest of every file above
    RUN/checkpoints/set-aside/STEP        a step that was skipped on resuming, or saved again

A step is renamed once its manifest is written: it appears complete or not at all. Orbax restores
flipped bits and casts other dtypes silently. So every file is checked against the manifest, and
every leaf against the shape and dtype that the program expects.
"""

import collections
import contextlib
import functools
import hashlib
import itertools
import json
import logging
import math
import os
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
import orbax.checkpoint as ocp
import tensorstore

from csac_jax.config import Config
from csac_jax.errors import DataWarning, FailedError
from csac_jax.io import configs, files, leaves
from csac_jax.runtime import cluster, provenance

FOLDER = "checkpoints"
MANIFEST = "manifest.sha256"
SET_ASIDE = "set-aside"
KEPT = 2
_RUN = "run"
_PATTERNS = "*?[\\"  # Orbax globs; TensorStore takes a backslash for a slash
_DRAFT = ".saving"


class CheckpointError(FailedError):
    """A missing or damaged checkpoint, or another program's; the message has the remedy."""


def check_path(run_dir: Path) -> None:
    """Raises CheckpointError where Orbax would read or write other folders than the run's."""
    path = str(_root(run_dir))
    if bad := [sign for sign in path if sign in _PATTERNS or "\ud800" <= sign <= "\udfff"]:
        raise CheckpointError(
            f"{run_dir!a}: no checkpoint can be saved in a path with {bad[0]!a}; name another one"
        )


def save(run_dir: Path, step: int, state: Any, cfg: Config, extra: dict[str, Any]) -> Path:
    """Writes `state` (a pytree of arrays and typed keys) as `step`; keeps the last two steps.

    Returns once the step is complete. Removes the drafts of a killed process; sets a folder of that
    step aside. `extra` is any JSON content. With several processes all must call it. Raises
    CheckpointError if it cannot be written, as on a full disc; earlier checkpoints stay.
    """
    root = _root(run_dir)
    draft, folder = root / _DRAFT, root / str(step)
    arrays = {name: _untyped(leaf) for name, leaf in leaves.named(state).items()}
    if (saved := _own_step(arrays)) not in (None, step):
        raise ValueError(f"a state of step {saved} cannot be saved as step {step}")
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
            _clean(root, looks=10)
        raise CheckpointError(
            f"step {step} could not be saved in {root} ({files.first_line(error)}); earlier "
            "checkpoints are intact; make room there and resume the run"
        ) from error
    cluster.wait(f"saved {folder}")
    return folder


def _check_complete(draft: Path, arrays: dict[str, Any]) -> None:
    """Raises OSError if arrays are missing.

    Orbax raises no error of its own where a full disc refuses a single call.
    """
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


def load_config(run_dir: Path, step: int | None = None, acts: bool = False) -> Config:
    """Reads the config of a checkpoint; see `restore`, and `configs.from_dict` of `acts`."""
    folder = sound(run_dir, step)
    try:
        return configs.from_dict(_read(folder, config=ocp.args.JsonRestore())["config"], acts)
    except ValueError as error:
        raise CheckpointError(
            f"checkpoint {folder} was made by another version of csac_jax ({error}); "
            "use that version or train again"
        ) from error


def restore(
    run_dir: Path, abstract_state: Any, step: int | None = None
) -> tuple[Any, dict[str, Any]]:
    """Reads state and `extra` of a step, by default the newest sound one.

    `abstract_state` has the state's structure, shapes and dtypes, as `jax.eval_shape` gives them. A
    leaf with a sharding is laid out by it, whatever its layout when it was saved; the others go to
    the first device. Raises CheckpointError; warns of damaged steps that it skips.
    """
    folder = sound(run_dir, step)
    record = _read(folder, extra=ocp.args.JsonRestore())["extra"]
    if different := leaves.difference(record["layout"], leaves.layout(abstract_state)):
        name, has, needs = different
        raise CheckpointError(
            f"checkpoint {folder} holds {name} as {has}, the program needs {needs}; "
            "use the version of csac_jax that saved it"
        )
    provenance.warn_if_other(record.get("versions"), f"checkpoint {folder}")
    wanted = leaves.named(abstract_state)
    arrays = {name: _abstract_array(leaf) for name, leaf in wanted.items()}
    arrays = _read(folder, state=ocp.args.StandardRestore(arrays))["state"]
    state = [_typed(arrays[name], leaf) for name, leaf in wanted.items()]
    return jax.tree.unflatten(jax.tree.structure(abstract_state), state), record["extra"]


def sound(run_dir: Path, step: int | None = None) -> Path:
    """Returns the folder of a step, by default of the newest one with undamaged files.

    Raises CheckpointError if there is none; warns of newer ones that are damaged.
    """
    root = _root(run_dir)
    steps = [step] if step is not None else _steps(run_dir)[::-1]
    faults: list[str] = []
    for number in steps:
        folder = root / str(number)
        if (fault := _fault(folder)) is None:
            for text in faults:
                warnings.warn(f"{text}; going back to step {number}", DataWarning, stacklevel=2)
            return folder
        faults.append(f"checkpoint {folder} {fault}")
    if not faults:
        raise CheckpointError(
            f"there is no checkpoint under {root}; give the folder of a run that saved one"
        )
    others = [number for number in _steps(run_dir) if number not in steps]
    remedy = f"saved are: {', '.join(map(str, others))}" if others else "train again"
    raise CheckpointError(f"{faults[0]}; {remedy}")


def set_aside_after(run_dir: Path, step: int) -> None:
    """Moves steps newer than `step`, sound or not, to another folder."""
    for number in _steps(run_dir):
        if number > step:
            _set_aside(_root(run_dir) / str(number))


def load_extra(run_dir: Path) -> dict[str, Any]:
    """Returns the `extra` of the newest sound step, see `save`."""
    return _read(sound(run_dir), extra=ocp.args.JsonRestore())["extra"]["extra"]


def latest_step(run_dir: Path) -> int | None:
    """Returns the newest saved step, sound or not; None if there is none."""
    return max(_steps(run_dir), default=None)


def remove(run_dir: Path) -> None:
    """Removes all checkpoints of a run."""
    shutil.rmtree(_root(run_dir), ignore_errors=True)


def _set_aside(folder: Path) -> None:
    place = files.inside(folder.parent, SET_ASIDE)
    place.mkdir(exist_ok=True)
    names = itertools.chain([folder.name], (f"{folder.name}-{i}" for i in itertools.count(2)))
    folder.rename(next(place / name for name in names if not (place / name).exists()))


def _publish(draft: Path, folder: Path) -> None:
    if folder.exists():
        _set_aside(folder)  # not removed: a kill may come before the next line runs
    draft.rename(folder)
    files.sync_folder(folder.parent)
    for number in _steps(folder.parents[1])[:-KEPT]:
        _remove(folder.parent / str(number))


def _clean(root: Path, looks: int = 1) -> None:
    """Removes drafts until so many looks in a row find none, or for 3 s.

    Orbax's threads may still write, a full disc may refuse.
    """
    files.remove_drafts(root)
    clean = 0
    for _ in range(60):
        drafts = [*root.glob("*.orbax-checkpoint-tmp*"), *root.glob(_DRAFT)]
        for path in drafts:
            with contextlib.suppress(OSError):
                _remove(path, ignore_errors=True)
        clean = 0 if drafts else clean + 1
        if clean == looks:
            return
        time.sleep(0.05)


def _remove(path: Path, ignore_errors: bool = False) -> None:
    """Removes a folder, or a file or link in its place."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors)
    else:
        path.unlink()


def _name_run(root: Path) -> str:
    """Returns the name of the run that saves here; draws one if there is none."""
    if cluster.is_first() and _run_name(root) is None:
        folders = (root / str(step) for step in _steps(root.parent)[::-1])
        saved = next((_record(folder) for folder in folders if _fault(folder) is None), {})
        name = str(saved.get("run") or secrets.token_hex(8))
        files.replace(root / _RUN, f"{name} {hashlib.sha256(name.encode()).hexdigest()}")
    cluster.wait(f"named {root}")
    return _run_name(root) or ""


def _run_name(root: Path) -> str | None:
    if not (root / _RUN).is_file():
        return None
    name, _, digest = (root / _RUN).read_bytes().partition(b" ")
    return name.decode() if hashlib.sha256(name).hexdigest().encode() == digest else None


def _root(run_dir: Path) -> Path:
    return Path(os.path.realpath(files.inside(Path(run_dir), FOLDER)))


@contextlib.contextmanager
def _checkpointer() -> Iterator[ocp.Checkpointer]:
    """Opens Orbax's checkpointer, which may raise but not print tracebacks as well.

    Folders are made at once: if that fails in a thread, Orbax waits for 5 minutes.
    """
    at_once = ocp.AsyncOptions(create_directories_asynchronously=False)
    options = ocp.CompositeOptions(async_options=at_once)
    logger, hook = logging.getLogger("absl"), sys.unraisablehook
    was, logger.disabled = logger.disabled, True
    sys.unraisablehook = functools.partial(_unraisable, hook)
    handler = ocp.CompositeCheckpointHandler(composite_options=options)
    with ocp.Checkpointer(handler) as checkpointer:
        yield checkpointer
    # Not after an error: its threads may still run.
    logger.disabled, sys.unraisablehook = was, hook


def _unraisable(hook: Callable[[Any], object], unraisable: Any) -> None:
    """Ignores writes that end after another one has failed; passes on other errors."""
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
    names = [path.name for path in _root(run_dir).glob("*")]
    return sorted(int(name) for name in names if re.fullmatch("0|[1-9][0-9]{0,17}", name))


def _is_key(leaf: Any) -> bool:
    return jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _untyped(leaf: Any) -> Any:  # Orbax stores a typed key as its bits
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _abstract_array(leaf: Any) -> jax.ShapeDtypeStruct:
    place = leaf.sharding or jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    array = jax.eval_shape(_untyped, leaf)
    return jax.ShapeDtypeStruct(array.shape, array.dtype, sharding=place)


def _typed(array: Any, leaf: Any) -> Any:
    if not _is_key(leaf):
        return array
    impl = jax.random.key_impl(jax.lax.full((), 0, leaf.dtype))
    return jax.random.wrap_key_data(array, impl=impl)


def _record(folder: Path) -> dict[str, Any]:
    record = files.read_object(folder / "extra" / "metadata")
    if not all(isinstance(record.get(name), dict) for name in ("layout", "extra")):
        raise ValueError("it is no checkpoint of csac_jax")
    return record


def _own_step(arrays: dict[str, Any]) -> int | None:
    step = arrays.get("step")
    return int(step) if step is not None and step.shape == () else None


def _digests(folder: Path) -> dict[str, str]:
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != MANIFEST]
    return {path.relative_to(folder).as_posix(): _sha256(path) for path in paths}


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _fault(folder: Path) -> str | None:
    if folder.is_symlink():
        return "is a link"
    try:
        wanted = files.read_object(folder / MANIFEST)
        actual = _digests(folder)
        for name in sorted(wanted.keys() | actual.keys()):
            if actual.get(name) != wanted.get(name):
                return f"is damaged ({name} {'has changed' if name in actual else 'is missing'})"
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
