"""The functions of the public API; the package root exports them."""

import dataclasses
import datetime
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
from rich.console import Console

from csac_jax import algorithms
from csac_jax.agent import actor_critic
from csac_jax.agent.learner import Learner
from csac_jax.config import Config, DenseNet121, SmallNet
from csac_jax.constants import EVAL_EPISODES, EVAL_SUITE
from csac_jax.errors import SettingsError
from csac_jax.evaluation import monitor, policies, rollout
from csac_jax.io import files, leaves, lock, policy_file, weights
from csac_jax.replay.samplers import Sampler
from csac_jax.runtime import cache, cluster, provenance, short, signals
from csac_jax.section import require
from csac_jax.sim import backend
from csac_jax.sweeps import final, grid, replicas, runner
from csac_jax.sweeps.runner import SweepPlan, SweepResult
from csac_jax.training import loop, memory, own_parts, programs, sharding, split_step
from csac_jax.training.callbacks import Callback, FunctionCallback, Record, RunRecord, Summary
from csac_jax.training.own_parts import OwnParts
from csac_jax.training.progress import Terminal
from csac_jax.training.step import TrainState
from csac_jax.training.transitions import StepMetrics

RUNS = Path("runs")
evaluate = rollout.evaluate
load_policy = policies.load


class Run(NamedTuple):
    """A run that has ended or was stopped."""

    run_dir: Path
    cfg: Config
    summary: Summary
    parts: dict[str, Any]  # the network and learner given, as `load_policy` takes them

    def __repr__(self) -> str:
        return short.text(self)

    @property
    def policy(self) -> policies.Policy:
        """Returns the policy of the last checkpoint."""
        return load_policy(self.run_dir, **self.parts)


def train(
    cfg: Config,
    run_dir: str | Path | None = None,
    *,
    resume: bool = False,
    at: int | None = None,
    init: str | Path | None = None,
    sampler: Sampler | None = None,
    network: Any = None,
    learner: Learner | None = None,
    callbacks: Sequence[Callback | Callable[[Record], None]] = (),
    eval_every: int = 0,
    eval_suite: str = EVAL_SUITE,
    eval_episodes: int = EVAL_EPISODES,
    verbose: bool = True,
    stop: signals.Stop | None = None,
) -> Run:
    """Trains until the config's actions are done, or until `stop`; logs and saves in `run_dir`.

    Args: run_dir, a folder that does not exist, by default runs/PRESET-SEED-TIME. resume, continues
    the run in `run_dir`; only `train.actions` may differ, and be larger. at, step of the
    checkpoint to resume from, by default the newest sound one. init, networks to start from:
    "shipped", a run's folder, a policy file, or torchvision's weights of DenseNet-121 as
    .safetensors. sampler, network (a Flax module, see `nets.networks`) and learner: parts of your
    own, which the run's config names and a resumed run needs again. callbacks, each a `Callback` or
    a function of the `Record` of each chunk. eval_every, actions between evaluations in
    eval_episodes episodes of eval_suite, see `evaluate`, with the best state saved, see
    `load_policy`; a resumed run continues them.
    Raises SettingsError for settings that do not fit, FileExistsError for a folder that exists,
    TrainingError for a loss or parameter that is not finite, CheckpointError for nothing sound to
    resume or a disc that is full, LockedError for a run that another process trains.
    """
    own = OwnParts(sampler, network, learner)
    own_parts.check(own, init)
    cfg = own_parts.named(backend.resolve(cfg), own)
    memory.check(cfg)
    folder = new_folder(f"{cfg.preset}-{cfg.seed}") if run_dir is None else Path(run_dir)
    if resume:
        loop.check_resumable(cfg, folder, at)
    start = initial_networks(cfg, init)
    plan = monitor.read_plan(folder) if resume and not eval_every else None
    if eval_every:
        plan = monitor.EvalPlan(eval_every, eval_suite, eval_episodes)
        plan.check()
    cache.enable()
    with Terminal(Console(quiet=not verbose)) as terminal:
        terminal.log(_first_line(folder, cfg))
        program = programs.make(cfg, **own._asdict())
        called = [one if isinstance(one, Callback) else FunctionCallback(one) for one in callbacks]
        called.append(RunRecord())
        if plan is not None:
            policy = lambda state: policies.policy_from_state(cfg, state, network, learner)  # noqa: E731
            called.append(monitor.Monitor(cfg, plan, policy, called[:], terminal.log))
        begin = programs.compile_init(program)

        def first_state() -> TrainState:
            state = begin()
            programs.prepare(program)
            return state if start is None else state.replace(learner=start(state.learner))

        compile_chunk = functools.partial(
            split_step.compile_chunk, program, cached=own == own_parts.NO_PARTS
        )
        stop = stop or signals.Stop()
        summary = loop.run(
            cfg, folder, first_state, compile_chunk, terminal, stop, resume, at, called
        )
    return Run(folder, cfg, summary, {"network": network, "learner": learner})


def train_fn(
    cfg: Config,
    *,
    sampler: Sampler | None = None,
    network: Any = None,
    learner: Learner | None = None,
) -> Callable[[jax.Array], tuple[TrainState, StepMetrics]]:
    """Returns a pure function from a key to a run's last state and its metrics [T, ...].

    It does all steps of `train` with `jax.random.key(seed)`, without log or checkpoint, in any
    physics. Jit it, and vmap it over keys: `jax.jit(jax.vmap(train_fn(cfg)))(keys)`. T = steps.
    """
    own = OwnParts(sampler, network, learner)
    own_parts.check(own)
    cfg = own_parts.named(backend.resolve(cfg), own)
    program = programs.make(cfg, **own._asdict())

    def run(key: jax.Array) -> tuple[TrainState, StepMetrics]:
        return programs.run_steps(program, loop.total_steps(cfg), programs.init_state(program, key))

    return run


def sweep(
    cfg: Config,
    seeds: int = 4,
    vary: Mapping[str, Sequence[Any]] | None = None,
    run_dir: str | Path | None = None,
    *,
    devices: int | None = None,
    shard: sharding.Shard = "seeds",
    init: str | Path | None = None,
    sampler: Sampler | None = None,
    network: Any = None,
    learner: Learner | None = None,
    episodes: int = 0,
    together: int = 0,
    resume: bool = False,
    verbose: bool = True,
    stop: signals.Stop | None = None,
) -> dict[str, Any]:
    """Trains several seeds, with every combination of settings, side by side in one program.

    Args: seeds, cfg.seed and those after it. vary, values by dotted setting, "algo" or "task", as
    in {"learn.tau": (0.01, 0.02)}. run_dir, a folder that does not exist. devices, how many to use;
    shard, what they divide: the seeds, or the scenes of each seed. sampler, network, learner: parts
    of your own, see `train`. episodes, that every final policy is evaluated in. together, runs in
    one program at most, to need less memory; 0 for all that can be. resume, continues the sweep in
    run_dir, which has the same settings. Returns: the summary, grasp success of every combination
    over its seeds with 95 % intervals. Raises as `train`.
    """
    own = OwnParts(sampler, network, learner)
    own_parts.check(own, init)
    own_parts.check_varied(own, vary or {})
    plan = SweepPlan(
        seeds, _points(own_parts.named(cfg, own), dict(vary or {})), episodes, together
    )
    runner.check_plan(plan)
    runs = seeds * len(plan.points)
    room = devices or 1, min(runs, together or runs)
    points = [point._replace(cfg=backend.resolve(point.cfg, *room)) for point in plan.points]
    plan, stop = plan._replace(points=points), stop or signals.Stop()
    folder = new_folder(f"sweep-{cfg.preset}") if run_dir is None else Path(run_dir)
    same = not resume or runner.read_plan(folder) == plan
    require(same, f"resume: {folder} is a sweep of other settings, parts or seeds; give the same")
    return run_sweep(plan, folder, devices, shard, init, verbose, stop, resume, own).summary


def run_sweep(
    plan: SweepPlan,
    folder: Path,
    devices: int | None,
    shard: sharding.Shard,
    init: str | Path | None,
    verbose: bool,
    stop: signals.Stop,
    resume: bool = False,
    own: OwnParts = own_parts.NO_PARTS,
) -> SweepResult:
    """Runs what is left of a sweep's plan, see `sweep`, and writes its record."""
    begun = time.time()
    for point in plan.points:
        own_parts.named(point.cfg, own)
    cache.enable()
    mesh = sharding.make(devices)
    for cfg in (point.cfg for point in plan.points):
        sharding.check(mesh, shard, plan.together or plan.seeds, cfg.train.scenes, cfg.learn.batch)
        initial_networks(cfg, init)
    runner.check_room(plan, 1 if mesh is None or shard == "scenes" else mesh.size)

    def make_program(group: replicas.ProgramGroup) -> replicas.SweepProgram:
        start = initial_networks(group.configs[0], init)
        return replicas.sweep_program(group, mesh, shard, start, own)

    with Terminal(Console(quiet=not (verbose and cluster.is_first()))) as terminal:
        terminal.log(f"sweep {folder}")
        result = runner.run(plan, folder, make_program, terminal, stop, resume=resume)
        if result.stopped_by is None and plan.episodes and cluster.is_first():
            with lock.exclusive(folder):
                stopped = final.measure(plan, folder, terminal, stop, own=own)
            if stopped is not None:
                terminal.log(f"stopped; continue with: csac-jax sweep --resume {folder}")
            result = result._replace(stopped_by=stopped)
    if cluster.is_first():
        end = {"run_dir": str(folder), **result.summary, **result._asdict()}
        del end["summary"]
        seconds = {"wall_seconds": round(time.time() - begun, 1)}
        files.write_json(folder / files.RECORD, end | seconds | provenance.record())
    return result


def evaluate_sweep(folder: Path, suite: str, episodes: int, stop: signals.Stop) -> int | None:
    """Evaluates the final policies of a sweep, see `sweeps.final.measure`."""
    cache.enable()
    plan = runner.read_plan(folder)._replace(episodes=episodes)
    with Terminal(Console()) as terminal, lock.exclusive(folder):
        stopped = final.measure(plan, folder, terminal, stop, suite)
        terminal.log("stopped; the same command continues" if stopped else f"saved in {folder}")
        return stopped


def initial_networks(cfg: Config, source: str | Path | None) -> Callable[[Any], Any] | None:
    """Returns a function that puts the networks of `source`, see `train`, into an initial state.
    Raises SettingsError if they are not those of the config."""
    if source is None:
        return None
    if isinstance(cfg.net, DenseNet121) and _is_weights(source):
        trunk = weights.read(cfg.net, Path(source))
        return lambda state: actor_critic.with_trunk(state, trunk)
    policy = policies.load(source)
    assert isinstance(policy, policies.NetworkPolicy)
    params, wanted = policy.params, actor_critic.abstract_params(cfg)
    # Inputs may be missing at the end: colours, heights, gripper and mask are in this order.
    if not policy.cfg.sees_mask and policy.cfg.net.colour == cfg.net.colour:
        params = actor_critic.with_inputs(params, wanted)
    if leaves.layout(params) != leaves.layout(wanted):
        fault = "its networks are not those of these settings"
        raise SettingsError(f"init {source}: {fault}; take other net, learn.critics or task.kind")
    return lambda state: actor_critic.with_params(state, params)


def match_networks(cfg: Config, source: str | Path) -> Config:
    """Gives a config networks of the sizes of the policy `source`, see `train`'s `init`, and maps
    of as many cells, since kernels have the scale of a cell."""
    if _is_weights(source):
        return cfg
    stored = policies.load_config(source)
    learn = {"critics": stored.learn.critics, "actor": stored.learn.actor}
    net = stored.net
    if isinstance(net, SmallNet) and isinstance(cfg.net, SmallNet):
        mask = net.mask or (stored.sees_mask and not cfg.task.has_target)
        more = {name: getattr(net, name) or getattr(cfg.net, name) for name in ("gripper", "fit")}
        net = dataclasses.replace(net, mask=mask, **more)
    return cfg.change(net=net, learn=learn, heightmap={"size": stored.heightmap.size})


def new_folder(name: str) -> Path:
    """Returns a folder under RUNS, with the time in its name, that does not exist yet."""
    stem = f"{name}-{datetime.datetime.now():%Y%m%d-%H%M%S}"
    candidates = (RUNS / f"{stem}{end}" for end in ("", *(f"-{i}" for i in range(2, 100))))
    return next(path for path in candidates if not path.exists())


def _is_weights(source: str | Path) -> bool:
    """Returns True if `source` is a file of weights and no policy."""
    path = Path(source)
    return source != "shipped" and path.is_file() and not policy_file.is_policy(path)


def _points(cfg: Config, vary: dict[str, Sequence[Any]]) -> list[grid.SweepPoint]:
    for name in vary:
        grid.kind_of(name)

    def configure(values: dict[str, Any]) -> Config:
        base = algorithms.configure(cfg, values.pop("algo")) if "algo" in values else cfg
        settings: dict[str, Any] = {}
        for name, value in values.items():
            settings |= grid.settings_of(name, value)
        return programs.replace_settings(base, settings)

    return grid.combine(vary, configure)


def _first_line(folder: Path, cfg: Config) -> str:
    settings = f"preset {cfg.preset}, algorithm {cfg.algo}, seed {cfg.seed}"
    settings += f", {cfg.parts}" if cfg.parts else ""
    scenes = f"{cfg.train.scenes} scene{'s' if cfg.train.scenes > 1 else ''}"
    return (
        f"run {folder}: {settings}, {scenes}, physics {cfg.sim.physics}, on {provenance.device()}"
    )
