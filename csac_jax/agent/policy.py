"""From dense maps to an action: a pose per primitive, then one primitive."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from csac_jax.agent import actor, box, cem, explore, maps
from csac_jax.agent.actor_critic import ActorCritic
from csac_jax.agent.explore import Greedy
from csac_jax.agent.maps import DenseMaps, Frames
from csac_jax.config import PolicyConfig
from csac_jax.constants import Primitive
from csac_jax.sim.primitives import Action


class Choice(NamedTuple):
    """The best pose of each primitive and which primitive is chosen."""

    greedy: Greedy  # poses in the box
    values: jax.Array  # [P] Q of the poses


class PoseSearch(NamedTuple):
    """How the pose of a primitive is found; both take key, learner, maps and primitive."""

    best: Callable[[jax.Array, ActorCritic, DenseMaps, Primitive], cem.CEMResult]
    candidates: Callable[[jax.Array, ActorCritic, DenseMaps, Primitive], jax.Array]  # [J, 3], tried


def greedy(
    key: jax.Array, learner: ActorCritic, state: DenseMaps, steps_without_change: jax.Array
) -> Choice:
    """The best pose of each primitive by `policy.place`, then a primitive by `policy.primitive`.

    Args: steps_without_change [] int32, actions in a row without visible change.
    """
    cfg = learner.cfg.policy
    search = POSE_SEARCHES[cfg.place].best
    results = [search(key, learner, state, primitive) for primitive in Primitive]
    values = jnp.stack([result.value for result in results])
    poses = jnp.stack([result.action for result in results])
    primitive = choose_primitive(cfg, values, steps_without_change)
    return Choice(Greedy(primitive, poses), values)


def candidates(key: jax.Array, learner: ActorCritic, state: DenseMaps) -> jax.Array:
    """Poses [P, J, 3] that `greedy` tries last; for pictures."""
    search = POSE_SEARCHES[learner.cfg.policy.place].candidates
    tried = jnp.stack([search(key, learner, state, primitive) for primitive in Primitive])
    return jax.vmap(jax.vmap(maps.denormalise, (None, 0)), (None, 0))(learner.frames, tried)


def _cem(
    key: jax.Array, learner: ActorCritic, state: DenseMaps, primitive: Primitive
) -> cem.CEMResult:
    """Maximises Q over the pose by the cross-entropy method, Algorithm 1 lines 8-13."""
    key = jax.random.fold_in(key, primitive)
    return cem.maximise(key, learner.cfg.cem, *_problem(learner, state, primitive), box.POSE_WRAPS)


def _cem_candidates(
    key: jax.Array, learner: ActorCritic, state: DenseMaps, primitive: Primitive
) -> jax.Array:
    key = jax.random.fold_in(key, primitive)
    return cem.last_round(
        key, learner.cfg.cem, *_problem(learner, state, primitive), box.POSE_WRAPS
    )


def _best_cell(
    key: jax.Array, learner: ActorCritic, state: DenseMaps, primitive: Primitive
) -> cem.CEMResult:
    """The valid cell of largest Q as it is (VPG)."""
    del key
    cell = maps.best_cells(state.q[primitive], state.valid[primitive], 1)[0]
    return cem.CEMResult(
        maps.normalise(learner.frames, maps.cell_pose(learner.frames, cell)),
        state.q[primitive].reshape(-1)[cell],
    )


POSE_SEARCHES = {
    "cem": PoseSearch(_cem, _cem_candidates),
    "argmax": PoseSearch(_best_cell, lambda *args: _best_cell(*args).action[None]),
}
CEM_STARTS: dict[str, Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]] = {
    # actor's pose [A] and best cells [K, A] -> mean [A] and starting points [P0, A]
    "both": lambda pose, cells: (pose, cells),
    "actor": lambda pose, cells: (pose, cells[:0]),
    "cells": lambda pose, cells: (cells[0], cells),
}
PRIMITIVE_RULES: dict[str, Callable[[jax.Array, jax.Array], jax.Array]] = {
    "argmax": lambda values, _: jnp.argmax(values).astype(jnp.int32),
    # CSAC sec. 3.4: a push if the last action changed nothing, else a grasp
    "rule": lambda _, steps_without_change: jnp.where(
        steps_without_change > 0, jnp.int32(Primitive.PUSH), jnp.int32(Primitive.GRASP)
    ),
    "grasp": lambda *_: jnp.int32(Primitive.GRASP),
}


def _problem(
    learner: ActorCritic, state: DenseMaps, primitive: Primitive
) -> tuple[cem.Score, jax.Array, jax.Array]:
    """What a search maximises, its mean [A] and its starting points [P0, A].

    Poses with nothing to act on cost the range of returns. There are as many best cells as elites.
    """
    cfg, frames = learner.cfg.cem, learner.frames

    def score(u: jax.Array) -> jax.Array:
        pose = maps.denormalise(frames, u)
        value = maps.read(frames, state.q, jnp.int32(primitive), pose)
        valid = maps.is_valid(frames, state.valid, jnp.int32(primitive), pose)
        return jnp.where(valid, value, value - learner.return_range)

    mean = maps.normalise(frames, actor.pose(frames, state, primitive))
    cells = maps.best_cells(state.q[primitive], state.valid[primitive], cfg.elites)
    poses = jax.vmap(lambda cell: maps.normalise(frames, maps.cell_pose(frames, cell)))(cells)
    return score, *CEM_STARTS[cfg.start](mean, poses)


def choose_primitive(
    cfg: PolicyConfig, values: jax.Array, steps_without_change: jax.Array
) -> jax.Array:
    """Primitive [] int32 from the values [P] of the best poses and steps_without_change []."""
    return PRIMITIVE_RULES[cfg.primitive](values, steps_without_change)


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
    learner: ActorCritic,
    state: DenseMaps,
    steps_without_change: jax.Array,
    actions_taken: jax.Array,
) -> Action:
    """The action to try while learning: greedy with exploration, Algorithm 1 lines 8-13."""
    key_search, key_places, key_choose = jax.random.split(key, 3)
    best = greedy(key_search, learner, state, steps_without_change).greedy
    places = random_places(key_places, learner.frames, state.valid)
    primitive, u = explore.choose(key_choose, learner.cfg.explore, actions_taken, best, places)
    return Action(primitive=primitive, pose=maps.denormalise(learner.frames, u))


def best_action(
    key: jax.Array, learner: ActorCritic, state: DenseMaps, steps_without_change: jax.Array
) -> Action:
    """The action of the learned policy, without exploration."""
    best = greedy(key, learner, state, steps_without_change).greedy
    pose = maps.denormalise(learner.frames, best.poses[best.primitive])
    return Action(primitive=best.primitive, pose=pose)


def random_grasp(key: jax.Array, frames: Frames, valid: jax.Array) -> Action:
    """A grasp at a random valid cell, with a random yaw; `valid` [P, K, h, w]."""
    u = random_places(key, frames, valid)[Primitive.GRASP]
    return Action(primitive=jnp.int32(Primitive.GRASP), pose=maps.denormalise(frames, u))
