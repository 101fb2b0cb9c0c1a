"""From dense maps to an action: a pose per primitive, then one of them, with or without
exploration."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from csac_jax.agent import actor, box, cem, explore, maps
from csac_jax.agent.explore import Greedy
from csac_jax.agent.maps import DenseMaps, Frames
from csac_jax.config import Config, PolicyConfig
from csac_jax.constants import Primitive
from csac_jax.sim.primitives import Action


class Choice(NamedTuple):
    """The best pose of each primitive and which primitive is chosen."""

    greedy: Greedy  # poses in the box
    values: jax.Array  # [P] Q of the poses


def greedy(
    key: jax.Array,
    cfg: Config,
    frames: Frames,
    state: DenseMaps,
    penalty: float,
    steps_without_change: jax.Array,
) -> Choice:
    """The best pose of each primitive by `policy.place`, then a primitive by `policy.primitive`.

    Args: penalty, the span of possible returns; steps_without_change [] int32, actions in a row
    without visible change.
    """

    def best(primitive: Primitive) -> cem.CEMResult:
        if cfg.policy.place == "cem":
            return _search(
                jax.random.fold_in(key, primitive), cfg, frames, state, penalty, primitive
            )
        if cfg.policy.place == "argmax":
            return _best_pixel(frames, state, primitive)
        raise ValueError(f"policy.place: {cfg.policy.place!r} is neither 'cem' nor 'argmax'")

    results = [best(primitive) for primitive in Primitive]
    values = jnp.stack([result.value for result in results])
    poses = jnp.stack([result.action for result in results])
    return Choice(Greedy(choose_primitive(cfg.policy, values, steps_without_change), poses), values)


def _search(
    key: jax.Array,
    cfg: Config,
    frames: Frames,
    state: DenseMaps,
    penalty: float,
    primitive: Primitive,
) -> cem.CEMResult:
    """Maximises Q over the pose of a primitive by the cross-entropy method, Algorithm 1 lines
    8-13."""
    score, mean, start = _problem(cfg, frames, state, penalty, primitive)
    return cem.maximise(key, cfg.cem, score, mean, start, box.POSE_WRAPS)


def candidates(
    key: jax.Array, cfg: Config, frames: Frames, state: DenseMaps, penalty: float
) -> jax.Array:
    """Poses [P, J, 3] that the last round of `greedy`'s searches tries; the best pixel if it has
    none."""

    def cloud(primitive: Primitive) -> jax.Array:
        if cfg.policy.place != "cem":
            return _best_pixel(frames, state, primitive).action[None]
        its_key = jax.random.fold_in(key, primitive)
        score, mean, start = _problem(cfg, frames, state, penalty, primitive)
        return cem.last_round(its_key, cfg.cem, score, mean, start, box.POSE_WRAPS)

    points = jnp.stack([cloud(primitive) for primitive in Primitive])
    each = jax.vmap(jax.vmap(maps.denormalise, (None, 0)), (None, 0))
    return each(frames, points)


def _problem(
    cfg: Config, frames: Frames, state: DenseMaps, penalty: float, primitive: Primitive
) -> tuple[cem.Score, jax.Array, jax.Array]:
    """What a search maximises, its mean [A] and its starting points [P0, A].

    It starts, by `cem.start`, at the actor's mean, at the map's best cells, as many as there are
    elites, or at both; `penalty` keeps it off cells with nothing to act on.
    """

    def score(u: jax.Array) -> jax.Array:
        pose = maps.denormalise(frames, u)
        value = maps.read(frames, state.q, jnp.int32(primitive), pose)
        return jnp.where(
            maps.is_valid(frames, state.valid, jnp.int32(primitive), pose), value, value - penalty
        )

    mean = maps.normalise(frames, actor.pose(frames, state, primitive))
    cells = maps.best_cells(state.q[primitive], state.valid[primitive], cfg.cem.elites)
    start = jax.vmap(lambda cell: maps.normalise(frames, maps.cell_pose(frames, cell)))(cells)
    if cfg.cem.start == "actor":
        start = start[:0]
    elif cfg.cem.start == "cells":
        mean = start[0]
    elif cfg.cem.start != "both":
        raise ValueError(f"cem.start: {cfg.cem.start!r} is none of 'both', 'actor', 'cells'")
    return score, mean, start


def _best_pixel(frames: Frames, state: DenseMaps, primitive: Primitive) -> cem.CEMResult:
    """The valid cell of largest Q as it is (VPG)."""
    cell = maps.best_cells(state.q[primitive], state.valid[primitive], 1)[0]
    return cem.CEMResult(
        maps.normalise(frames, maps.cell_pose(frames, cell)), state.q[primitive].reshape(-1)[cell]
    )


def choose_primitive(
    cfg: PolicyConfig, values: jax.Array, steps_without_change: jax.Array
) -> jax.Array:
    """Primitive [] int32 from the values [P] of the best poses and the number of actions without
    change, steps_without_change [].

    `argmax`, the larger value; `rule`, a push if the last action changed nothing, else a grasp
    (CSAC sec. 3.4); `grasp`, always that.
    """
    if cfg.primitive == "argmax":
        return jnp.argmax(values).astype(jnp.int32)
    if cfg.primitive == "rule":
        return jnp.where(
            steps_without_change > 0, jnp.int32(Primitive.PUSH), jnp.int32(Primitive.GRASP)
        )
    if cfg.primitive == "grasp":
        return jnp.int32(Primitive.GRASP)
    raise ValueError(f"policy.primitive: {cfg.primitive!r} is none of 'argmax', 'rule', 'grasp'")


def random_places(key: jax.Array, frames: Frames, valid: jax.Array) -> jax.Array:
    """One random valid cell per primitive as a point of the box [P, 3]; `valid` [P, K, h, w]."""
    places = []
    for primitive in Primitive:
        index = explore.random_cell(
            jax.random.fold_in(key, primitive), valid[primitive].reshape(-1)
        )
        places.append(maps.normalise(frames, maps.cell_pose(frames, index)))
    return jnp.stack(places)


def act(
    key: jax.Array,
    cfg: Config,
    frames: Frames,
    state: DenseMaps,
    penalty: float,
    steps_without_change: jax.Array,
    actions_taken: jax.Array,
) -> Action:
    """The action to try while learning: greedy with exploration, Algorithm 1 lines 8-13."""
    key_cem, key_places, key_choose = jax.random.split(key, 3)
    choice = greedy(key_cem, cfg, frames, state, penalty, steps_without_change)
    places = random_places(key_places, frames, state.valid)
    primitive, u = explore.choose(key_choose, cfg.explore, actions_taken, choice.greedy, places)
    return Action(primitive=primitive, pose=maps.denormalise(frames, u))


def best_action(
    key: jax.Array,
    cfg: Config,
    frames: Frames,
    state: DenseMaps,
    penalty: float,
    steps_without_change: jax.Array,
) -> Action:
    """The action of the learned policy, without exploration."""
    choice = greedy(key, cfg, frames, state, penalty, steps_without_change)
    u = choice.greedy.poses[choice.greedy.primitive]
    return Action(primitive=choice.greedy.primitive, pose=maps.denormalise(frames, u))


def random_grasp(key: jax.Array, frames: Frames, valid: jax.Array) -> Action:
    """A grasp at a random place above a block, with a random yaw; `valid` [P, K, h, w]."""
    u = random_places(key, frames, valid)[Primitive.GRASP]
    return Action(primitive=jnp.int32(Primitive.GRASP), pose=maps.denormalise(frames, u))
