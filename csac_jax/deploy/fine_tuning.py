"""A policy learns from a record of its own actions, see `record`; no scene is simulated.

It learns from the height maps that were decided on. The learner's modules need MuJoCo installed.
n = transitions.
"""

import dataclasses
import functools
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from csac_jax.agent import actor_critic
from csac_jax.agent.csac import CSAC
from csac_jax.agent.learner import Learner, Transition
from csac_jax.agent.rewards import ActionResult
from csac_jax.config import Config, UniformReplay
from csac_jax.constants import CHANGE_AREA, OUTCOMES, Outcome, Primitive
from csac_jax.deploy import CameraPolicy, record
from csac_jax.deploy.record import PUSHED, Entry
from csac_jax.errors import DataWarning, FailedError, SettingsError
from csac_jax.replay import ring, samplers
from csac_jax.robot.primitives import Action
from csac_jax.runtime import cache, compiler
from csac_jax.runtime.signals import Stop
from csac_jax.training import programs, step
from csac_jax.training.step import Program
from csac_jax.vision import heightmap
from csac_jax.vision.heightmap import PackedObservation

UPDATES = 10  # of the critic in a step, after which the actor has one (ours)
FEW = 100  # actions of a record (ours); docs/robot.md has what some hundred brought
_AT_ONCE = 32  # transitions that are rewarded together: their maps fill the memory

Progress = Callable[[int, int, float], None]
"""Takes updates, all updates, and mean abs(y - Q) in the step."""


class Settings(NamedTuple):
    """Settings of the learning."""

    updates: int = 150  # of the critic, rounded up to whole steps
    learning_rate: float = 3e-4  # Adam's step size, critic; the actor's is a third
    batch: int = 16
    seed: int = 0


class FineTuningSummary(NamedTuple):
    """The result of the learning."""

    actions: int  # transitions learned from
    lifted: int  # grasps among them that lifted something
    updates: int
    td_error: tuple[float, float]  # of the first step and of the last
    seconds: float
    stopped_by: int | None  # number of the signal; None if all is done


class Experience(NamedTuple):
    """The content of a record. NumPy leaves [n, ...]."""

    obs: PackedObservation
    action: Action
    outcome: Any  # [n] int32, Outcome; NOTHING of pushes
    next_obs: PackedObservation
    terminated: Any  # [n] bool


@struct.dataclass
class OfflineState:
    """The state from step to step; the ring is full."""

    key: jax.Array  # [] typed key, root of all randomness, never consumed
    step: jax.Array  # [] int32, steps done, each of `learn.updates_per_step` updates
    learner: Any
    replay: ring.ReplayState


def run(
    policy: CameraPolicy,
    folder: Path,
    settings: Settings = Settings(),  # noqa: B008, it is immutable
    on_progress: Progress = lambda *_: None,
    stop: Stop | None = None,
) -> tuple[CameraPolicy, FineTuningSummary]:
    """Returns the policy after learning from the record in `folder`, or until `stop`.

    Its config stays. Raises SettingsError for a record that nothing can be learned from,
    FailedError if a loss is not finite. Warns of a record with fewer actions than FEW.
    """
    cache.enable()
    stop = stop or Stop()
    recorded = load(policy, record.read(folder))
    if (few := len(recorded.outcome)) < FEW:
        text = f"{folder} has {few} actions; a policy that learns from so few may get worse"
        warnings.warn(f"{text}: record {FEW} or more", DataWarning, stacklevel=2)
    program = make_program(configure(policy.cfg, settings, len(recorded.outcome)))
    key, learner = jax.random.key(settings.seed), init(program, policy.params)
    rewarded = transitions(policy, program.learner, learner, recorded)
    state = OfflineState(key, jnp.int32(0), learner, fill(program, rewarded))
    state, errors, seconds = _learn(program, state, on_progress, stop)
    lifted = int((recorded.outcome == Outcome.LIFTED).sum())
    ends = (errors[0], errors[-1]) if errors else (0.0, 0.0)
    updates, num = len(errors) * UPDATES, len(recorded.outcome)
    summary = FineTuningSummary(num, lifted, updates, ends, seconds, stop.signal)
    return dataclasses.replace(policy, params=state.learner.online), summary


def configure(cfg: Config, settings: Settings, num: int) -> Config:
    """Returns the config of a fine-tuning on `num` transitions.

    They are drawn uniformly: ranks by error would repeat the few whose outcome was luck.
    """
    learn: dict[str, Any] = {"batch": settings.batch, "actor_batch": 0, "updates_per_step": UPDATES}
    learn["learning_rate"] = settings.learning_rate
    learn["actor_learning_rate"] = settings.learning_rate / 3.0
    steps = -(-settings.updates // UPDATES)
    train = {"scenes": 1, "actions": steps, "learning_starts": settings.batch}
    small = cfg.change(learn=learn, train=train)
    return dataclasses.replace(small, replay=UniformReplay(capacity=max(num, settings.batch)))


@functools.lru_cache(maxsize=2)
def make_program(cfg: Config) -> Program:
    """Makes the program of a config, without environment; cached."""
    no_env: Any = None
    learner = CSAC(actor_critic.make(cfg))
    return Program(cfg, no_env, learner, samplers.make(cfg.replay))


def init(program: Program, params: actor_critic.Params) -> Any:
    """Creates the learner's initial state with copies of these networks; the state is donated."""
    fresh = jax.jit(program.learner.init)(jax.random.key(0))
    return actor_critic.with_params(fresh, jax.tree.map(jnp.array, params))


def fill(program: Program, transitions: Transition) -> ring.ReplayState:
    """Creates a ring that these transitions, leaves [n, ...], fill."""
    num = transitions.reward.shape[0]
    empty = ring.init(program.sampler.init(num), programs.example(program.cfg))
    return ring.add(empty, transitions, jnp.ones(num, bool))


@functools.lru_cache(maxsize=2)
def compile_step(program: Program):
    """Returns a jitted function state -> (state, losses), of one step; the state is donated."""
    cfg = program.cfg

    def one(state: OfflineState) -> tuple[OfflineState, dict[str, jax.Array]]:
        key, done = jax.random.fold_in(state.key, state.step), state.step * UPDATES
        learner, priority, losses = step.learn(program, key, state.learner, state.replay, done)
        replay = state.replay.replace(priority=priority)
        return OfflineState(state.key, state.step + 1, learner, replay), losses

    return jax.jit(one, donate_argnums=0, compiler_options=compiler.options(cfg))


def _learn(
    program: Program, state: OfflineState, on_progress: Progress, stop: Stop
) -> tuple[OfflineState, list[float], float]:
    """Runs all steps; returns the state, the TD error of each step, and the seconds."""
    total, learn = program.cfg.train.steps, compile_step(program)
    errors, begun = list[float](), time.perf_counter()
    while len(errors) < total and stop.signal is None:
        state, losses = learn(state)
        errors.append(float(losses["td_error"]))
        updates = len(errors) * UPDATES
        if not jnp.isfinite(losses["critic_loss"] + losses["actor_loss"]):
            raise FailedError(
                f"the loss is not finite after {updates} updates; lower learning_rate"
            )
        on_progress(updates, total * UPDATES, errors[-1])
    return jax.block_until_ready(state), errors, time.perf_counter() - begun


def load(policy: CameraPolicy, entries: list[Entry]) -> Experience:
    """Loads the actions whose outcome is known, seen as `policy` sees.

    The next entry shows what an action led to. An action without one is left out, unless its scene
    ended. Raises SettingsError for damaged entries, and if no action is left.
    """
    by_number = {int(entry.path.name): entry for entry in entries}
    observed = functools.cache(lambda number: _observed(policy, by_number[number]))
    rows = []
    for number, entry in by_number.items():
        if entry.outcome is None or not (entry.outcome.ended or number + 1 in by_number):
            continue
        ended = entry.outcome.ended
        after = observed(number if ended else number + 1)
        rows.append(Experience(observed(number), *_done(entry), after, np.bool_(ended)))
    if not rows:
        needed = "an action with an outcome and an image after it"
        raise SettingsError(f"the record lacks {needed}; post outcomes, see docs/robot.md")
    return jax.tree.map(lambda *leaves: np.stack(leaves), *rows)


def _observed(policy: CameraPolicy, entry: Entry) -> PackedObservation:
    """Returns the policy's view of an entry's image. The mask counts in the task `target`."""
    rgb, depth, lens, pose, mask = entry.image
    try:
        marked = mask if policy.cfg.task.has_target else None
        obs = policy.observe(rgb, depth, lens, pose, marked)
    except (SettingsError, FailedError) as error:
        raise SettingsError(f"{entry.path}: {error}") from None
    return jax.device_get(heightmap.pack(obs))


def _done(entry: Entry) -> tuple[Action, Any]:
    """Returns the action of an entry and its outcome, NumPy leaves [...]."""
    assert entry.outcome is not None
    primitive, place = entry.action
    name = entry.outcome.outcome
    level = Outcome.NOTHING if name == PUSHED else Outcome(OUTCOMES.index(name))
    pose: Any = np.array(place, np.float32)
    kind: Any = np.int32(Primitive[primitive.upper()])
    return Action(kind, pose), np.int32(level)


def transitions(
    policy: CameraPolicy, learner: Learner, state: Any, experience: Experience
) -> Transition:
    """Returns the transitions of an experience, rewarded as in training, leaves [n, ...]."""
    parts = []
    for i in range(0, len(experience.outcome), _AT_ONCE):
        part = jax.tree.map(lambda leaf, i=i: leaf[i : i + _AT_ONCE], experience)
        parts.append(jax.device_get(_rewarded(policy.cfg, learner, state, part)))
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _rewarded(cfg: Config, learner: Learner, state: Any, part: Experience) -> Transition:
    """Computes the rewards; lost blocks, distances and values of states are unknown, cost 0."""
    unknown = jnp.zeros(part.outcome.shape)
    obs, after = heightmap.unpack(part.obs), heightmap.unpack(part.next_obs)
    moved = jax.vmap(heightmap.moved_area, (None, 0, 0))(cfg.heightmap, obs.height, after.height)
    done = part.action.primitive, part.outcome
    changed, lost = moved > CHANGE_AREA, jnp.zeros(part.outcome.shape, jnp.int32)
    result = ActionResult(*done, unknown, unknown, unknown, changed, lost)
    reward, better = learner.reward(cfg.reward, state, obs, after, result)
    end = part.terminated
    if cfg.target.bootstrap == "continuing":  # nothing follows an action without any effect
        end |= ~(result.changed | (part.outcome == Outcome.LIFTED))
    label = better if cfg.reward.relabels else None
    return Transition(part.obs, part.action, reward, part.next_obs, end, label)
