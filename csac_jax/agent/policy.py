"""From dense maps to an action: a pose per primitive, then one primitive."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import geometry
from csac_jax.agent import actor, cem, explore, maps
from csac_jax.agent.actor_critic import ActorCritic
from csac_jax.agent.cem import CEMResult
from csac_jax.agent.maps import DenseMaps, Frames
from csac_jax.constants import Primitive
from csac_jax.sim.primitives import Action


def greedy(
    key: jax.Array, learner: ActorCritic, state: DenseMaps, steps_without_change: jax.Array
) -> explore.Greedy:
    """The best pose of each primitive by `policy.place`, then a primitive by `policy.primitive`."""
    found = _best_poses(key, learner, state)
    rule = PRIMITIVE_RULES[learner.cfg.policy.primitive]
    return explore.Greedy(rule(found.value, steps_without_change), found.action, found.value)


def candidates(key: jax.Array, learner: ActorCritic, state: DenseMaps) -> jax.Array:
    """Poses [P, J, 3] (m, m, rad) that `greedy` tries last; for pictures."""
    denormalise = jax.vmap(jax.vmap(maps.denormalise, (None, 0)), (None, 0))
    return denormalise(learner.frames, _best_poses(key, learner, state).candidates)


def _best_poses(key: jax.Array, learner: ActorCritic, state: DenseMaps) -> CEMResult:
    """What the search finds for each primitive, leaves [P, ...]."""
    search = POSE_SEARCHES[learner.cfg.policy.place]
    return maps.of_each_primitive(
        lambda p, one: search(jax.random.fold_in(key, p), learner, one), state, tuple(Primitive)
    )


def _cem(key: jax.Array, learner: ActorCritic, state: DenseMaps) -> CEMResult:
    """Maximises the only Q over the pose by the cross-entropy method, Algorithm 1 lines 8-13.

    Poses with nothing to act on cost the range of returns. There are as many best cells as elites.
    """
    cfg, frames = learner.cfg.cem, learner.frames

    def score(u: jax.Array) -> jax.Array:
        pose = maps.denormalise(frames, u)
        value, valid = maps.read_valid(frames, state, 0, pose)
        return jnp.where(valid, value, value - learner.return_range)

    mean = maps.normalise(frames, actor.pose(frames, state, 0))
    cells = maps.best_cells(state.q[0], state.valid[0], cfg.elites)
    poses = jax.vmap(lambda cell: maps.normalise(frames, maps.cell_pose(frames, cell)))(cells)
    return cem.maximise(key, cfg, score, *CEM_STARTS[cfg.start](mean, poses))


def _best_cell(key: jax.Array, learner: ActorCritic, state: DenseMaps) -> CEMResult:
    """The valid cell of the only Q where it is largest, as it is (VPG)."""
    cell = maps.best_cells(state.q[0], state.valid[0], 1)[0]
    u = maps.normalise(learner.frames, maps.cell_pose(learner.frames, cell))
    return CEMResult(u, state.q[0].reshape(-1)[cell], u[None])


POSE_SEARCHES = {"cem": _cem, "argmax": _best_cell}
CEM_STARTS: dict[str, Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]] = {
    # actor's pose [3] and best cells [K, 3] -> mean [3] and starting points [P0, 3]
    "both": lambda pose, cells: (pose, cells),
    "actor": lambda pose, cells: (pose, cells[:0]),
    "cells": lambda pose, cells: (cells[0], cells),
}
PRIMITIVE_RULES: dict[str, Callable[[jax.Array, jax.Array], jax.Array]] = {
    # values of the best poses [P] and steps without change [] -> primitive [] int32
    "argmax": lambda values, _: jnp.argmax(values).astype(jnp.int32),
    # CSAC sec. 3.4: a push if the last action changed nothing, else a grasp
    "rule": lambda _, steps: jnp.int32(jnp.where(steps > 0, Primitive.PUSH, Primitive.GRASP)),
    "grasp": lambda *_: jnp.int32(Primitive.GRASP),
}


def _random_offset(key: jax.Array, frames: Frames, pose: jax.Array) -> jax.Array:
    """From a cell's pose [3] to one inside the cell and its share of yaws, [3] m, m, rad."""
    along, across, turn = jax.random.uniform(key, (3,), minval=-0.5, maxval=0.5)
    xy = geometry.rotate2d(pose[2], frames.cell * jnp.stack([along, across]))
    return jnp.append(xy, turn * (2.0 * np.pi / frames.yaws.shape[0]))


def random_places(key: jax.Array, frames: Frames, valid: jax.Array) -> jax.Array:
    """One random valid cell per primitive as a point of the box [P, 3]; `valid` [P, K, h, w].

    Where Q varies inside cells, a random pose nearest to that cell: else no offset is ever seen.
    """

    def place(p: jax.Array, valid: jax.Array) -> jax.Array:
        cell = explore.random_cell(jax.random.fold_in(key, p), valid.reshape(-1))
        pose = maps.cell_pose(frames, cell)
        if frames.networks.terms > 1:
            pose = pose + _random_offset(jax.random.fold_in(key, len(Primitive) + p), frames, pose)
        return maps.normalise(frames, pose)

    return jax.vmap(place)(jnp.arange(len(Primitive)), valid)


def act(
    key: jax.Array,
    learner: ActorCritic,
    state: DenseMaps,
    steps_without_change: jax.Array,
    actions_taken: jax.Array,
) -> Action:
    """The action to try while learning: greedy with exploration, Algorithm 1 lines 8-13."""
    key_search, key_places, key_choose = jax.random.split(key, 3)
    best = greedy(key_search, learner, state, steps_without_change)
    places = random_places(key_places, learner.frames, state.valid)
    primitive, u = explore.choose(key_choose, learner.cfg.explore, actions_taken, best, places)
    return Action(primitive=primitive, pose=maps.denormalise(learner.frames, u))


def best_action(
    key: jax.Array, learner: ActorCritic, state: DenseMaps, steps_without_change: jax.Array
) -> Action:
    """The action of the learned policy, without exploration."""
    best = greedy(key, learner, state, steps_without_change)
    pose = maps.denormalise(learner.frames, best.poses[best.primitive])
    return Action(primitive=best.primitive, pose=pose)


def after_failures(
    key: jax.Array, learner: ActorCritic, state: DenseMaps, failed_grasps: jax.Array
) -> DenseMaps:
    """The maps to act by after `failed_grasps` [] in a row: Q plus Gumbel noise, by which the best
    cell is one drawn by Boltzmann's law."""
    if learner.cfg.policy.retry == 0.0:
        return state
    temperature = learner.cfg.policy.retry * failed_grasps.astype(jnp.float32)
    noise = jax.random.gumbel(jax.random.fold_in(key, len(Primitive)), state.q.shape)
    return state.replace(q=state.q + temperature * noise)


def random_grasp(key: jax.Array, frames: Frames, valid: jax.Array) -> Action:
    """A grasp at a random valid cell, with a random yaw; `valid` [P, K, h, w]."""
    u = random_places(key, frames, valid)[Primitive.GRASP]
    return Action(primitive=jnp.int32(Primitive.GRASP), pose=maps.denormalise(frames, u))
