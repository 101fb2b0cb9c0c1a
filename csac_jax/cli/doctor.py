"""`csac-jax doctor`: whether this machine computes right, and whether a run fits its memory."""

import contextlib
import dataclasses
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

from csac_jax.cli import output, parsing, settings, train
from csac_jax.cli.failures import BadArgumentsError, FailedError, complain
from csac_jax.config import Config

_HANGS = "the self-test hangs: too few threads for batched MJX? Set PJRT_NPROC=8 and try again"


@dataclasses.dataclass(frozen=True)
class DoctorOptions:
    """Prints versions, devices and protections, and checks that this machine computes right.

    With --preset PRESET, and settings as for `train`, also prints the memory of a run's state."""

    json: Path | None = None
    """File to write the result to, as JSON."""


def run(arguments: list[str]) -> int:
    """Prints versions, devices and checks; returns the exit code."""
    own, cfg = _split(arguments)
    options = parsing.parse(DoctorOptions, own, "doctor")
    needs = {} if cfg is None else _print_memory(cfg)
    with _watchdog(90.0, _HANGS):
        from csac_jax.runtime import selftest

        guard = _print_machine()
        begun = time.perf_counter()
        checks = selftest.run()
    for check in checks:
        verdict = "ok" if check.passed else "FAILED"
        print(f"{verdict:<10} {check.name}: error {check.error:.1e}, bound {check.bound:.0e}")
    print(f"self-test  {time.perf_counter() - begun:.1f} s")
    tests = [{**check._asdict(), "passed": check.passed} for check in checks]
    output.write_result(options.json, {**guard, "self_test": tests, **needs}, cfg)
    failed = [check.name for check in checks if not check.passed]
    if failed:
        names = "; ".join(failed)
        raise FailedError(f"self-test failed: {names}; do not trust these versions here")
    return 0


def _split(arguments: list[str]) -> tuple[list[str], Config | None]:
    """The arguments of `doctor` itself, and the config of the others if they name a preset."""
    preset = parsing.value_of(arguments, "--preset")
    if parsing.asks_help(arguments):
        return ["--help"], None
    if preset is None:
        if "--preset" in arguments:
            raise BadArgumentsError(
                f"doctor: give a preset after --preset, one of: {settings.PRESETS}"
            )
        return arguments, None
    own: list[str] = []
    others: list[str] = []
    group: list[str] = []  # where an option and its values go
    for word in arguments:
        if word.startswith("--"):
            name = word.split("=")[0]
            group = {"--json": own, "--preset": []}.get(name, others)
        group.append(word)
    return own, train.read([preset, *others])[1]


def _print_memory(cfg: Config) -> dict[str, Any]:
    """Prints what a run's state takes; returns it for the JSON."""
    from csac_jax.training import memory

    parts, available = memory.state_bytes(cfg), memory.limit()
    listed = ", ".join(f"{name} {size / memory.GIB:.2f}" for name, size in parts.items())
    share = f"{sum(parts.values()) / memory.GIB:.2f} GiB of {available / memory.GIB:.1f}"
    print(f"memory     {share} for the state of {cfg.preset}: {listed}")
    return {"memory": {"bytes": parts, "limit_bytes": available}}


def _print_machine() -> dict[str, Any]:
    """Prints versions, devices and protections; returns the protections for the JSON."""
    from csac_jax import _guard
    from csac_jax.runtime import compiler, provenance

    record = provenance.record()
    versions = ", ".join(f"{name} {number}" for name, number in provenance.versions().items())
    print(f"device     {record['device']}")
    print(f"versions   {versions}")
    print(f"commit     {record['commit'] or 'none'}")
    variable, threads = _guard.pool_setting()
    guarded = threads >= _guard.needed_threads()
    remedy = f"batched MJX may hang; set {_guard.POOL_VARIABLE}={_guard.needed_threads()}"
    verdict = "enough for batched MJX" if guarded else remedy
    print(f"XLA flags  {os.environ.get('XLA_FLAGS') or 'none'}")
    print(f"threads    {threads} in JAX's pool on the CPU, by {variable}: {verdict}")
    fast = compiler.has_library()
    print(f"training   convolutions by XLA's {'second library' if fast else 'default library'}")
    pool = {"variable": variable, "threads": threads, "guarded": guarded}
    return {
        "thread_pool": pool,
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "second_library": fast,
    }


@contextlib.contextmanager
def _watchdog(seconds: float, message: str) -> Iterator[None]:
    """Ends the process with `message` if the block takes longer than `seconds`."""

    def end() -> NoReturn:
        complain(1, message)
        os._exit(1)

    timer = threading.Timer(seconds, end)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
