"""`csac-jax train`: one run, new or resumed."""

import dataclasses
import time
from pathlib import Path
from typing import Any

import tyro

from csac_jax.cli import guards, output, parsing, settings, stored
from csac_jax.cli.errors import BadArgumentsError, as_bad_arguments, as_failure
from csac_jax.config import Algo, Config
from csac_jax.runtime import signals as stopping


@dataclasses.dataclass(frozen=True)
class TrainOptions:
    """Trains into a new folder, or goes on with a run that was stopped. Every setting of a preset
    is an option."""

    run_dir: Path | None = None
    """Folder of the run, which must not exist; runs/PRESET-SEED-TIME if not given."""
    resume: Path | None = None
    """Folder of a run to go on with; PRESET and settings may be left out, else they must be the
    run's."""
    tensorboard: tyro.conf.FlagCreatePairsOff[bool] = False
    """Also write TensorBoard files into the folder of the run."""
    json: Path | None = None
    """File to write the result to, as JSON."""
    seed: int = 0
    """Number that all randomness of the run follows from."""
    algo: Algo = "csac_beta"
    """The algorithm: it changes settings of the preset, and settings given as options win over
    it."""


_Options = settings.with_sections(TrainOptions)


def run(arguments: list[str]) -> int:
    """Trains; returns the exit code."""
    stop = stopping.install()
    options, cfg = read(arguments)
    _check_memory(cfg)
    trunk = None if options.resume else stored.weights(cfg)
    run_dir = options.resume or options.run_dir or new_run_dir(cfg)
    begun = time.time()
    summary = _train(options, cfg, run_dir, stop, trunk)
    result = {
        "run_dir": str(run_dir),
        **summary._asdict(),
        "wall_seconds": round(time.time() - begun, 1),
    }
    output.write_result(options.json, result, cfg)
    output.write_result(run_dir / "train.json", result, cfg)  # `report` reads it
    return stop.exit_code


def read(arguments: list[str]) -> tuple[TrainOptions, Config]:
    """Options and config of a run, from the command line and, if it is resumed, from its
    checkpoint."""
    preset, flags = settings.split(arguments)
    base = settings.preset(preset or "quick", flags)
    resumed = None if parsing.asks_help(flags) else parsing.value_of(flags, "--resume")
    trained = None if resumed is None else stored.config(Path(resumed))
    if trained is not None:
        base = dataclasses.replace(trained, preset=preset or trained.preset)
    options, cfg = settings.parse(_Options, f"train {preset or 'PRESET'}", base, flags)
    cfg = settings.resolve(cfg)
    if trained is not None:
        _check_resume(options, trained, cfg)
    elif preset is None:
        raise BadArgumentsError(f"train: give a preset first, one of: {settings.PRESETS}")
    else:
        guards.check_new(options.run_dir)
    guards.check_physics(cfg)
    if options.tensorboard:
        guards.check_extra("--tensorboard", "tensorboardX", "tensorboard")
    return options, cfg


def new_run_dir(cfg: Config) -> Path:
    """A folder for a run that does not exist yet."""
    return output.new_folder(f"{cfg.preset}-{cfg.seed}")


def first_line(run_dir: Path, cfg: Config) -> str:
    """What is run, and on what."""
    from csac_jax.runtime import provenance

    scenes = f"{cfg.train.scenes} scene{'s' if cfg.train.scenes > 1 else ''}"
    what = f"preset {cfg.preset}, algorithm {cfg.algo}, seed {cfg.seed}, {scenes}, physics {cfg.sim.physics}"
    return f"run {run_dir}: {what}, on {provenance.device()}"


def _check_resume(options: TrainOptions, trained: Config, asked: Config) -> None:
    from csac_jax.io import config_json

    if options.run_dir is not None:
        raise BadArgumentsError(
            "--run-dir and --resume exclude one another; a resumed run stays in its folder"
        )
    if names := config_json.differences(trained, asked):
        raise BadArgumentsError(
            f"{options.resume} was trained with other values of {', '.join(names)}; leave them out, or begin a new run"
        )


def _check_memory(cfg: Config) -> None:
    from csac_jax.training import memory

    with as_bad_arguments(ValueError):
        memory.check(cfg)


def _train(
    options: TrainOptions, cfg: Config, run_dir: Path, stop: stopping.Stop, trunk: Any
) -> Any:
    from rich.console import Console

    from csac_jax.io import checkpoint
    from csac_jax.report.progress import Reporters, Terminal
    from csac_jax.runtime import cache
    from csac_jax.training import loop, step

    cache.enable()
    with (
        Terminal(Console()) as terminal,
        as_failure(loop.TrainingError, checkpoint.CheckpointError),
    ):
        terminal.say(first_line(run_dir, cfg))
        program = step.make(cfg)
        reporters: list[loop.Reporter] = [terminal]
        if options.tensorboard:
            from csac_jax.report.tensorboard import TensorBoard

            reporters.append(TensorBoard(run_dir))
        try:
            return loop.run(
                cfg,
                run_dir,
                lambda: step.init(program, trunk),
                lambda num_steps: step.compile_chunk(program, num_steps),
                Reporters(reporters),
                stop,
                resume=options.resume is not None,
            )
        except FileExistsError:
            raise guards.exists(run_dir) from None
