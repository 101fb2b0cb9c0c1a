"""`csac-jax finetune`: a policy learns from what it did."""

import dataclasses
import datetime
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import tyro

from csac_jax.cli import output, parsing
from csac_jax.cli.failures import BadArgumentsError, check_seed
from csac_jax.runtime import signals

INTERVAL = 10.0  # s between lines


@dataclasses.dataclass(frozen=True)
class FinetuneOptions:
    """Goes on training a policy with the actions and outcomes that act or serve recorded. Nothing
    is simulated."""

    policy: tyro.conf.Positional[str]
    """A policy file, one that comes with the package, such as shipped, or a run's folder."""
    record: tyro.conf.Positional[Path]
    """Folder that act or serve wrote with --record."""
    gripper: str | None = None
    """The robot's gripper, by name or folder; by default that of the training."""
    out: Path = Path("finetuned.safetensors")
    """Policy file to write, which must not exist."""
    updates: int = 150
    """Updates of the critic; more where the record is larger than some hundred actions."""
    learning_rate: float = 3e-4
    """Adam's step size for the critic; the actor's is a third of it."""
    batch: int = 16
    """Actions that an update learns from."""
    seed: int = 0
    """Number that the order of the actions follows from."""
    json: Path | None = None
    """File to write the result to, as JSON."""


def run(arguments: list[str]) -> int:
    """Learns, saves and prints; returns the exit code."""
    options = parsing.parse(FinetuneOptions, arguments, "finetune")
    _check(options)
    stop = signals.install()
    try:
        from csac_jax.deploy import Policy, finetune
    except ModuleNotFoundError as error:
        raise BadArgumentsError(
            f"finetune needs {error.name}; copy the record to a machine where it is installed"
        ) from None
    from csac_jax.io import policy_file

    policy = Policy.load(options.policy, gripper=options.gripper)
    values = (options.updates, options.learning_rate, options.batch, options.seed)
    settings = finetune.Settings(*values)
    tuned, done = finetune.run(policy, options.record, settings, _printer(), stop)
    policy_file.save(options.out, tuned.params, tuned.cfg)
    print(
        f"learned from {done.actions} actions, {done.lifted} of them lifted something; "
        f"TD error {done.td_error[0]:.3f} -> {done.td_error[1]:.3f}"
    )
    ended = "stopped" if done.stopped_by else "done"
    print(f"{ended} after {done.updates} updates; wrote {options.out}")
    asked = {"policy": options.policy, "record": str(options.record), **settings._asdict()}
    output.write_result(options.json, {**asked, **done._asdict()}, tuned.cfg)
    return stop.exit_code


def _check(options: FinetuneOptions) -> None:
    if options.out.suffix != ".safetensors":
        raise BadArgumentsError(f"--out: {options.out} must end in .safetensors")
    if options.out.exists():
        raise BadArgumentsError(f"--out: {options.out} exists; give another name")
    if options.updates < 1:
        raise BadArgumentsError("--updates: at least 1")
    check_seed(options.seed)
    if not 1 <= options.batch <= 4096:
        raise BadArgumentsError("--batch: must lie in 1 .. 4096")
    if not 0.0 < options.learning_rate < 1.0:
        raise BadArgumentsError("--learning-rate: must lie between 0 and 1")


def _printer() -> Callable[[Any], None]:
    """Prints how far the learning is, at first and then every INTERVAL."""
    printed = [-INTERVAL]

    def show(now: Any) -> None:
        if time.monotonic() - printed[0] < INTERVAL and now.updates < now.total:
            return
        printed[0] = time.monotonic()
        left = datetime.timedelta(
            seconds=round(now.seconds * (now.total - now.updates) / now.updates)
        )
        print(
            f"{now.updates} of {now.total} updates, TD error {now.td_error:.3f}, {left} left",
            flush=True,
        )

    return show
