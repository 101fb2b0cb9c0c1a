"""`csac-jax train`: one run, new or resumed."""

import dataclasses
import time
from pathlib import Path
from typing import Any

import tyro

from csac_jax.cli import guards, output, parsing, settings, stored
from csac_jax.cli.failures import BadArgumentsError, as_bad_arguments, as_failure
from csac_jax.config import Config
from csac_jax.runtime import signals

EXAMPLES = (
    "quick                               # 2,000 actions, minutes on two cores",
    "quick --algo vpg --seed 1           # another algorithm and seed",
    "fast --init shipped                 # start from the shipped policy's networks",
    "quick --replay.sampler beta --replay.end 1 4",
    "--resume runs/a                     # go on with a run that was stopped",
)


@dataclasses.dataclass(frozen=True)
class TrainOptions:
    """Trains a policy into a new folder, or goes on with a run: --resume RUN."""

    run_dir: Path | None = None
    """Folder of the run, which must not exist; runs/PRESET-SEED-TIME if not given."""
    resume: Path | None = None
    """Folder of a run to go on with; more --train.actions make it longer."""
    init: str | None = None
    """Start from the networks of a run, a policy file or `shipped`; brings its net settings."""
    tensorboard: tyro.conf.FlagCreatePairsOff[bool] = False
    """Also write TensorBoard files into the folder of the run."""
    json: Path | None = None
    """File to write the result to, as JSON."""
    seed: int = 0
    """Number that all randomness of the run follows from."""
    algo: str = "csac_beta"
    """Algorithm; settings given as options win over it."""


def run(arguments: list[str]) -> int:
    """Trains; returns the exit code."""
    if parsing.asks_short_help(arguments):
        settings.print_help(TrainOptions, "train", EXAMPLES, arguments)
        return 0
    stop = signals.install()
    options, cfg = read(arguments)
    begun = time.time()
    done = _train(options, cfg, stop)
    wall_seconds = round(time.time() - begun, 1)
    result = {"run_dir": str(done.run_dir), **done.summary._asdict(), "wall_seconds": wall_seconds}
    output.write_result(options.json, result, done.cfg)
    output.write_result(done.run_dir / "train.json", result, done.cfg)  # `report` reads it
    return stop.exit_code


def read(arguments: list[str]) -> tuple[TrainOptions, Config]:
    """Options and config of a run, from the command line and, if it is resumed, its checkpoint."""
    preset, flags = settings.split(arguments)
    base = settings.preset(preset or "quick", flags)
    resumed, init = (parsing.value_of(flags, name) for name in ("--resume", "--init"))
    if resumed is not None and not parsing.asks_help(flags):
        trained = stored.config(Path(resumed))
        base = dataclasses.replace(trained, preset=preset or trained.preset)
    elif init is not None:
        base = stored.with_networks_of(base, init)
    options, cfg = settings.parse(TrainOptions, f"train {preset or 'PRESET'}", base, flags)
    if options.resume is not None:
        if options.run_dir is not None or options.init is not None:
            raise BadArgumentsError("--resume: a resumed run takes neither --run-dir nor --init")
    elif preset is None:
        raise BadArgumentsError(f"train: give a preset first, one of: {settings.PRESETS}")
    else:
        guards.check_new(options.run_dir)
    guards.check_physics(cfg)
    if options.tensorboard:
        guards.check_extra("--tensorboard", "tensorboardX", "tensorboard")
    return options, cfg


def _train(options: TrainOptions, cfg: Config, stop: signals.Stop) -> Any:
    from csac_jax import api
    from csac_jax.errors import SettingsError
    from csac_jax.io import checkpoint, policy_file
    from csac_jax.training import loop

    folder = options.resume or options.run_dir or api.new_folder(f"{cfg.preset}-{cfg.seed}")
    reporters = []
    if options.tensorboard:
        from csac_jax.report.progress import TensorBoard

        reporters.append(TensorBoard(folder))
    with (
        as_failure(loop.TrainingError, checkpoint.CheckpointError, policy_file.PolicyFileError),
        as_bad_arguments(SettingsError),
    ):
        try:
            return api.train(
                cfg,
                folder,
                resume=options.resume is not None,
                init=options.init,
                reporters=reporters,
                stop=stop,
            )
        except FileExistsError:
            raise guards.exists(folder) from None
