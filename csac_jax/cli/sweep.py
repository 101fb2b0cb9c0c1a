"""`csac-jax sweep`: several seeds and settings side by side."""

import dataclasses
from pathlib import Path
from typing import Any, Literal

import tyro

from csac_jax import presets
from csac_jax.cli import failures, settings
from csac_jax.cli.parsing import PROGRAM
from csac_jax.config import Config
from csac_jax.errors import SettingsError
from csac_jax.io import files
from csac_jax.runtime import signals
from csac_jax.sweeps import grid

EXAMPLES = (
    "quick --seeds 8",
    "quick --seeds 4 --vary replay.sampler=uniform,beta --vary learn.tau=0.01,0.02",
    "fast --seeds 4 --devices 4 --init shipped_clutter",
    "paper_small --vary algo=csac,csac_beta --vary task=clear,packed --evaluate 500",
)


@dataclasses.dataclass(frozen=True)
class SweepOptions(settings.RunOptions):
    """Trains several seeds with several settings side by side in one program.

    --resume continues a sweep that was stopped. Every setting of a preset is an option."""

    seeds: int = 4
    """Seeds of every setting: --seed, --seed + 1, ..."""
    vary: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME=A,B,...: a setting, algo, task (clear, target, packed) or switch (none, sensed,
    anywhere, oblique, noisy, ur5, together), and its values. Every combination is run. Colons
    separate a tuple's items: replay.end=1:4,1:12."""
    evaluate: int = 0
    """Episodes to evaluate every final policy in, for the tables of the sweep's study.md."""
    together: int = 0
    """Runs in one program, at most: fewer need less memory. 0: all that can be."""
    run_dir: Path | None = None
    """Folder of the sweep, which must not exist; runs/sweep-PRESET-TIME if not given."""
    resume: Path | None = None
    """Folder of a sweep to continue, without other options: its settings are the sweep's."""
    shard: Literal["seeds", "scenes"] = "seeds"
    """Division among several devices: seeds, or the scenes and batches of each seed."""
    devices: int | None = None
    """Devices to use; by default one, with several processes all of theirs."""
    coordinator: str | None = None
    """ADDRESS:PORT of the first of several processes of the same command; see docs/cluster.md."""
    processes: int | None = None
    """Number of processes."""
    process_id: int | None = None
    """Number of this process, from 0."""
    cluster: tyro.conf.FlagCreatePairsOff[bool] = False
    """Join the processes of a job of SLURM, Open MPI or Kubernetes, which JAX finds by itself."""


def run(arguments: list[str]) -> int:
    """Trains all; returns the exit code."""
    stop = signals.install()
    options, plan = read(arguments)
    resume = options.resume is not None
    from csac_jax import api
    from csac_jax.runtime import cluster

    name = f"sweep-{plan.points[0].cfg.preset}"
    folder = options.resume or options.run_dir or api.new_folder(name)
    asked = (options.devices, options.shard, options.init)
    try:
        result = api.run_sweep(plan, folder, *asked, verbose=True, stop=stop, resume=resume)
    except FileExistsError:  # another process made it meanwhile
        raise failures.exists(folder) from None
    if cluster.is_first():
        _report(result)
        if options.json is not None:
            files.write_json(options.json, files.read_object(folder / files.RECORD))
        if plan.episodes and result.stopped_by is None:
            _write_study(folder)
    return 0 if result.stopped_by is None else 128 + result.stopped_by


def _report(result: Any) -> None:
    from csac_jax.evaluation.statistics import Band
    from csac_jax.report import cells

    for point in result.summary["settings"]:
        band = Band(**point["grasp_success"])
        success = cells.shown(metric="grasp_success", band=band) if band.n else "unknown"
        print(f"{point['name']}: grasp success {success}, interquartile mean of {band.n} seeds")


def _write_study(folder: Path) -> None:
    from csac_jax.report import comparison, result_tables, results

    tables = result_tables.markdown(comparison.build(results.read([folder])))
    head = f"# Study\n\nWritten by `{PROGRAM} sweep --resume {folder}`.\n\n"
    files.replace(folder / "study.md", head + tables)
    print(f"tables: {folder / 'study.md'}")


def read(arguments: list[str]) -> tuple[SweepOptions, Any]:
    """Returns options and plan of a sweep: from the command line, or from a resumed folder."""
    preset, flags = settings.split(arguments)
    options, cfg = _parse(preset, flags)
    if options.seeds < 1 or options.seed + options.seeds > 2**31:
        raise SettingsError("--seeds: at least 1, and no seed may exceed 2147483647")
    _join(options)
    if options.resume is None:
        settings.check_new("sweep", preset, options.config, options.run_dir)
        return options, _new_plan(preset, flags, options)
    given = (preset, options.vary, options.run_dir, options.evaluate, options.config)
    if any(given) or options.seeds != SweepOptions.seeds or cfg != presets.get("quick"):
        raise SettingsError("sweep --resume: a sweep keeps its own settings; leave all others out")
    from csac_jax.sweeps import runner

    return options, runner.read_plan(options.resume)


def _parse(preset: str | None, flags: list[str]) -> tuple[SweepOptions, Config]:
    """Returns options of a sweep and the config of a point, whose own flags come last."""
    command = f"sweep {preset or 'PRESET'}"
    return settings.parse(SweepOptions, command, settings.base(preset, flags), flags, EXAMPLES)


def _join(options: SweepOptions) -> None:
    place = (options.coordinator, options.processes, options.process_id)
    if not options.cluster and place == (None, None, None):
        return
    if options.run_dir is None and options.resume is None:
        raise SettingsError("sweep: several processes need --run-dir, a folder that all share")
    from csac_jax.runtime import cluster

    cluster.join(*place)


def _new_plan(preset: str | None, flags: list[str], options: SweepOptions) -> Any:
    points = grid.points(options.vary, lambda own: _parse(preset, [*flags, *own])[1])
    from csac_jax.sim import backend  # with JAX, so after those errors
    from csac_jax.sweeps import runner

    devices, runs = _devices(options), options.seeds * len(points)  # at most so many side by side
    runs = min(runs, options.together or runs)
    points = [one._replace(cfg=backend.resolve(one.cfg, devices, runs)) for one in points]
    for point in points:
        failures.check_physics(point.cfg, devices)
    plan = runner.SweepPlan(options.seeds, points, options.evaluate, options.together)
    runner.check_plan(plan)
    runner.groups_of(plan._replace(seeds=1))
    return plan


def _devices(options: SweepOptions) -> int:
    """Returns the devices of a sweep, of other processes too; 2 stands for several."""
    alone = options.processes in (None, 1) and not options.cluster
    return (options.devices or 1) if alone else 2
