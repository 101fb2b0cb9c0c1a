"""Faults of files that the package reads: damage, files of others, hostile content."""

import contextlib
import functools
import json
import math
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy
from hypothesis import HealthCheck, Phase, given, seed, settings, strategies as st
from jax._src import compilation_cache

from csac_jax import presets
from csac_jax.errors import FailedError
from csac_jax.io import checkpoint, configs, files, leaves, policy_file
from csac_jax.io.checkpoint import CheckpointError
from csac_jax.io.policy_file import PolicyFileError
from csac_jax.report import comparison, result_tables, results
from csac_jax.runtime import private_jax
from csac_jax.scenes import cases, pool
from csac_jax.sweeps import runner
from csac_jax.sweeps.grid import SweepPoint
from csac_jax.sweeps.runner import SweepError, SweepPlan
from csac_jax.world import scene_state
from tests.faults import harness
from tests.faults.harness import DAMAGES, Tally, fault
from tests.networks import random_params

CFG = presets.smoke()
LONGEST = 1000  # characters of a message: it is one line, not the file again
Rng = np.random.Generator
Prepare = Callable[[Path], tuple[Path, Callable[[], Any], type[Exception]]]
"""Writes a file; returns its path, its reader and the error that refuses it."""


class _SoundError(Exception):
    """The file was read as it was written: there is nothing to refuse."""


class _RefusedError(Exception):
    """A damaged file was noticed, and is made again."""


def _judge(
    tally: Tally, about: str, read: Callable[[], Any], expected: type[Exception] | tuple = ()
) -> None:
    kinds = (*expected, _SoundError) if isinstance(expected, tuple) else (expected, _SoundError)

    def call() -> None:
        try:
            read()
        except kinds as error:
            if len(str(error)) > LONGEST:
                raise AssertionError(f"{len(str(error))} characters: {error}"[:200]) from None
            raise

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        harness.refused(tally, about, call, kinds)


def _damaged(prepare: Prepare, kind: str, tally: Tally, rng: Rng, tries: int, folder: Path) -> None:
    path, read, expected = prepare(folder)
    whole, right = path.read_bytes(), read()

    def again() -> None:
        if read() == right:
            raise _SoundError

    for _ in tally.each(range(tries)):
        path.write_bytes(whole)
        _judge(tally, harness.damage(rng, kind, path), again, expected)


def _policy(folder: Path) -> tuple[Path, Callable[[], Any], type[Exception]]:
    path = folder / "policy.safetensors"
    policy_file.save(path, random_params(CFG), CFG)

    def read() -> Any:
        cfg, params = policy_file.load(path)
        return cfg, [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(params)]

    return path, read, PolicyFileError


def _sweep(folder: Path) -> tuple[Path, Callable[[], Any], type[Exception]]:
    (folder / files.SWEEP_PLAN).write_text(runner.plan_text(_plan()))
    return folder / files.SWEEP_PLAN, lambda: runner.read_plan(folder), SweepError


def _plan() -> SweepPlan:
    changed = {str(tau): CFG.change(learn={"tau": tau}) for tau in (0.01, 0.05)}
    points = [SweepPoint(f"tau={tau}", {"learn.tau": tau}, one) for tau, one in changed.items()]
    return SweepPlan(2, points)


def _pool(folder: Path) -> tuple[Path, Callable[[], Any], type[Exception]]:
    path, parked = folder / "pool.npz", scene_state.parked(CFG.scene.slots)
    rng = np.random.default_rng(0)
    scenes = jax.tree.map(lambda leaf: rng.normal(size=(8, *leaf.shape)).astype(leaf.dtype), parked)
    pool._write(path, scenes)

    def read() -> Any:
        if (found := pool._read(path)) is None:
            raise _RefusedError
        return [(str(leaf.dtype), leaf.shape, leaf.tobytes()) for leaf in jax.tree.leaves(found)]

    return path, read, _RefusedError


def _cache(folder: Path) -> tuple[Path, Callable[[], Any], type[Exception]]:
    path = folder / "entry-cache"
    program = jax.jit(lambda x: jnp.tanh(x) @ jnp.sort(x).T).lower(jnp.ones((8, 8))).compile()
    whole = program.runtime_executable().serialize()
    with _packing():
        path.write_bytes(compilation_cache.compress_executable(whole))

    def read() -> bytes:
        try:
            with _packing():
                return compilation_cache.decompress_executable(path.read_bytes())
        except Exception:  # JAX compiles the program then, whatever the error is
            raise _RefusedError from None

    return path, read, _RefusedError


@contextlib.contextmanager
def _packing() -> Iterator[None]:
    """Packs as JAX does once the cache is on, with a zstandard without checksums."""
    plain = SimpleNamespace(compress=bytes, decompress=bytes)
    module = SimpleNamespace(ZstdCompressor=lambda: plain, ZstdDecompressor=lambda: plain)
    with mock.patch.multiple(compilation_cache, zstd=None, zstandard=module):
        private_jax.compress_with_checksum()
        yield


for _what, _prepare in {
    "policy files": _policy,
    "sweep.json": _sweep,
    "the scene pool": _pool,
    "compiled programs": _cache,
}.items():
    for _kind in DAMAGES:
        fault(f"{_kind} in {_what}", 200)(functools.partial(_damaged, _prepare, _kind))


def _damaged_log(kind: str, tally: Tally, rng: Rng, tries: int, folder: Path) -> None:
    """Damages a log: readable lines stay, the others are counted, the whole file is kept. A digit
    that has changed to another goes unseen."""
    path, lines = folder / files.METRICS, [_line(number).encode() for number in range(40)]
    for _ in tally.each(range(tries)):
        path.write_bytes(b"".join(line + b"\n" for line in lines))
        about = harness.damage(rng, kind, path)
        found = harness.works(tally, about, lambda: _fault_of_log(path, lines) or "", "tracebacks")
        tally.check(not found, "lost", f"{about}: {found}")


for _kind in DAMAGES:
    fault(f"{_kind} in metrics.jsonl", 200)(functools.partial(_damaged_log, _kind))


def _line(number: int) -> str:
    grasps = {"grasp_success": 0.5 if number else None, "grasps_counted": number}
    return json.dumps({"step": number + 1, "actions": 8 * number, "seconds": 0.5, **grasps})


def _fault_of_log(path: Path, written: list[bytes]) -> str | None:
    before = path.read_bytes()
    *whole, _ = before.split(b"\n")
    with warnings.catch_warnings(record=True) as damage:
        warnings.simplefilter("always")
        files.truncate_log(path, 10**9)
    kept = [json.loads(line) for line in path.read_text().splitlines()]
    untouched = [json.loads(line) for line in whole if line in written]
    if [line for line in kept if line in untouched] != untouched:
        return "a good line is gone"
    dropped = len(whole) - len(kept)
    if dropped > 0 and not any(
        f"{dropped} of {len(whole)} lines" in str(w.message) for w in damage
    ):
        return f"{dropped} lines are gone without a word"
    copy_path = path.with_suffix(".damaged.jsonl")
    if dropped > 0 and copy_path.read_bytes() != before:
        return "the damaged file is not kept"
    return None


@fault("numbers changed by hand in sweep.json", 100)
def _numbers(tally: Tally, rng: Rng, tries: int, folder: Path) -> None:
    """Changes numbers of a plan with its digest kept or removed; the runs' own configs count."""
    path, read, expected = _sweep(folder)
    whole = json.loads(path.read_text())
    for run, cfg in runner.runs_of(_plan()).items():
        files.write_json(folder / run / files.CONFIG, configs.to_dict(cfg))
    for number in tally.each(range(tries)):
        changed = _copied(whole)
        places = [place for place in _places(changed["settings"]) if _is_number(place)]
        container, key = places[int(rng.integers(len(places)))]
        container[key] = 2 * abs(container[key]) + 1
        if number % 2:
            del changed[runner.DIGEST]
        path.write_text(json.dumps(changed))
        _judge(tally, f"{key} doubled, digest {'out' if number % 2 else 'kept'}", read, expected)


def _places(content: Any, depth: int = 8) -> Iterator[tuple[Any, Any]]:
    for key in list(content) if isinstance(content, dict) else range(len(content)):
        yield content, key
        if isinstance(content[key], dict | list) and depth:
            yield from _places(content[key], depth - 1)


def _is_number(place: tuple[Any, Any]) -> bool:
    container, key = place
    return type(container[key]) in (int, float)


@fault("foreign and swapped policy files", 100)
def _foreign(tally: Tally, rng: Rng, tries: int, folder: Path) -> None:
    """Reads files of other programs, and tensors of one policy under the remarks of another."""
    path, read, expected = _policy(folder)
    junk = rng.bytes(4096)
    own = path.read_bytes()
    with safetensors.safe_open(path, "numpy") as file:
        remarks = file.metadata()
    others = safetensors.numpy.load(safetensors.numpy.save(leaves.named(random_params(CFG, 1))))
    names = list(others)

    def swapped() -> bytes:
        tensors = safetensors.numpy.load(own)
        name = names[int(rng.integers(len(names)))]
        return safetensors.numpy.save(tensors | {name: others[name]}, remarks)

    def header(text: str) -> Callable[[], bytes]:
        return lambda: len(text.encode()).to_bytes(8, "little") + text.encode() + bytes(64)

    def tensor(kind: str, size: int, start: int = 0) -> str:
        return f'{{"dtype":"{kind}","shape":[{size}],"data_offsets":[{start},{start + size}]}}'

    spaced = remarks | {"config": remarks["config"][:-1] + " }"}
    contents: dict[str, Callable[[], bytes]] = {
        "nothing": bytes,
        "one byte": lambda: b"\0",
        "noise": lambda: rng.bytes(int(rng.integers(1, 4096))),
        "a pickle": lambda: b"\x80\x04\x95" + junk,
        "a zip": lambda: b"PK\x03\x04" + junk,
        "JSON": lambda: json.dumps({"format": 2}).encode(),
        "no remarks": lambda: safetensors.numpy.save(others),
        "a tensor of another": swapped,
        "the config of another": lambda: safetensors.numpy.save(
            safetensors.numpy.load(own), spaced
        ),
        "a huge header": lambda: (2**62).to_bytes(8, "little") + junk,
        "a deep header": header("[" * 100_000),
        "an F8 tensor": header(f'{{"a":{tensor("F8_E4M3", 64)}}}'),
        "an unknown tensor": header(f'{{"a":{tensor("F8", 64)}}}'),
        "one over the other": header(f'{{"a":{tensor("I8", 64)},"b":{tensor("I8", 32, 16)}}}'),
    }
    kinds = list(contents)
    for number in tally.each(range(tries)):
        kind = kinds[number % len(kinds)]
        path.write_bytes(contents[kind]())
        _judge(tally, kind, read, expected)


# Hostile content: valid files with values that nobody would write.

_DEEP: Any = json.loads("[" * 400 + "]" * 400)
_VALUES: list[Any] = [
    *(None, True, False, "", "..", "../../victim", "/etc", "a\0b", "a\nb", "\ud800", "x" * 5000),
    *(0, -1, 1.5, 0.3, -0.3, 9.0, 10**400, -(10**18), 2**31, 1e308, math.inf, -math.inf, math.nan),
    *([], {}, [[]], _DEEP, ["box"] * 5000, {"a": _DEEP}, {str(i): i for i in range(5000)}),
]
_ODD = st.sampled_from([*map(json.dumps, _VALUES)]).map(json.loads)  # each time a new object
_JSON = st.recursive(
    _ODD | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=9), inner),
    max_leaves=12,
)


def _copied(content: Any) -> Any:
    return json.loads(json.dumps(content))


def _hostile(valid: Any) -> st.SearchStrategy[Any]:
    """Draws any JSON, or valid content with one to three places changed, removed or doubled."""

    @st.composite
    def changed(draw: st.DrawFn) -> Any:
        content = _copied(valid)
        for _ in range(draw(st.integers(1, 3))):
            places = list(_places(content))
            if not places:
                break
            container, key = places[draw(st.integers(0, len(places) - 1))]
            kind = draw(st.sampled_from(["odd", "odd", "odd", "any", "gone", "twin"]))
            if kind == "gone":
                del container[key]
            elif kind == "twin" and isinstance(container, dict):
                container[draw(st.text(max_size=9))] = _copied(container[key])
            elif kind == "twin":
                container.append(_copied(container[key]))
            else:
                container[key] = draw(_ODD if kind == "odd" else _JSON)
        return content

    return st.one_of(changed(), changed(), changed(), _JSON)


def _texts(valid: Any) -> st.SearchStrategy[bytes]:
    written = _hostile(valid).map(lambda content: json.dumps(content).encode())
    broken = st.binary(max_size=40) | st.sampled_from(
        [b"[" * 10**5, b'{"a":' * 10**5, b"\xff", b""]
    )
    return st.one_of(*[written] * 9, broken)


def _read_all(
    tally: Tally,
    rng: Rng,
    tries: int,
    path: Path,
    valid: Any,
    sound: Callable[[], bool],
    expected: type[Exception] | tuple,
) -> None:
    """Writes hostile files at `path`. Each must be refused, or be `sound`."""
    drawn: list[bytes] = []
    options: dict[str, Any] = {"database": None, "deadline": None, "phases": [Phase.generate]}
    quiet = settings(max_examples=tries, suppress_health_check=list(HealthCheck), **options)
    quiet(seed(int(rng.integers(2**31)))(given(_texts(valid))(lambda text: drawn.append(text))))()

    def read() -> None:
        if sound():
            raise _SoundError

    for text in tally.each(drawn):
        path.write_bytes(text)
        shown = repr(text if len(text) <= 300 else text[:140] + b" ... " + text[-140:])
        _judge(tally, f"{path.name} {shown}", read, expected)


@fault("hostile config files", 500)
def _configs(tally: Tally, rng: Rng, tries: int, folder: Path) -> None:
    """Reads hostile configs: refused, or they come back as they were written."""
    path = folder / files.CONFIG

    def sound() -> bool:
        cfg = configs.from_dict(files.read_object(path))
        return configs.from_dict(_copied(configs.to_dict(cfg))) == cfg

    _read_all(tally, rng, tries, path, configs.to_dict(CFG), sound, ValueError)


@fault("hostile case files", 500)
def _cases(tally: Tally, rng: Rng, tries: int, folder: Path) -> None:
    """Reads hostile cases: refused, or they lie in the workspace."""
    path, reach = folder / "case.json", 0.5 * CFG.heightmap.extent
    valid = json.loads(cases.shipped(cases.names()[0]).read_text())

    def sound() -> bool:
        places = cases.load(path).scene.position
        return np.isfinite(places).all() and np.abs(places[:, :2]).max() <= reach

    _read_all(tally, rng, tries, path, valid, sound, ValueError)


@fault("hostile sweep.json", 300)
def _plans(tally: Tally, rng: Rng, tries: int, folder: Path) -> None:
    """Reads hostile plans: refused, or all runs lie in the sweep's folder, each in its own."""
    valid = json.loads(runner.plan_text(_plan()))
    del valid[runner.DIGEST]

    def sound() -> bool:
        runs = runner.runs_of(runner.read_plan(folder))
        places = {(folder / run).resolve() for run in runs}
        inside = all(folder.resolve() in place.parents for place in places)
        return len(places) == len(runs) and inside

    path = folder / files.SWEEP_PLAN
    _read_all(tally, rng, tries, path, valid, sound, (SweepError, OSError))


@fault("hostile manifests", 200)
def _manifests(tally: Tally, rng: Rng, tries: int, folder: Path) -> None:
    """Reads hostile manifests: the step is skipped for the one before."""
    for step in (4, 8):
        checkpoint.save(folder, step, {"step": jnp.int32(step)}, CFG, {})
    path = folder / checkpoint.FOLDER / "8" / checkpoint.MANIFEST
    valid = json.loads(path.read_text())

    def sound() -> bool:
        name = checkpoint.sound(folder).name
        return name == "4" or (name == "8" and json.loads(path.read_text()) == valid)

    _read_all(tally, rng, tries, path, valid, sound, CheckpointError)


@fault("hostile records of runs and evaluations", 300)
def _records(tally: Tally, rng: Rng, tries: int, folder: Path) -> None:
    """Reports hostile records: they are left out with a note, or shown."""
    share = {"value": 0.5, "low": 0.4, "high": 0.6, "n": 10}
    config = configs.to_dict(CFG)
    part = {**dict.fromkeys(results.METRICS, share), "counts": {"episodes": 10}}
    part |= {"failures": {"grasp_dropped": share}}
    evaluation = {"policy": "learned", "suite": "cases", "seed": 5, "config": config}
    evaluation |= {"parts": {"a": part, "b": part}, "versions": {"jax": "1"}, "commit": "abc"}
    record = {"wall_seconds": 3.0, "config": config, "device": "cpu", "versions": {"jax": "1"}}
    valid = {"eval.json": evaluation, files.CONFIG: config, files.RECORD: record}
    valid[files.METRICS] = json.loads(_line(3))
    row = {**part, "suite": "cases", "policy": "a", "episodes": 10, "seed": 0}
    valid["record.json"] = {"cpu": {"results": [row, {**row, "part": "b"}]}}
    for name, content in valid.items():
        own = folder / name
        for other in valid:
            files.replace(own / other, json.dumps(valid[other]) + "\n")

        def sound(own: Path = own) -> bool:
            report = comparison.build(results.read([own]))
            return bool(
                result_tables.markdown(report) and json.dumps(result_tables.as_json(report))
            )

        few = -(-tries // len(valid))
        _read_all(tally, rng, few, own / name, content, sound, (ValueError, FailedError))
