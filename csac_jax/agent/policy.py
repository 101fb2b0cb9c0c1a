"""From dense maps to an action: CEM per primitive, then the better one, with or without exploration."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from csac_jax.agent import actor, box, cem, explore, maps
from csac_jax.agent.explore import Greedy
from csac_jax.agent.maps import DenseMaps, Frames
from csac_jax.config import CEMConfig, Config
from csac_jax.sim.primitives import Action, Primitive


class Choice(NamedTuple):
    """The best pose of each primitive and which primitive is better."""

    greedy: Greedy  # poses in the box
    values: jax.Array  # [P] Q of the poses


def greedy(key: jax.Array, cfg: CEMConfig, frames: Frames, state: DenseMaps, penalty: float) -> Choice:
    """Maximises Q over the pose of each primitive, then over primitives (CSAC sec. 3.4, argmax of both results).

    CEM starts at the actor's mean and at the map's best cells, as many as there are elites; `penalty`, the span of
    possible returns, keeps it off cells with nothing to act on.
    """

    def best(primitive: Primitive) -> cem.CEMResult:
        def score(u: jax.Array) -> jax.Array:
            pose = maps.denormalise(frames, u)
            value = maps.read(frames, state.q, jnp.int32(primitive), pose)
            return jnp.where(maps.is_valid(frames, state.valid, jnp.int32(primitive), pose), value, value - penalty)

        mean = maps.normalise(frames, actor.pose(frames, state, primitive))
        cells = maps.best_cells(state.q[primitive], state.valid[primitive], cfg.elites)
        start = jax.vmap(lambda cell: maps.normalise(frames, maps.cell_pose(frames, cell)))(cells)
        return cem.maximise(jax.random.fold_in(key, primitive), cfg, score, mean, start, box.POSE_WRAPS)

    results = [best(primitive) for primitive in Primitive]
    values = jnp.stack([result.value for result in results])
    poses = jnp.stack([result.action for result in results])
    return Choice(Greedy(jnp.argmax(values).astype(jnp.int32), poses), values)


def random_places(key: jax.Array, frames: Frames, valid: jax.Array) -> jax.Array:
    """One random valid cell per primitive as a point of the box [P, 3]; `valid` [P, K, h, w]."""
    places = []
    for primitive in Primitive:
        index = explore.random_cell(jax.random.fold_in(key, primitive), valid[primitive].reshape(-1))
        places.append(maps.normalise(frames, maps.cell_pose(frames, index)))
    return jnp.stack(places)


def act(
    key: jax.Array, cfg: Config, frames: Frames, state: DenseMaps, penalty: float, actions_taken: jax.Array
) -> Action:
    """The action to try while learning: greedy with exploration, Algorithm 1 lines 8-13."""
    key_cem, key_places, key_choose = jax.random.split(key, 3)
    choice = greedy(key_cem, cfg.cem, frames, state, penalty)
    places = random_places(key_places, frames, state.valid)
    primitive, u = explore.choose(key_choose, cfg.explore, actions_taken, choice.greedy, places)
    return Action(primitive=primitive, pose=maps.denormalise(frames, u))


def best_action(key: jax.Array, cfg: Config, frames: Frames, state: DenseMaps, penalty: float) -> Action:
    """The action of the learned policy, without exploration."""
    choice = greedy(key, cfg.cem, frames, state, penalty)
    u = choice.greedy.poses[choice.greedy.primitive]
    return Action(primitive=choice.greedy.primitive, pose=maps.denormalise(frames, u))


def random_grasp(key: jax.Array, frames: Frames, valid: jax.Array) -> Action:
    """A grasp at a random place above a block, with a random yaw; `valid` [P, K, h, w]."""
    u = random_places(key, frames, valid)[Primitive.GRASP]
    return Action(primitive=jnp.int32(Primitive.GRASP), pose=maps.denormalise(frames, u))
