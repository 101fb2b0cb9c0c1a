"""`csac-jax finetune`: a policy learns from what it did."""

import dataclasses
import datetime
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import tyro

from csac_jax.cli import output, parsing
from csac_jax.cli.failures import check_seed
from csac_jax.errors import SettingsError
from csac_jax.runtime import signals

INTERVAL = 10.0  # s between lines


@dataclasses.dataclass(frozen=True)
class FinetuneOptions:
    """Trains a policy further with the actions and outcomes that act or serve recorded. Nothing is
    simulated."""

    policy: tyro.conf.Positional[str]
    """A policy file, one that comes with the package, such as shipped, or a run's folder."""
    record: tyro.conf.Positional[Path]
    """Folder that act or serve wrote with --record."""
    gripper: str | None = None
    """The robot's gripper, by name or folder; by default that of the training."""
    out: Path = Path("finetuned.safetensors")
    """Policy file to write, which must not exist."""
    updates: int = 150
    """Updates of the critic; take more for a record of more than some hundred actions."""
    learning_rate: float = 3e-4
    """Adam's step size for the critic; the actor's is a third of it."""
    batch: int = 16
    """Actions that an update learns from."""
    seed: int = 0
    """Seed of the order of the actions."""
    json: Path | None = None
    """File to write the result to, as JSON."""


def run(arguments: list[str]) -> int:
    """Learns, saves and prints; returns the exit code."""
    options = parsing.parse(FinetuneOptions, arguments, "finetune")
    _check(options)
    stop = signals.install()
    try:
        from csac_jax.deploy import CameraPolicy, fine_tuning
    except ModuleNotFoundError as error:
        raise SettingsError(
            f"finetune needs {error.name}; copy the record to a machine where it is installed"
        ) from None
    from csac_jax.io import policy_file

    policy = CameraPolicy.load(options.policy, gripper=options.gripper)
    values = (options.updates, options.learning_rate, options.batch, options.seed)
    settings = fine_tuning.Settings(*values)
    tuned, summary = fine_tuning.run(policy, options.record, settings, _printer(), stop)
    policy_file.save(options.out, tuned.params, tuned.cfg)
    print(
        f"learned from {summary.actions} actions, {summary.lifted} of them lifted something; "
        f"TD error {summary.td_error[0]:.3f} -> {summary.td_error[1]:.3f}"
    )
    ended = "stopped" if summary.stopped_by else "done"
    print(f"{ended} after {summary.updates} updates; wrote {options.out}")
    inputs = {"policy": options.policy, "record": str(options.record), **settings._asdict()}
    output.write_result(options.json, {**inputs, **summary._asdict()}, tuned.cfg)
    return stop.exit_code


def _check(options: FinetuneOptions) -> None:
    if options.out.suffix != ".safetensors":
        raise SettingsError(f"--out: {options.out} must end in .safetensors")
    if options.out.exists():
        raise SettingsError(f"--out: {options.out} exists; give another name")
    if options.updates < 1:
        raise SettingsError("--updates: at least 1")
    check_seed(options.seed)
    if not 1 <= options.batch <= 4096:
        raise SettingsError("--batch: must lie in 1 .. 4096")
    if not 0.0 < options.learning_rate < 1.0:
        raise SettingsError("--learning-rate: must lie between 0 and 1")


def _printer() -> Callable[[Any], None]:
    """Returns a callback that prints the progress, at first and then every INTERVAL."""
    printed = [-INTERVAL]

    def show(progress: Any) -> None:
        if time.monotonic() - printed[0] < INTERVAL and progress.updates < progress.total:
            return
        printed[0] = time.monotonic()
        left = datetime.timedelta(
            seconds=round(progress.seconds * (progress.total / progress.updates - 1.0))
        )
        print(
            f"{progress.updates} of {progress.total} updates, "
            f"TD error {progress.td_error:.3f}, {left} left",
            flush=True,
        )

    return show
