"""`csac-jax train`: one run, new or resumed."""

import dataclasses
import time
from pathlib import Path

import tyro

from csac_jax.cli import failures, output, parsing, settings
from csac_jax.cli.failures import BadArgumentsError
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
    step: int | None = None
    """Checkpoint to resume from, by its step; the newest sound one if not given."""
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
    if parsing.SHORT_HELP.intersection(arguments):
        settings.print_help(TrainOptions, "train", EXAMPLES, arguments)
        return 0
    stop = signals.install()
    options, cfg = read(arguments)
    begun, resume = time.time(), options.resume is not None
    from csac_jax import api

    folder = options.resume or options.run_dir or api.new_folder(f"{cfg.preset}-{cfg.seed}")
    reporters = []
    if options.tensorboard:
        from csac_jax.report.progress import TensorBoard

        reporters.append(TensorBoard(folder))
    try:
        done = api.train(
            cfg,
            folder,
            resume=resume,
            at=options.step,
            init=options.init,
            reporters=reporters,
            stop=stop,
        )
    except FileExistsError:  # somebody has made it meanwhile
        raise failures.exists(folder) from None
    seconds = round(time.time() - begun, 1)
    result = {"run_dir": str(folder), **done.summary._asdict(), "wall_seconds": seconds}
    for path in (folder / "train.json", options.json):  # `report` reads the first
        output.write_result(path, result, done.cfg)
    return stop.exit_code


def read(arguments: list[str]) -> tuple[TrainOptions, Config]:
    """Options and config of a run, from the command line and, if it is resumed, its checkpoint."""
    preset, flags = settings.split(arguments)
    resumed, _ = parsing.take(flags, "--resume")
    if resumed is None or parsing.asks_help(flags):
        base = settings.preset(preset or "quick", flags)
    else:
        from csac_jax.io import checkpoint

        base = checkpoint.load_config(Path(resumed))
        base = dataclasses.replace(base, preset=preset or base.preset)
    options, cfg = settings.parse(TrainOptions, f"train {preset or 'PRESET'}", base, flags)
    if options.step is not None and options.resume is None:
        raise BadArgumentsError("--step: give it with --resume RUN")
    if options.resume is None:
        settings.check_new("train", preset, options.run_dir)
    elif options.run_dir is not None or options.init is not None:
        raise BadArgumentsError("--resume: a resumed run takes neither --run-dir nor --init")
    failures.check_physics(cfg)
    if options.tensorboard:
        failures.check_extra("--tensorboard", "tensorboardX", "tensorboard")
    return options, cfg
