"""From dense maps to an action: a pose per primitive, then one primitive."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.agent import actor, cem, explore, maps
from csac_jax.agent.actor_critic import ActorCritic
from csac_jax.agent.maps import DenseMaps, Frames
from csac_jax.constants import Primitive
from csac_jax.robot.primitives import Action

DISTINCT = 0.02, 0.7  # m and rad; a proposal that is nearer to a better one, in both, is none


def greedy(
    key: jax.Array, learner: ActorCritic, state: DenseMaps, steps_without_change: jax.Array
) -> explore.Greedy:
    """Finds each primitive's best pose by `policy.place`, a primitive by `policy.primitive`."""
    best = _best_poses(key, learner, state)
    rule = PRIMITIVE_RULES[learner.cfg.policy.primitive]
    return explore.Greedy(rule(best.value, steps_without_change), best.action, best.value)


def candidates(key: jax.Array, learner: ActorCritic, state: DenseMaps) -> jax.Array:
    """Returns poses [P, J, 3] (m, m, rad) that `greedy` tries last; for pictures."""
    denormalise = jax.vmap(jax.vmap(maps.denormalise, (None, 0)), (None, 0))
    return denormalise(learner.frames, _best_poses(key, learner, state).candidates)


def _best_poses(key: jax.Array, learner: ActorCritic, state: DenseMaps) -> cem.CEMResult:
    search = _cem if learner.cfg.policy.place == "cem" else _best_cell
    call = lambda p, single: search(jax.random.fold_in(key, p), learner, single)  # noqa: E731
    return maps.map_primitives(call, state, tuple(Primitive))


def _cem(key: jax.Array, learner: ActorCritic, state: DenseMaps) -> cem.CEMResult:
    """Maximises Q of primitive 0 by the cross-entropy method, lines 8-13, from the best cells."""
    cfg, frames, (lowest, highest) = learner.cfg.cem, learner.frames, learner.bounds

    def score(u: jax.Array) -> jax.Array:
        value, valid = maps.read_valid(frames, state, 0, maps.denormalise(frames, u))
        return jnp.where(valid, value, value - (highest - lowest))  # below any that is valid

    cells = maps.best_cells(state.q[0], state.valid[0], cfg.elites)
    start = jax.vmap(maps.cell_point, (None, 0))(frames, cells)
    mean = maps.normalise(frames, actor.pose(frames, state, 0))
    return cem.maximise(key, cfg, score, mean, start)


def _best_cell(key: jax.Array, learner: ActorCritic, state: DenseMaps) -> cem.CEMResult:
    """Returns the centre of the valid cell where Q of primitive 0 is largest (VPG)."""
    cell = maps.best_cells(state.q[0], state.valid[0], 1)[0]
    u = maps.cell_point(learner.frames, cell)
    return cem.CEMResult(u, state.q[0].reshape(-1)[cell], u[None])


PRIMITIVE_RULES: dict[str, Callable[[jax.Array, jax.Array], jax.Array]] = {
    # values of the best poses [P] and steps without change [] -> primitive [] int32
    "argmax": lambda values, _: jnp.argmax(values).astype(jnp.int32),
    # CSAC sec. 3.4: a push if the last action changed nothing, else a grasp
    "rule": lambda _, steps: jnp.int32(jnp.where(steps > 0, Primitive.PUSH, Primitive.GRASP)),
    "grasp": lambda *_: jnp.int32(Primitive.GRASP),
}


def _random_places(key: jax.Array, frames: Frames, valid: jax.Array) -> jax.Array:
    """Draws one valid cell per primitive as a point of the box [P, 3]; `valid` [P, K, h, w]."""

    def place(p: jax.Array, valid: jax.Array) -> jax.Array:
        cell = explore.random_cell(jax.random.fold_in(key, p), valid.reshape(-1))
        return maps.cell_point(frames, cell)

    return jax.vmap(place)(jnp.arange(len(Primitive)), valid)


def act(
    key: jax.Array,
    learner: ActorCritic,
    state: DenseMaps,
    steps_without_change: jax.Array,
    actions_taken: jax.Array,
) -> Action:
    """Chooses the action to try while learning: greedy with exploration, lines 8-13."""
    key_search, key_places, key_choose = jax.random.split(key, 3)
    best = greedy(key_search, learner, state, steps_without_change)
    places = _random_places(key_places, learner.frames, state.valid)
    primitive, u = explore.choose(key_choose, learner.cfg.explore, actions_taken, best, places)
    return Action(primitive, maps.denormalise(learner.frames, u))


def best_action(
    key: jax.Array, learner: ActorCritic, state: DenseMaps, steps_without_change: jax.Array
) -> Action:
    """Returns the greedy action, without exploration."""
    best = greedy(key, learner, state, steps_without_change)
    return Action(best.primitive, maps.denormalise(learner.frames, best.poses[best.primitive]))


def proposals(learner: ActorCritic, state: DenseMaps, primitive: Primitive, num: int) -> Action:
    """Returns the best distinct cells of a primitive as actions, leaves [num, ...], best first."""
    frames = learner.frames
    xy, yaws = jnp.asarray(frames.xy), jnp.asarray(frames.yaws)[:, None, None]

    def propose(values: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
        pose = maps.cell_pose(frames, jnp.argmax(values).astype(jnp.int32))
        near = jnp.linalg.norm(xy - pose[:2], axis=-1) < DISTINCT[0]
        turn = jnp.cos(yaws - pose[2])
        turn = jnp.abs(turn) if primitive == Primitive.GRASP else turn  # the hand is symmetric
        return jnp.where(near & (turn > np.cos(DISTINCT[1])), -jnp.inf, values), pose

    values = jnp.where(state.valid[primitive], state.q[primitive], -jnp.inf)
    _, poses = jax.lax.scan(propose, values, length=num)
    return Action(jnp.full(num, primitive, jnp.int32), poses)


def after_failures(
    key: jax.Array, learner: ActorCritic, state: DenseMaps, failed_grasps: jax.Array
) -> DenseMaps:
    """Adds Gumbel noise to Q by `failed_grasps` []: the best cell follows Boltzmann's law."""
    if learner.cfg.policy.retry_temperature == 0.0:
        return state
    temperature = learner.cfg.policy.retry_temperature * failed_grasps.astype(jnp.float32)
    noise = jax.random.gumbel(jax.random.fold_in(key, len(Primitive)), state.q.shape)
    return state.replace(q=state.q + temperature * noise)


def random_grasp(key: jax.Array, frames: Frames, valid: jax.Array) -> Action:
    """Draws a grasp at a random valid cell, whose frame gives the yaw; `valid` [P, K, h, w]."""
    u = _random_places(key, frames, valid)[Primitive.GRASP]
    return Action(jnp.int32(Primitive.GRASP), maps.denormalise(frames, u))
