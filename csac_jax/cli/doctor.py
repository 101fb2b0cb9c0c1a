"""`csac-jax doctor`: self-test of this machine, and the memory that a run needs."""

import contextlib
import dataclasses
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from csac_jax.cli import output, parsing, train
from csac_jax.cli.failures import complain
from csac_jax.config import Config
from csac_jax.errors import FailedError, SettingsError

_HANGS = "the self-test hangs: too few threads for batched MJX? Set PJRT_NPROC=8 and try again"


@dataclasses.dataclass(frozen=True)
class DoctorOptions:
    """Prints versions, devices and protections, and tests the numbers of this machine."""

    preset: str | None = None
    """Preset, with settings as for `train`: also prints the memory that a run's state takes."""
    build: bool = False
    """Also builds the kernels of physics on Warp: of the preset, or else of fast."""
    json: Path | None = None
    """File to write the result to, as JSON."""


def run(arguments: list[str]) -> int:
    """Prints versions, devices and checks; returns the exit code."""
    options, cfg = _read(arguments)
    needs = {} if cfg is None else _print_memory(cfg)
    with _watchdog(90.0, _HANGS):
        from csac_jax.sim import selftest

        guard = _print_machine()
        begun = time.perf_counter()
        checks = selftest.run()
    for check in checks:
        verdict = "ok" if check.passed else "FAILED"
        print(f"{verdict:<10} {check.name}: error {check.error:.1e}, bound {check.bound:.0e}")
    print(f"self-test  {time.perf_counter() - begun:.1f} s")
    built = {} if cfg is None or "--build" not in arguments else _build_kernels(cfg)
    tests = [{**check._asdict(), "passed": check.passed} for check in checks]
    output.write_result(options.json, {**guard, "self_test": tests, **needs, **built}, cfg)
    if failed := "; ".join(check.name for check in checks if not check.passed):
        raise FailedError(f"self-test failed: {failed}; do not trust these versions here")
    return 0


def _read(arguments: list[str]) -> tuple[DoctorOptions | train.TrainOptions, Config | None]:
    """Returns the options, and with --preset or --build the config of such a run."""
    preset, others = parsing.take(arguments, "--preset")
    build, others = "--build" in others, [flag for flag in others if flag != "--build"]
    if parsing.asks_help(arguments) or (preset is None and not build):
        return parsing.parse(DoctorOptions, arguments, "doctor"), None
    options, cfg = train.read([preset or "fast", *others])
    if not build:
        return options, cfg
    from csac_jax.sim import backend

    cfg = backend.resolve(cfg)
    if (physics := cfg.sim.physics) != "warp":
        text = f"only warp has kernels to build, and sim.physics is {physics} here"
        raise SettingsError(f"--build: {text}")
    return options, cfg


def _build_kernels(cfg: Config) -> dict[str, Any]:
    from csac_jax.sim import physics
    from csac_jax.world import model

    begun = time.perf_counter()
    physics.prepare(physics.make(model.build(cfg.scene, cfg.sim), cfg.sim), cfg.train.scenes)
    seconds = time.perf_counter() - begun
    print(f"kernels    {seconds:.1f} s for {cfg.train.scenes} scenes of {cfg.preset} on Warp")
    return {"kernels_seconds": seconds}


def _print_memory(cfg: Config) -> dict[str, Any]:
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

    versions = ", ".join(f"{name} {number}" for name, number in provenance.versions().items())
    variable, threads = _guard.pool_setting()
    needed, fast = _guard.needed_threads(), compiler.has_library()
    flags = os.environ.get("XLA_FLAGS", "")
    remedy = f"batched MJX may hang; set {_guard.POOL_VARIABLE}={needed}"
    verdict = "enough for batched MJX" if threads >= needed else remedy
    print(f"device     {provenance.device()}")
    print(f"versions   {versions}")
    print(f"commit     {provenance.commit() or 'none'}")
    print(f"XLA flags  {flags or 'none'}")
    print(f"threads    {threads} in JAX's pool on the CPU, by {variable}: {verdict}")
    print(f"training   convolutions by XLA's {'second' if fast else 'default'} library")
    pool = {"variable": variable, "threads": threads, "guarded": threads >= needed}
    return {"thread_pool": pool, "xla_flags": flags, "second_library": fast}


@contextlib.contextmanager
def _watchdog(seconds: float, message: str) -> Iterator[None]:
    timer = threading.Timer(seconds, lambda: os._exit(complain(1, message)))
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
