"""The command `csac-jax`. Exit codes: 0 done, 1 failed, 2 bad arguments, 130 and 143 stopped by SIGINT and SIGTERM.

JAX is imported only once the arguments are known to be good, so that help and complaints come at once.
"""

import contextlib
import dataclasses
import datetime
import io
import json
import os
import re
import runpy
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NoReturn, TypeVar

import tyro

import csac_jax
from csac_jax import algorithms, presets
from csac_jax.config import Algo, Config
from csac_jax.scene.errors import SceneError
from csac_jax.train import grid, stop as stopping

Arguments = TypeVar("Arguments")

PROGRAM = "csac-jax"
RUNS = Path("runs")
BENCHMARKS = Path(csac_jax.__file__).parents[1] / "experiments" / "bench"
USAGE = f"""usage: {PROGRAM} COMMAND ...

A robot learns to push and grasp in clutter.

  train PRESET       train with a preset: {", ".join(presets.PRESETS)}
                     --algo NAME: {", ".join(algorithms.ALGORITHMS)}
  train --resume DIR go on with a run that was stopped
  sweep PRESET       train several seeds and settings side by side, in one program
                     --seeds N, --vary NAME=A,B
  eval POLICY        measure a policy: a run's folder, a policy file, or the one shipped
  play               run one episode, as text, picture and video
  report RUN...      tables and figures of recorded runs and evaluations
  export DIR FILE    write the policy of a run into one small file
  doctor             versions, devices and a self-test of this machine
  bench NAME         speed of a part, as JSON; needs a checkout of the sources

`{PROGRAM} COMMAND --help` lists the options of a command; --version prints the version.
"""


class BadArgumentsError(Exception):
    """What was asked for cannot be done; exit code 2. The message is one line with the remedy."""


class FailedError(Exception):
    """What was asked for has failed; exit code 1. The message is one line with the remedy."""


@dataclasses.dataclass(frozen=True)
class TrainOptions:
    """Trains into a new folder, or goes on with a run that was stopped. Every setting of a preset is an option."""

    run_dir: Path | None = None
    """Folder of the run, which must not exist; runs/PRESET-SEED-TIME if not given."""
    resume: Path | None = None
    """Folder of a run to go on with; PRESET and settings may be left out, else they must be the run's."""
    tensorboard: tyro.conf.FlagCreatePairsOff[bool] = False
    """Also write TensorBoard files into the folder of the run."""
    json: Path | None = None
    """File to write the result to, as JSON."""
    seed: int = 0
    """Number that all randomness of the run follows from."""
    algo: Algo = "csac_beta"
    """The algorithm: it changes settings of the preset, and settings given as options win over it."""


@dataclasses.dataclass(frozen=True)
class SweepOptions:
    """Trains several seeds, with several settings, side by side in one program; or goes on with a sweep that was
    stopped. Every setting of a preset is an option."""

    seeds: int = 4
    """Seeds of every setting: --seed, --seed + 1, ..."""
    vary: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME=A,B,...: a setting, or algo, and the values it takes; once per setting, every combination is run. Items of a
    tuple are parted by colons: replay.beta_end=1:4,1:12."""
    run_dir: Path | None = None
    """Folder of the sweep, which must not exist; runs/sweep-PRESET-TIME if not given."""
    resume: Path | None = None
    """Folder of a sweep to go on with, by itself: its settings are the sweep's."""
    shard: Literal["seeds", "scenes"] = "seeds"
    """What several devices share out: whole seeds, or the scenes and batches of each."""
    devices: int | None = None
    """Devices to use; one if not given, and with several processes all that they have."""
    coordinator: str | None = None
    """ADDRESS:PORT of the first of several processes, on one host or many; all run the same command. See
    docs/cluster.md."""
    processes: int | None = None
    """How many processes there are."""
    process_id: int | None = None
    """Number of this process, from 0."""
    cluster: tyro.conf.FlagCreatePairsOff[bool] = False
    """Join the processes of a job of SLURM, Open MPI or Kubernetes: JAX finds out where they are."""
    json: Path | None = None
    """File to write the result to, as JSON."""
    seed: int = 0
    """The first seed."""
    algo: Algo = "csac_beta"
    """The algorithm: it changes settings of the preset, and settings given as options win over it."""


@dataclasses.dataclass(frozen=True)
class EvalOptions:
    """Measures a policy in scenes that training never saw."""

    source: tyro.conf.Positional[str]
    """Folder of the run, a policy file, or shipped for the policy that comes with the package."""
    policy: Literal["learned", "random", "oracle"] = "learned"
    """What acts: the networks; a random place with a block under it; or one that reads the blocks' poses."""
    suite: str = "own"
    """Scenes: own (dropped like the training's), random10, random30 (with --physics c on a CPU), cases, target (needs a
    policy of that task), generated, or a case file."""
    physics: Literal["mjx", "c"] = "mjx"
    """What moves the blocks: MJX as in training, or C MuJoCo, the reference."""
    robot: Literal["hand", "ur5"] = "hand"
    """What moves the gripper: nothing, it floats as in training; or the arm."""
    episodes: int = 50
    """Episodes of every part of the suite, each with a fresh scene where the part has several."""
    seed: int = 0
    """Number that scenes and noise follow from; whatever it is, the scenes are none that training draws from."""
    json: Path | None = None
    """File to write the result to, as JSON."""


@dataclasses.dataclass(frozen=True)
class PlayOptions:
    """Runs one episode and says what every action did; draws it, if asked to, with no display."""

    scene: str = "random"
    """What lies on the table: random (blocks dropped anew), the name of a shipped case, or a case file."""
    robot: Literal["hand", "ur5"] = "hand"
    """What moves the gripper: nothing, it floats; or the arm."""
    policy: str = "oracle"
    """What acts: oracle (reads the blocks' poses), random (a random place above a block), shipped (learned, comes with
    the package), the folder of a run or a policy file."""
    physics: Literal["c", "mjx"] = "c"
    """What moves the blocks; with mjx, the motion between two states that a video shows is still C MuJoCo's."""
    video: Path | None = None
    """File to write a video to, such as out.mp4."""
    png: Path | None = None
    """File to write a picture of the first moment to."""
    size: tuple[int, int] = (640, 480)
    """Width and height of picture and video, px, even numbers."""
    views: bool = True
    """Show height map and action beside the scene; of a learned policy also Q of both primitives, best over yaws, and
    the candidates of its search."""
    seed: int = 0
    """Number that the scene and the policy's noise follow from."""
    json: Path | None = None
    """File to write the result to, as JSON."""


@dataclasses.dataclass(frozen=True)
class ReportOptions:
    """Brings recorded runs and evaluations together, over their seeds; reads only, needs no JAX."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of runs, or of folders of runs, and files that `eval --json` wrote."""
    out: Path | None = None
    """Folder to write a page with figures to, index.html; needs the extra `bench`."""
    json: Path | None = None
    """File to write the numbers to, as JSON."""


@dataclasses.dataclass(frozen=True)
class ExportOptions:
    """Writes the policy that a run has learned, networks and config, into one file for `eval` and `play`."""

    run_dir: tyro.conf.Positional[Path]
    """Folder of the run."""
    file: tyro.conf.Positional[Path]
    """File to write, which must not exist, such as policy.safetensors."""


@dataclasses.dataclass(frozen=True)
class DoctorOptions:
    """Prints versions, devices and the protections in force, and checks that this machine computes right.

    With --preset PRESET, and settings of it as for `train`, also the memory that such a run will take."""

    json: Path | None = None
    """File to write the result to, as JSON."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command in `argv` (without the program's name; the process's own if None); returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        return _dispatch(arguments)
    except BadArgumentsError as error:
        return _complain(2, error)
    except BrokenPipeError:  # whoever read the output, such as `head`, has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (FailedError, SceneError, OSError) as error:
        return _complain(1, error)
    except KeyboardInterrupt:
        return _complain(130, "stopped")


def _dispatch(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE, end="")
        return 0 if arguments else 2
    if arguments[0] == "--version":
        print(csac_jax.__version__)
        return 0
    if arguments[0] not in COMMANDS:
        raise BadArgumentsError(f"unknown command '{arguments[0]}'; choose one of: {', '.join(COMMANDS)}")
    return COMMANDS[arguments[0]](arguments[1:])


def _complain(code: int, error: object) -> int:
    print(f"{PROGRAM}: {' '.join(str(error).split())}", file=sys.stderr)
    return code


# Parsing.


def _sections() -> list[dataclasses.Field[Any]]:
    """The fields of Config that are groups of settings."""
    return [field for field in dataclasses.fields(Config) if dataclasses.is_dataclass(field.type)]


def _with_settings(options: type) -> Any:
    """A dataclass of these options and, as groups of flags, of every section of Config."""
    fields = [(field.name, field.type, field) for field in _sections()]
    namespace = {"__doc__": options.__doc__}
    return dataclasses.make_dataclass(
        f"_{options.__name__}", fields, bases=(options,), frozen=True, namespace=namespace
    )


_Train = _with_settings(TrainOptions)
_Sweep = _with_settings(SweepOptions)


def _parse(kind: type[Arguments], arguments: list[str], prog: str, default: Any = tyro.MISSING_NONPROP) -> Arguments:
    """`arguments` as a `kind`. Prints help and exits; bad ones raise BadArgumentsError, one line in place of a box."""
    if {"-h", "--help"} & set(arguments):
        tyro.cli(kind, prog=prog, args=["--help"], default=default)
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint), _wide_terminal():
            return tyro.cli(kind, prog=prog, args=arguments, default=default)
    except SystemExit:
        raise BadArgumentsError(_one_line(complaint.getvalue(), prog)) from None
    except ValueError as error:  # a range check of the outermost dataclass
        raise BadArgumentsError(str(error)) from None


@contextlib.contextmanager
def _wide_terminal() -> Iterator[None]:
    """Keeps tyro from breaking its messages into lines."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "1000"
    try:
        yield
    finally:
        del os.environ["COLUMNS"]
        if before is not None:
            os.environ["COLUMNS"] = before


def _one_line(box: str, prog: str) -> str:
    """The message in tyro's box of several lines, with its first suggestion."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", box)
    lines = [line.strip("│ ") for line in plain.splitlines() if not line.startswith(("╭", "╰"))]
    rules = [i for i, line in enumerate(lines) if re.fullmatch("[─-]{3,}", line)]
    if "╭" not in plain and rules:  # drawn without corners: the title stands on a line of its own, over a rule
        lines, rules = lines[rules[0] + 1 :], [i - rules[0] - 1 for i in rules[1:]]
    message = " ".join(lines[: rules[0] if rules else None]).strip().rstrip(".")
    message = re.sub(r"^Error parsing [\w.]+: (?=[\w.]+: )", "", message)
    hint = lines[lines.index("Perhaps you meant:") + 1].split()[0] if "Perhaps you meant:" in lines else None
    meant = f"; perhaps you meant {hint}" if hint else ""
    return f"{message or 'the arguments cannot be read'}{meant}; see {prog} --help"


# train.


def train(arguments: list[str]) -> int:
    """`csac-jax train`."""
    stop = stopping.install()
    options, cfg = _read_train(arguments)
    _check_memory(cfg)
    trunk = None if options.resume else _read_weights(cfg)
    run_dir = options.resume or options.run_dir or _new_run_dir(cfg)
    begun = time.time()
    summary = _train(options, cfg, run_dir, stop, trunk)
    result = {"run_dir": str(run_dir), **summary._asdict(), "wall_seconds": round(time.time() - begun, 1)}
    _write_json(options.json, result, cfg)
    _write_json(run_dir / "train.json", result, cfg)  # `report` reads it
    return stop.exit_code


def _read_train(arguments: list[str]) -> tuple[TrainOptions, Config]:
    """Options and config of a run, from the command line and, if it is resumed, from its checkpoint."""
    prog = f"{PROGRAM} train"
    named = bool(arguments) and not arguments[0].startswith("-")
    preset, flags = (arguments[0], arguments[1:]) if named else (None, arguments)
    base = _preset(preset or "quick", _value_of(flags, "--algo"))
    resumed = _value_of(flags, "--resume") if not {"-h", "--help"} & set(flags) else None
    stored = None if resumed is None else _stored_config(Path(resumed))
    base = stored or base
    sections = {field.name: getattr(base, field.name) for field in _sections()}
    defaults = _Train(seed=base.seed, algo=base.algo, **sections)
    options: Any = _parse(_Train, flags, f"{prog} {preset or 'PRESET'}", defaults)
    asked = _resolve(_build_config(preset or base.preset, options))
    if stored is not None:
        _check_resume(options, stored, asked)
    elif preset is None:
        raise BadArgumentsError(f"train: give a preset first, one of: {', '.join(presets.PRESETS)}")
    elif options.run_dir is not None and options.run_dir.exists():
        raise BadArgumentsError(f"{options.run_dir} exists; give another --run-dir, or go on with it by --resume")
    _check_physics(asked)
    if options.tensorboard:
        _require_tensorboard()
    return options, asked


def _preset(name: str, algo: str | None) -> Config:
    try:
        cfg = presets.get(name)
        return cfg if algo is None else algorithms.configure(cfg, algo)
    except ValueError as error:
        raise BadArgumentsError(str(error)) from None


def _value_of(flags: list[str], name: str) -> str | None:
    """What follows the option `name` on the command line: --resume and --algo decide the defaults of all the rest."""
    found = None
    for i, flag in enumerate(flags):
        if flag == name and i + 1 < len(flags):
            found = flags[i + 1]
        elif flag.startswith(f"{name}="):
            found = flag.removeprefix(f"{name}=")
    return found  # the last one, as the parser takes it


def _stored_config(run_dir: Path) -> Config:
    from csac_jax.train import checkpoint

    if not run_dir.is_dir():
        raise FailedError(f"there is no folder {run_dir}; give the folder of a run")
    try:
        return checkpoint.load_config(run_dir)
    except checkpoint.CheckpointError as error:
        raise FailedError(str(error)) from None


def _build_config(preset: str, options: Any) -> Config:
    sections = {field.name: getattr(options, field.name) for field in _sections()}
    try:
        return Config(preset=preset, algo=options.algo, seed=options.seed, **sections)
    except ValueError as error:
        raise BadArgumentsError(str(error)) from None


def _check_resume(options: TrainOptions, stored: Config, asked: Config) -> None:
    from csac_jax.train import config_json

    if options.run_dir is not None:
        raise BadArgumentsError("--run-dir and --resume exclude one another; a resumed run stays in its folder")
    if names := config_json.differences(stored, asked):
        raise BadArgumentsError(
            f"{options.resume} was trained with other values of {', '.join(names)}; leave them out, or begin a new run"
        )


def _resolve(cfg: Config) -> Config:
    """The config with what `auto` stands for here."""
    if cfg.sim.physics != "auto":
        return cfg  # no need of JAX
    from csac_jax.train import auto

    return auto.resolve(cfg)


def _check_physics(cfg: Config) -> None:
    if cfg.sim.physics == "c":
        raise BadArgumentsError("--sim.physics: training is one compiled program, which c is no part of; eval takes it")
    if cfg.sim.physics == "warp":
        import jax

        if jax.default_backend() != "gpu":
            raise BadArgumentsError("--sim.physics: warp computes on CUDA, and JAX sees none here; leave it at mjx")


def _check_memory(cfg: Config) -> None:
    from csac_jax.train import memory

    try:
        memory.check(cfg)
    except ValueError as error:
        raise BadArgumentsError(str(error)) from None


def _read_weights(cfg: Config) -> Any:
    """Variables of the trunk that the networks begin with, None for random ones."""
    if not cfg.net.weights:
        return None
    from csac_jax.train import weights

    try:
        return weights.read(cfg.net)
    except ValueError as error:
        raise BadArgumentsError(str(error)) from None


def _require_tensorboard() -> None:
    import importlib.util

    if importlib.util.find_spec("tensorboardX") is None:
        raise BadArgumentsError("--tensorboard needs an extra; run: pip install 'csac-jax[tensorboard]'")


def _new_run_dir(cfg: Config) -> Path:
    """A folder that does not exist yet."""
    return _new_folder(f"{cfg.preset}-{cfg.seed}")


def _new_folder(name: str) -> Path:
    """A folder under RUNS, with the time in its name, that does not exist yet."""
    stem = RUNS / f"{name}-{datetime.datetime.now():%Y%m%d-%H%M%S}"
    candidates = [stem, *(stem.with_name(f"{stem.name}-{i}") for i in range(2, 100))]
    return next(path for path in candidates if not path.exists())


def _first_line(run_dir: Path, cfg: Config) -> str:
    from csac_jax.train import provenance

    scenes = f"{cfg.train.scenes} scene{'s' if cfg.train.scenes > 1 else ''}"
    what = f"preset {cfg.preset}, algorithm {cfg.algo}, seed {cfg.seed}, {scenes}, physics {cfg.sim.physics}"
    return f"run {run_dir}: {what}, on {provenance.device()}"


def _train(options: TrainOptions, cfg: Config, run_dir: Path, stop: stopping.Stop, trunk: Any) -> Any:
    from rich.console import Console

    from csac_jax.show.progress import Group, Terminal
    from csac_jax.train import cache, checkpoint, loop, step

    cache.enable()
    with Terminal(Console()) as terminal:
        terminal.say(_first_line(run_dir, cfg))
        program = step.make(cfg)
        reporters: list[loop.Reporter] = [terminal]
        if options.tensorboard:
            from csac_jax.show.tensorboard import TensorBoard

            reporters.append(TensorBoard(run_dir))
        try:
            return loop.run(
                cfg,
                run_dir,
                lambda: step.init(program, trunk),
                lambda num_steps: step.compile_chunk(program, num_steps),
                Group(reporters),
                stop,
                resume=options.resume is not None,
            )
        except FileExistsError:
            raise BadArgumentsError(f"{run_dir} exists; give another --run-dir, or go on with it by --resume") from None
        except (loop.TrainingError, checkpoint.CheckpointError) as error:
            raise FailedError(str(error)) from None


# sweep.


def sweep(arguments: list[str]) -> int:
    """`csac-jax sweep`."""
    stop = stopping.install()
    options, plan = _read_sweep(arguments)
    folder = options.resume or options.run_dir or _new_folder(f"sweep-{plan.settings[0].cfg.preset}")
    begun = time.time()
    result = _sweep(options, plan, folder, stop)
    times = {"compile_seconds": result.compile_seconds, "wall_seconds": round(time.time() - begun, 1)}
    summary = {"run_dir": str(folder), **result.summary, **times, "stopped_by": result.stopped_by}
    from csac_jax.train import cluster

    if cluster.is_first():
        _write_json(options.json, summary, None)
        _write_json(folder / "train.json", summary, None)  # `report` reads it
    return 0 if result.stopped_by is None else 128 + result.stopped_by


def _read_sweep(arguments: list[str]) -> tuple[SweepOptions, Any]:
    """Options and plan of a sweep, from the command line or, if it is resumed, from its folder."""
    named = bool(arguments) and not arguments[0].startswith("-")
    preset, flags = (arguments[0], arguments[1:]) if named else ("quick", arguments)
    options, cfg = _parse_setting(preset, flags)
    if options.seeds < 1 or options.seed + options.seeds > 2**31:
        raise BadArgumentsError("--seeds: at least 1, and no seed may exceed 2147483647")
    _join(options)
    if options.resume is not None:
        return options, _stored_plan(options.resume, preset if named else None, options, cfg)
    if not named:
        raise BadArgumentsError(f"sweep: give a preset first, one of: {', '.join(presets.PRESETS)}")
    if options.run_dir is not None and options.run_dir.exists():
        raise BadArgumentsError(f"{options.run_dir} exists; give another --run-dir, or go on with it by --resume")
    try:
        combinations = grid.settings(options.vary)
    except ValueError as error:
        raise BadArgumentsError(str(error)) from None
    found = [(one, _parse_setting(preset, [*flags, *one.flags])[1]) for one in combinations]
    from csac_jax.train import sweep as sweeping

    settings = [sweeping.Setting(one.name, one.values, _resolve(each)) for one, each in found]
    for each in settings:
        _check_physics(each.cfg)
    plan = sweeping.Plan(options.seeds, settings)
    try:
        sweeping.check(plan)
    except (ValueError, sweeping.SweepError) as error:
        raise BadArgumentsError(str(error)) from None
    return options, plan


def _join(options: SweepOptions) -> None:
    """Joins the other processes, if there are to be several."""
    place = (options.coordinator, options.processes, options.process_id)
    if not options.cluster and place == (None, None, None):
        return
    if options.run_dir is None and options.resume is None:
        raise BadArgumentsError("sweep: several processes need --run-dir, one folder that all of them see")
    from csac_jax.train import cluster

    try:
        cluster.join(cluster.Place(*place))
    except ValueError as error:
        raise BadArgumentsError(str(error)) from None


def _parse_setting(preset: str, flags: list[str]) -> tuple[SweepOptions, Config]:
    """Options of a sweep and the config of a setting, whose flags are the last ones."""
    base = _preset(preset, _value_of(flags, "--algo"))
    sections = {field.name: getattr(base, field.name) for field in _sections()}
    options = _parse(_Sweep, flags, f"{PROGRAM} sweep {preset}", _Sweep(algo=base.algo, **sections))
    return options, _build_config(preset, options)


def _stored_plan(folder: Path, preset: str | None, options: SweepOptions, cfg: Config) -> Any:
    from csac_jax.train import sweep as sweeping

    if preset or options.vary or options.run_dir or options.seeds != SweepOptions.seeds or cfg != presets.get("quick"):
        raise BadArgumentsError("sweep --resume: a sweep goes on with its own settings; leave all others out")
    try:
        return sweeping.read_plan(folder)
    except sweeping.SweepError as error:
        raise FailedError(str(error)) from None


def _sweep(options: SweepOptions, plan: Any, folder: Path, stop: stopping.Stop) -> Any:
    from rich.console import Console

    from csac_jax.show.progress import Terminal
    from csac_jax.train import cache, checkpoint, cluster, loop, members, mesh, sweep as sweeping

    cache.enable()
    try:
        line = mesh.make(options.devices)
        for one in plan.settings:
            mesh.check(line, options.shard, plan.seeds, one.cfg.train.scenes, one.cfg.learn.batch)
        sweeping.check_memory(plan, 1 if line is None or options.shard == "scenes" else line.size)
    except ValueError as error:
        raise BadArgumentsError(str(error)) from None
    trunks = {one.cfg.net: _read_weights(one.cfg) for one in plan.settings}

    def engine(group: members.Group) -> sweeping.Engine:
        return members.engine(group, line, options.shard, trunks[group.configs[0].net])

    with Terminal(Console(quiet=not cluster.is_first())) as terminal:
        terminal.say(f"sweep {folder}")
        try:
            result = sweeping.run(plan, folder, engine, terminal, stop, resume=options.resume is not None)
        except FileExistsError:
            raise BadArgumentsError(f"{folder} exists; give another --run-dir, or go on with it by --resume") from None
        except (sweeping.SweepError, loop.TrainingError, checkpoint.CheckpointError) as error:
            raise FailedError(str(error)) from None
        for one in result.summary["settings"]:
            terminal.say(f"{one['name']}: {_seeds_line(one['grasp_success'])}")
    return result


def _seeds_line(success: dict[str, Any]) -> str:
    if not success["n"]:
        return "no seed is done"
    interval = f" (95 % interval {_interval(success)})" if success["low"] is not None else ""
    return f"grasp success {_percent(success['value'])}{interval}, interquartile mean of {success['n']} seeds"


# eval.


def evaluate(arguments: list[str]) -> int:
    """`csac-jax eval`."""
    options = _parse(EvalOptions, arguments, f"{PROGRAM} eval")
    if options.episodes < 1:
        raise BadArgumentsError("--episodes: at least 1")
    if not 0 <= options.seed < 2**31 - 1:
        raise BadArgumentsError("--seed: must lie in 0 .. 2147483646")
    stored, networks = _learned(options.source)
    cfg = dataclasses.replace(stored, sim=dataclasses.replace(stored.sim, physics=options.physics, robot=options.robot))
    begun = time.time()
    parts = _evaluate(options, cfg, networks)
    seconds = round(time.time() - begun, 1)
    for part, summary in parts.items():
        _print_summary(f"{options.policy} in {options.episodes} episodes of {part}, seed {options.seed}", summary)
    asked = {name: getattr(options, name) for name in ("policy", "suite", "seed")}
    one = next(iter(parts.values())) if len(parts) == 1 else {"parts": parts}
    _write_json(options.json, {**asked, "seconds": seconds, **one}, cfg)
    return 0


def _learned(source: str) -> tuple[Config, Callable[[], Any]]:
    """Config of the policy in a run's folder, in a policy file or `shipped`, and what reads its networks."""
    from csac_jax.train import checkpoint, policy_file, step

    path = policy_file.SHIPPED if source == "shipped" else Path(source)
    try:
        if path.is_file():
            cfg, params = policy_file.load(path)
            return cfg, lambda: params
    except policy_file.PolicyFileError as error:
        raise FailedError(str(error)) from None
    cfg = _stored_config(path)

    def read() -> Any:
        try:
            return checkpoint.restore(path, step.abstract_state(cfg))[0].learner.online
        except checkpoint.CheckpointError as error:
            raise FailedError(str(error)) from None

    return cfg, read


def _evaluate(options: EvalOptions, cfg: Config, networks: Callable[[], Any]) -> dict[str, dict[str, Any]]:
    """Metrics of every part of the suite."""
    from csac_jax.train import cache, evaluate, metrics, suites

    cache.enable()
    try:
        parts = suites.environments(cfg, options.suite, options.episodes, options.seed, options.policy)
    except ValueError as error:
        raise BadArgumentsError(str(error)) from None
    params = networks() if options.policy == "learned" else None
    return {
        name: metrics.summarise(evaluate.rollout(env.cfg, env, options.policy, params, options.episodes, options.seed))
        for name, env in parts.items()
    }


# play.


def play(arguments: list[str]) -> int:
    """`csac-jax play`."""
    options = _parse(PlayOptions, arguments, f"{PROGRAM} play")
    _check_play(options)
    drawn, opengl = options.png is not None or options.video is not None, None
    if drawn:
        from csac_jax.show import gl

        opengl = gl.choose()  # before MuJoCo is imported
    learned = options.policy not in ("oracle", "random")
    cfg, networks = _learned(options.policy) if learned else (presets.quick(), None)
    cfg = dataclasses.replace(cfg, sim=dataclasses.replace(cfg.sim, physics=options.physics, robot=options.robot))
    begun = time.time()
    cfg, moments = _play(options, cfg, networks)
    from csac_jax.show import play as playing

    print(playing.summary(moments))
    if drawn:
        stage = playing.Stage(cfg, moments[0].before, options.size, opengl, options.views)
        playing.record(stage, moments, options.png, options.video)
    last = moments[-1].after
    result = {
        "scene": options.scene,
        "policy": options.policy,
        "renderer": (opengl or "rays") if drawn else None,
        "actions": len(moments),
        "cleared": sum(int(moment.after.info.cleared) for moment in moments),
        "completed": bool(last.terminated),
        "seconds": round(time.time() - begun, 1),
    }
    _write_json(options.json, result, cfg)
    return 0


def _check_play(options: PlayOptions) -> None:
    if not 0 <= options.seed < 2**31 - 1:
        raise BadArgumentsError("--seed: must lie in 0 .. 2147483646")
    if not all(side % 2 == 0 and 16 <= side <= 4096 for side in options.size):
        raise BadArgumentsError("--size: both numbers must be even and lie in 16 .. 4096 px")
    if options.video is not None:
        import importlib.util

        if importlib.util.find_spec("imageio_ffmpeg") is None:
            raise BadArgumentsError("--video needs an extra; run: pip install 'csac-jax[video]'")


def _play(options: PlayOptions, cfg: Config, networks: Callable[[], Any] | None) -> tuple[Config, list[Any]]:
    """The scene's config and the moments of the episode, each printed as it happens."""
    from csac_jax.show import play as playing
    from csac_jax.train import cache, evaluate, suites

    cache.enable()
    try:
        suite = "own" if options.scene == "random" else str(_case_file(options.scene))
        (env,) = suites.environments(cfg, suite, 1, options.seed).values()
    except ValueError as error:
        raise BadArgumentsError(str(error)) from None
    params = None if networks is None else networks()
    moments: list[Any] = []
    name = options.policy if networks is None else "learned"
    for moment in evaluate.episode(env.cfg, env, name, params, options.seed):
        moments.append(moment)
        print(playing.line(len(moments), moment), flush=True)
    return env.cfg, moments


def _case_file(scene: str) -> Path:
    """File of a shipped case by name, or the user's own. Raises ValueError if there is neither."""
    from csac_jax.scene import cases

    if scene in cases.names():
        return cases.shipped(scene)
    if Path(scene).is_file():
        return Path(scene)
    raise ValueError(f"--scene: '{scene}' is neither a case file nor one of: random, {', '.join(cases.names())}")


# eval, continued: how results are printed.


def _print_summary(title: str, summary: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("metric", "value", "95 % interval", "n", title=title)
    for name, entry in {**summary, **summary.get("failures", {})}.items():
        if "value" in entry:
            shown = ("-", "-") if entry["n"] == 0 else (_percent(entry["value"]), _interval(entry))
            table.add_row(name, *shown, str(entry["n"]))
    console = Console()
    console.print(table)
    for name in ("outcomes", "counts"):
        console.print(
            f"{name}: " + ", ".join(f"{key} {count}" for key, count in summary[name].items()), highlight=False
        )


def _percent(value: float) -> str:
    return f"{100 * value:.1f} %"


def _interval(entry: dict[str, Any]) -> str:
    return f"{100 * entry['low']:.1f} .. {100 * entry['high']:.1f} %"


# report.


def report(arguments: list[str]) -> int:
    """`csac-jax report`."""
    options = _parse(ReportOptions, arguments, f"{PROGRAM} report")
    if not options.runs:
        raise BadArgumentsError("report: give at least one folder of a run, or a file of `eval --json`")
    if options.out is not None:
        import importlib.util

        if importlib.util.find_spec("matplotlib") is None:
            raise BadArgumentsError("--out needs an extra; run: pip install 'csac-jax[bench]'")
    from csac_jax.show import report as reporting, results

    try:
        found = reporting.build(results.read(options.runs))
    except ValueError as error:
        raise BadArgumentsError(str(error)) from None
    if not (found.curves or found.scores):
        raise FailedError("; ".join(found.notes))
    print(reporting.markdown(found), end="")
    for path in reporting.write(found, options.out) if options.out is not None else ():
        print(path)
    if options.json is not None:
        _replace_text(options.json, reporting.as_json(found))
    return 0


# export.


def export(arguments: list[str]) -> int:
    """`csac-jax export`."""
    options = _parse(ExportOptions, arguments, f"{PROGRAM} export")
    if options.file.suffix != ".safetensors":
        raise BadArgumentsError(f"{options.file}: the name of a policy file ends in .safetensors")
    if options.file.exists():
        raise BadArgumentsError(f"{options.file} exists; give another name")
    from csac_jax.train import policy_file

    cfg, networks = _learned(str(options.run_dir))
    policy_file.save(options.file, networks(), cfg)
    print(f"wrote {options.file}, {options.file.stat().st_size} bytes")
    return 0


# doctor.


def doctor(arguments: list[str]) -> int:
    """`csac-jax doctor`."""
    own, cfg = _split_doctor(arguments)
    options = _parse(DoctorOptions, own, f"{PROGRAM} doctor")
    needs = {} if cfg is None else _print_memory(cfg)
    with _watchdog(90.0, "the self-test hangs: too few threads for batched MJX? Set PJRT_NPROC=8 and try again"):
        from csac_jax import _guard
        from csac_jax.train import compiler, provenance, selftest

        record = provenance.record()
        print(f"device     {record['device']}")
        print("versions   " + ", ".join(f"{name} {version}" for name, version in provenance.versions().items()))
        print(f"commit     {record['commit'] or 'none'}")
        variable, threads = _guard.pool_setting()
        guarded = threads >= _guard.MIN_THREADS
        remedy = f"batched MJX may hang; set {_guard.POOL_VARIABLE}={_guard.MIN_THREADS}"
        verdict = "enough for batched MJX" if guarded else remedy
        print(f"XLA flags  {os.environ.get('XLA_FLAGS') or 'none'}")
        print(f"threads    {threads} in JAX's pool on the CPU, by {variable}: {verdict}")
        fast = compiler.has_library()
        print(f"training   convolutions by XLA's {'second library' if fast else 'default library'}")
        begun = time.perf_counter()
        checks = selftest.run()
    for check in checks:
        print(
            f"{'ok' if check.passed else 'FAILED':<10} {check.name}: error {check.error:.1e}, bound {check.bound:.0e}"
        )
    print(f"self-test  {time.perf_counter() - begun:.1f} s")
    pool = {"variable": variable, "threads": threads, "guarded": guarded}
    tests = [{**check._asdict(), "passed": check.passed} for check in checks]
    guard = {"thread_pool": pool, "xla_flags": os.environ.get("XLA_FLAGS", ""), "second_library": fast}
    _write_json(options.json, {**guard, "self_test": tests, **needs}, cfg)
    failed = [check.name for check in checks if not check.passed]
    if failed:
        raise FailedError(f"self-test failed: {'; '.join(failed)}; do not trust results of these versions here")
    return 0


def _split_doctor(arguments: list[str]) -> tuple[list[str], Config | None]:
    """The arguments of `doctor` itself, and the config that the others ask for, if a preset is among them."""
    preset = _value_of(arguments, "--preset")
    if {"-h", "--help"} & set(arguments):
        return ["--help"], None
    if preset is None:
        if "--preset" in arguments:
            raise BadArgumentsError(f"doctor: give a preset after --preset, one of: {', '.join(presets.PRESETS)}")
        return arguments, None
    own: list[str] = []
    others: list[str] = []
    group: list[str] = []  # where an option and its values go
    for word in arguments:
        if word.startswith("--"):
            name = word.split("=")[0]
            group = {"--json": own, "--preset": []}.get(name, others)
        group.append(word)
    return own, _read_train([preset, *others])[1]


def _print_memory(cfg: Config) -> dict[str, Any]:
    """Prints what a run will hold in memory; returns it for the JSON."""
    from csac_jax.train import memory

    parts, available = memory.predict(cfg), memory.limit()
    total = sum(parts.values())
    listed = ", ".join(f"{name} {size / memory.GIB:.2f}" for name, size in parts.items())
    print(f"memory     {total / memory.GIB:.2f} GiB of {available / memory.GIB:.1f} for {cfg.preset}: {listed}")
    stages = memory.stages(cfg)
    print(f"           step: {', '.join(f'{name} {size / memory.GIB:.2f}' for name, size in stages.items())}")
    return {"memory": {"bytes": parts, "step_bytes": stages, "limit_bytes": available}}


# bench.


def bench(arguments: list[str]) -> int:
    """`csac-jax bench`: runs `main` of a script in the checkout."""
    scripts = {path.stem: path for path in BENCHMARKS.glob("[!_]*.py")}
    if not scripts:
        raise BadArgumentsError(f"bench: there is nothing in {BENCHMARKS}; benchmarks come with a checkout")
    names = ", ".join(sorted(scripts))
    if arguments[:1] in (["-h"], ["--help"]):
        print(f"usage: {PROGRAM} bench NAME ..., with NAME one of: {names}")
        return 0
    name, *rest = arguments or [""]
    if name not in scripts:
        raise BadArgumentsError(f"bench: unknown benchmark '{name}'; choose one of: {names}")
    runpy.run_path(str(scripts[name]))["main"](rest)
    return 0


@contextlib.contextmanager
def _watchdog(seconds: float, message: str) -> Iterator[None]:
    """Ends the process with `message` if the block takes longer than `seconds`."""
    import threading

    def bark() -> NoReturn:
        _complain(1, message)
        os._exit(1)

    timer = threading.Timer(seconds, bark)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _write_json(path: Path | None, result: dict[str, Any], cfg: Config | None) -> None:
    """Writes a result with its provenance; the file appears all at once."""
    if path is None:
        return
    from csac_jax.train import config_json, provenance

    config = {} if cfg is None else {"config": config_json.to_dict(cfg)}
    _replace_text(path, {**result, **config, **provenance.record()})


def _replace_text(path: Path, content: dict[str, Any]) -> None:
    text = json.dumps(content, indent=2) + "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_text(text)
    temporary.replace(path)


COMMANDS: dict[str, Callable[[list[str]], int]] = {
    "train": train,
    "sweep": sweep,
    "eval": evaluate,
    "play": play,
    "report": report,
    "export": export,
    "doctor": doctor,
    "bench": bench,
}
