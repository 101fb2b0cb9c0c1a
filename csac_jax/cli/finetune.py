"""`csac-jax finetune`: a policy learns from what it did."""

import dataclasses
from pathlib import Path

import tyro

from csac_jax.cli import output, parsing
from csac_jax.cli.failures import check_seed
from csac_jax.cli.robot_options import PolicyOptions, naming_the_option
from csac_jax.errors import SettingsError
from csac_jax.runtime import signals
from csac_jax.section import require


@dataclasses.dataclass(frozen=True, kw_only=True)
class FinetuneOptions(PolicyOptions):
    """Trains a policy further with the actions and outcomes that act or serve recorded. Nothing is
    simulated."""

    record: tyro.conf.Positional[Path]
    """Folder that act or serve wrote with --record."""
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


@naming_the_option()
def run(arguments: list[str]) -> int:
    """Learns, saves and prints; returns the exit code."""
    options = parsing.parse(FinetuneOptions, arguments, "finetune")
    _check(options)
    stop = signals.install()
    try:
        from csac_jax.deploy import CameraPolicy, fine_tuning
    except ModuleNotFoundError as error:
        remedy = "copy the record to a machine where it is installed"
        raise SettingsError(f"finetune needs {error.name}; {remedy}") from None
    from csac_jax.io import policy_file

    policy = CameraPolicy.load(options.policy, gripper=options.gripper)
    names = fine_tuning.Settings._fields
    settings = fine_tuning.Settings(*(getattr(options, name) for name in names))
    with output.progress() as bar:
        task = bar.add_task("updates", total=None)

        def show(done: int, total: int, td_error: float) -> None:
            title = f"updates, TD error {td_error:.3f}"
            bar.update(task, completed=done, total=total, description=title)

        tuned, summary = fine_tuning.run(policy, options.record, settings, show, stop)
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
    out = options.out
    require(out.suffix == ".safetensors", f"--out: {out} must end in .safetensors")
    require(not out.exists(), f"--out: {out} exists; give another name")
    require(options.updates >= 1, "--updates: at least 1")
    check_seed(options.seed)
    require(1 <= options.batch <= 4096, "--batch: must lie in 1 .. 4096")
    require(0.0 < options.learning_rate < 1.0, "--learning-rate: must lie between 0 and 1")
