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
from csac_jax.agent import actor_critic
from csac_jax.errors import FailedError
from csac_jax.io import checkpoint, configs, files, leaves, policy_file
from csac_jax.io.checkpoint import CheckpointError
from csac_jax.io.policy_file import PolicyFileError
from csac_jax.report import comparison, results, tables
from csac_jax.runtime import private_jax
from csac_jax.scene import cases, layout, pool
from csac_jax.sweeps import runner
from csac_jax.sweeps.grid import SweepPoint
from csac_jax.sweeps.runner import SweepError, SweepPlan
from tests.faults import harness
from tests.faults.harness import DAMAGES, Tally, fault

CFG = presets.smoke()
LONGEST = 1000  # characters of a message: it is one line, not the file again


class _SoundError(Exception):
    """What was read is what was written: there is nothing to refuse."""


class _RefusedError(Exception):
    """A damaged file was noticed, and is made again."""


def _judge(
    tally: Tally, about: str, read: Callable[[], Any], expected: type[Exception] | tuple = ()
) -> None:
    """Counts a call that neither raises `expected` in one line nor says that all is sound."""
    tally.tries += 1
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


def _damaged(
    rng: np.random.Generator,
    tries: int,
    kind: str,
    path: Path,
    read: Callable[[], Any],
    expected: type[Exception],
) -> Tally:
    """Damages a file again and again. It must be refused, or read as before."""
    tally, whole, right = Tally(), path.read_bytes(), read()

    def again() -> None:
        if read() == right:
            raise _SoundError

    for _ in range(tries):
        path.write_bytes(whole)
        about = harness.damage(rng, kind, path)
        _judge(tally, about, again, expected)
    return tally


def _every_damage(
    what: str, prepare: Callable[[Path], tuple[Path, Callable[[], Any], type[Exception]]]
) -> None:
    """Registers the faults of a kind of file; `prepare` writes one and says how it is read."""
    for kind in DAMAGES:

        def inject(rng: np.random.Generator, tries: int, folder: Path, kind: str = kind) -> Tally:
            return _damaged(rng, tries, kind, *prepare(folder))

        fault(f"{kind} in {what}", 200)(inject)


def _params(number: int) -> Any:
    """Networks of CFG, all numbers different."""
    rng = np.random.default_rng(number)
    blank = actor_critic.abstract_params(CFG)
    return jax.tree.map(lambda leaf: rng.normal(size=leaf.shape).astype(leaf.dtype), blank)


def _policy(folder: Path) -> tuple[Path, Callable[[], Any], type[Exception]]:
    path = folder / "policy.safetensors"
    policy_file.save(path, _params(0), CFG)

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
    path, parked = folder / "pool.npz", layout.parked(CFG.scene.slots)
    rng = np.random.default_rng(0)
    scenes = jax.tree.map(lambda leaf: rng.normal(size=(8, *leaf.shape)).astype(leaf.dtype), parked)
    pool._write(path, scenes)

    def read() -> Any:
        if (found := pool._read(path)) is None:
            raise _RefusedError
        return [(str(leaf.dtype), leaf.shape, leaf.tobytes()) for leaf in jax.tree.leaves(found)]

    return path, read, _RefusedError


def _cache(folder: Path) -> tuple[Path, Callable[[], Any], type[Exception]]:
    """An entry of the cache of compiled programs, packed as this package has JAX pack it."""
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
    """JAX packs as it does once the cache is on, where a zstandard without checksums is
    installed."""
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
    _every_damage(_what, _prepare)


for _kind in DAMAGES:

    def _log_fault(rng: np.random.Generator, tries: int, folder: Path, kind: str = _kind) -> Tally:
        """A damaged log: readable lines stay, the others are counted, the whole file is kept. A
        digit that has changed to another goes unseen."""
        tally, path = Tally(), folder / files.METRICS
        lines = [_line(number).encode() for number in range(40)]
        for _ in range(tries):
            path.write_bytes(b"".join(line + b"\n" for line in lines))
            about = harness.damage(rng, kind, path)
            found: list[str] = []
            _judge(tally, about, functools.partial(_cut, path, lines, found))
            tally.lost += len(found)
            tally.remarks += [f"{about}: {text}" for text in found]
        return tally

    fault(f"{_kind} in metrics.jsonl", 200)(_log_fault)


def _cut(path: Path, written: list[bytes], found: list[str]) -> None:
    """Cuts a log, and adds what is wrong with that to `found`."""
    if text := _fault_of_log(path, written):
        found.append(text)
    raise _SoundError


def _line(number: int) -> str:
    grasps = {"grasp_success": 0.5 if number else None, "grasps_counted": number}
    return json.dumps({"step": number + 1, "actions": 8 * number, "seconds": 0.5, **grasps})


def _fault_of_log(path: Path, written: list[bytes]) -> str | None:
    """What is wrong with how a log is cut to the steps so far."""
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
def _numbers(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
    """By hand the digest is kept, or taken out too; then what the runs themselves say counts."""
    path, read, expected = _sweep(folder)
    whole, tally = json.loads(path.read_text()), Tally()
    for run in runner.runs_of(_plan()):
        files.write_json(folder / run.folder / files.CONFIG, configs.to_dict(run.cfg))
    for number in range(tries):
        changed = _copied(whole)
        places = [place for place in _places(changed["settings"]) if _is_number(place)]
        container, key = places[int(rng.integers(len(places)))]
        container[key] = 2 * abs(container[key]) + 1
        if number % 2:
            del changed[runner.DIGEST]
        path.write_text(json.dumps(changed))
        _judge(tally, f"{key} doubled, digest {'out' if number % 2 else 'kept'}", read, expected)
    return tally


def _places(content: Any, depth: int = 8) -> Iterator[tuple[Any, Any]]:
    """Every container of JSON content, so many levels deep, with each of its keys."""
    for key in list(content) if isinstance(content, dict) else range(len(content)):
        yield content, key
        if isinstance(content[key], dict | list) and depth:
            yield from _places(content[key], depth - 1)


def _is_number(place: tuple[Any, Any]) -> bool:
    container, key = place
    return type(container[key]) in (int, float)


@fault("foreign and swapped policy files", 100)
def _foreign(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
    """Files of other programs; tensors of one policy under the remarks of another."""
    path, tally, junk = folder / "policy.safetensors", Tally(), rng.bytes(4096)
    _, read, expected = _policy(folder)
    own = path.read_bytes()
    with safetensors.safe_open(path, "numpy") as file:
        remarks = file.metadata()
    others = safetensors.numpy.load(safetensors.numpy.save(leaves.named(_params(1))))
    names = list(others)

    def swapped() -> bytes:
        tensors = safetensors.numpy.load(own)
        name = names[int(rng.integers(len(names)))]
        return safetensors.numpy.save(tensors | {name: others[name]}, remarks)

    def header(text: str) -> bytes:
        return len(text.encode()).to_bytes(8, "little") + text.encode() + bytes(64)

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
            safetensors.numpy.load(own), remarks | {"config": remarks["config"][:-1] + " }"}
        ),
        "a huge header": lambda: (2**62).to_bytes(8, "little") + junk,
        "a deep header": lambda: header("[" * 100_000),
        "an F8 tensor": lambda: header(
            '{"a":{"dtype":"F8_E4M3","shape":[64],"data_offsets":[0,64]}}'
        ),
        "an unknown tensor": lambda: header(
            '{"a":{"dtype":"F8","shape":[64],"data_offsets":[0,64]}}'
        ),
        "tensors one over the other": lambda: header(
            '{"a":{"dtype":"I8","shape":[64],"data_offsets":[0,64]},'
            '"b":{"dtype":"I8","shape":[32],"data_offsets":[16,48]}}'
        ),
    }
    kinds = list(contents)
    for number in range(tries):
        kind = kinds[number % len(kinds)]
        path.write_bytes(contents[kind]())
        _judge(tally, kind, read, expected)
    return tally


@fault("numbers that are not finite in policy files", 60)
def _not_finite(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
    """They are neither written nor read, though the digest is right."""
    path, tally = folder / "policy.safetensors", Tally()
    _, read, expected = _policy(folder)
    for number in range(tries):
        params = _params(number)
        each = jax.tree.leaves(params)
        leaf = each[int(rng.integers(len(each)))]
        leaf.flat[int(rng.integers(leaf.size))] = (np.nan, np.inf, -np.inf)[number % 3]
        if number % 2:
            with mock.patch.object(policy_file, "check_finite"):
                policy_file.save(path, params, CFG)
            _judge(tally, "read", read, expected)
        else:
            _judge(tally, "written", lambda p=params: policy_file.save(path, p, CFG), expected)
    return tally


# Hostile content: valid files in which something stands that nobody would write.

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
    """Any JSON, or valid content of which one to three places hold it, are gone or have a twin."""

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
    """Files of such content; now and then no JSON at all, or too deep for any reader."""
    written = _hostile(valid).map(lambda content: json.dumps(content).encode())
    broken = st.binary(max_size=40) | st.sampled_from(
        [b"[" * 10**5, b'{"a":' * 10**5, b"\xff", b""]
    )
    return st.one_of(*[written] * 9, broken)


def _each(
    rng: np.random.Generator, tries: int, texts: st.SearchStrategy[bytes], path: Path
) -> Iterator[bytes]:
    """Writes `tries` drawn files at `path`, one after the other."""
    drawn: list[bytes] = []
    quiet = settings(
        max_examples=tries,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )

    def keep(text: bytes) -> None:
        drawn.append(text)

    quiet(seed(int(rng.integers(2**31)))(given(texts)(keep)))()
    for text in drawn:
        path.write_bytes(text)
        yield text


def _say(text: bytes) -> str:
    return repr(text if len(text) <= 300 else text[:140] + b" ... " + text[-140:])


@fault("hostile config files", 500)
def _configs(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
    """They are refused, or are configs that come back as they were written."""
    tally, path = Tally(), folder / files.CONFIG
    old = {"sim": {"push_phases": [1, 2, 3]}, "explore": {"noise_clip": 0.03, "noise_std": 0.01}}
    valid = configs.to_dict(CFG)
    texts = _texts(valid) | _texts({**valid, "format": 1, **old, "camera": {"scale": 0.5}})

    def read() -> None:
        cfg = configs.from_dict(files.read_object(path))
        if configs.from_dict(json.loads(json.dumps(configs.to_dict(cfg)))) == cfg:
            raise _SoundError

    for text in _each(rng, tries, texts, path):
        _judge(tally, _say(text), read, ValueError)
    return tally


@fault("hostile case files", 500)
def _cases(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
    """They are refused, or are arrangements that lie in the workspace."""
    tally, path = Tally(), folder / "case.json"
    valid = json.loads(cases.shipped(cases.names()[0]).read_text())
    reach = 0.5 * CFG.heightmap.extent

    def read() -> None:
        scene = cases.load(path).scene
        if np.isfinite(scene.position).all() and np.abs(scene.position[:, :2]).max() <= reach:
            raise _SoundError

    for text in _each(rng, tries, _texts(valid), path):
        _judge(tally, _say(text), read, ValueError)
    return tally


@fault("hostile sweep.json", 300)
def _plans(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
    """They are refused, or all their runs lie inside the sweep's folder, each in its own."""
    tally, path = Tally(), folder / files.SWEEP_PLAN
    valid = json.loads(runner.plan_text(_plan()))
    del valid[runner.DIGEST]

    def read() -> None:
        plan = runner.read_plan(folder)
        places = [(folder / run.folder).resolve() for run in runner.runs_of(plan)]
        if len(set(places)) == len(places) and all(
            folder.resolve() in one.parents for one in places
        ):
            raise _SoundError

    for text in _each(rng, tries, _texts(valid), path):
        _judge(tally, _say(text), read, (SweepError, OSError))
    return tally


@fault("hostile manifests", 200)
def _manifests(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
    """The step is passed over, for the one before."""
    tally, state = Tally(), {"step": jnp.int32(4)}
    for step in (4, 8):
        checkpoint.save(folder, step, {"step": jnp.int32(step)}, CFG, {})
    path = folder / checkpoint.FOLDER / "8" / checkpoint.MANIFEST
    valid = json.loads(path.read_text())

    def read() -> None:
        found = checkpoint.sound(folder).name
        if found == "4" or (found == "8" and json.loads(path.read_text()) == valid):
            raise _SoundError

    for text in _each(rng, tries, _texts(valid), path):
        _judge(tally, _say(text), read, CheckpointError)
    path.write_text(json.dumps(valid))
    assert int(checkpoint.restore(folder, jax.eval_shape(lambda: state))[0]["step"]) == 8
    return tally


@fault("hostile records of runs and evaluations", 300)
def _records(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
    """A report leaves them out with a note, or shows them."""
    tally, share = Tally(), {"value": 0.5, "low": 0.4, "high": 0.6, "n": 10}
    config = configs.to_dict(CFG)
    part = {**dict.fromkeys(results.METRICS, share), "counts": {"episodes": 10}}
    part |= {"failures": {"grasp_dropped": share}}
    evaluation = {"policy": "learned", "suite": "cases", "seed": 5, "config": config}
    evaluation |= {"parts": {"a": part, "b": part}, "versions": {"jax": "1"}, "commit": "abc"}
    record = {"wall_seconds": 3.0, "config": config, "device": "cpu", "versions": {"jax": "1"}}
    valid = {
        "eval.json": evaluation,
        files.CONFIG: config,
        results.RECORD: record,
        files.METRICS: json.loads(_line(3)),
    }
    for number, (name, content) in enumerate(valid.items()):
        own = folder / str(number)
        for other in valid:
            files.replace(own / other, json.dumps(valid[other]) + "\n")

        def read(own: Path = own) -> None:
            report = comparison.build(results.read([own]))
            tables.markdown(report)
            json.dumps(tables.as_json(report))
            raise _SoundError

        for text in _each(rng, -(-tries // len(valid)), _texts(content), own / name):
            _judge(tally, f"{name} {_say(text)}", read, (ValueError, FailedError))
    return tally
