"""`csac-jax train`: one run, new or resumed."""

import dataclasses
from pathlib import Path
from typing import Literal

from csac_jax.cli import failures, parsing, settings
from csac_jax.config import Config
from csac_jax.constants import EVAL_EPISODES, EVAL_SUITE
from csac_jax.errors import SettingsError
from csac_jax.io import files
from csac_jax.runtime import signals

EXAMPLES = (
    "quick                               # 2,000 actions, minutes on two cores",
    "quick --algo vpg --seed 1           # another algorithm and seed",
    "fast --init shipped_clutter         # start from the networks of a policy that ships",
    "quick --replay.sampler beta --replay.end 1 4",
    "--config my.toml --learn.tau 0.02   # settings in a file, flags win over it",
    "quick --eval-every 500 --log wandb  # evaluated during training, and tracked",
    "--resume runs/a                     # continue a run that was stopped",
)
MODULES = {"tensorboard": "tensorboardX", "wandb": "wandb", "mlflow": "mlflow"}  # of trackers


@dataclasses.dataclass(frozen=True)
class TrainOptions(settings.RunOptions):
    """Trains a policy into a new folder, or continues a run: --resume RUN."""

    run_dir: Path | None = None
    """Folder of the run, which must not exist; runs/PRESET-SEED-TIME if not given."""
    resume: Path | None = None
    """Folder of a run to continue; more --train.actions make it longer."""
    step: int | None = None
    """Checkpoint to resume from, by its step; the newest sound one if not given."""
    log: tuple[Literal["tensorboard", "wandb", "mlflow"], ...] = ()
    """Trackers that get every number, each needs the extra of its name."""
    eval_every: int = 0
    """Actions between evaluations of the current policy; RUN/best keeps the best state."""
    eval_suite: str = EVAL_SUITE
    """Suite of these evaluations, as of `csac-jax eval`."""
    eval_episodes: int = EVAL_EPISODES
    """Episodes of each part of that suite."""


def run(arguments: list[str]) -> int:
    """Trains; returns the exit code."""
    stop = signals.install()
    options, cfg = read(arguments)
    resume = options.resume is not None
    from csac_jax import api

    folder = options.resume or options.run_dir or api.new_folder(f"{cfg.preset}-{cfg.seed}")
    from csac_jax.training.trackers import TRACKERS

    try:
        api.train(
            cfg,
            folder,
            resume=resume,
            at=options.step,
            init=options.init,
            callbacks=[TRACKERS[name]() for name in options.log],
            eval_every=options.eval_every,
            eval_suite=options.eval_suite,
            eval_episodes=options.eval_episodes,
            stop=stop,
        )
    except FileExistsError:  # another process made it meanwhile
        raise failures.exists(folder) from None
    if options.json is not None:
        files.write_json(options.json, files.read_object(folder / files.RECORD))
    return stop.exit_code


def read(arguments: list[str]) -> tuple[TrainOptions, Config]:
    """Returns options and config of a run: from the command line, and from a resumed checkpoint."""
    preset, flags = settings.split(arguments)
    resumed, _ = parsing.take(flags, "--resume")
    if resumed is None or parsing.asks_help(flags):
        base = settings.base(preset, flags)
    else:
        from csac_jax.io import checkpoint

        base = checkpoint.load_config(Path(resumed))
        base = dataclasses.replace(base, preset=preset or base.preset)
    command = f"train {preset or 'PRESET'}"
    options, cfg = settings.parse(TrainOptions, command, base, flags, EXAMPLES)
    if options.step is not None and options.resume is None:
        raise SettingsError("--step: give it with --resume RUN")
    if options.resume is None:
        settings.check_new("train", preset, options.config, options.run_dir)
    elif (options.run_dir, options.init, options.config) != (None, None, None):
        raise SettingsError("--resume: a resumed run takes no --run-dir, --init or --config")
    _check(options)
    failures.check_physics(cfg)
    return options, cfg


def _check(options: TrainOptions) -> None:
    if options.eval_every < 0 or options.eval_episodes < 1:
        raise SettingsError("--eval-every, --eval-episodes: at least 1")
    if not options.eval_every and options.eval_suite != EVAL_SUITE:
        raise SettingsError("--eval-suite: give it with --eval-every N")
    for name in options.log:
        failures.check_extra(f"--log {name}", MODULES[name], name)
