"""What acts: a policy is an object that takes one scene and a key, and returns an action."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from csac_jax import geometry
from csac_jax.agent import learner as learning, maps, policy
from csac_jax.agent.learner import Learner, Params
from csac_jax.config import Config
from csac_jax.env import State
from csac_jax.io import checkpoint, policy_file
from csac_jax.sim import oracle
from csac_jax.sim.primitives import Action
from csac_jax.training import step
from csac_jax.vision.heightmap import Observation


class Policy(Protocol):
    """Chooses the action of one scene. Pure: vmap and jit it."""

    @property
    def cfg(self) -> Config:
        """Config of the scenes, views and task that the policy acts in."""

    def __call__(self, scene: Observation | State, key: jax.Array) -> Action:
        """The action in a scene, given as its observation or as the environment's state."""


class PolicyDebug(NamedTuple):
    """What a learned policy computed in a state. P = primitives, J = CEM candidates."""

    q: jax.Array  # [P, H, W] largest value over the yaws; -inf where there is nothing to act on
    candidates: jax.Array  # [P, J, 3] m, m, rad: the poses of the last CEM round
    best_grasp: jax.Array  # [] phi_g of CSAC eq. 16, by the critic that acts


@struct.dataclass
class LearnedPolicy:
    """The greedy policy of trained networks, without exploration.

    The rule that pushes after no visible change (`policy.primitive rule`) needs a State: a bare
    Observation counts as one after a change.
    """

    cfg: Config = struct.field(pytree_node=False)
    params: Params

    @jax.jit
    def __call__(self, scene: Observation | State, key: jax.Array) -> Action:
        """See `Policy`."""
        actions = self.batched(*jax.tree.map(lambda leaf: leaf[None], (scene, key)))
        return jax.tree.map(lambda leaf: leaf[0], actions)

    def batched(self, scenes: Observation | State, keys: jax.Array) -> Action:
        """Actions, leaves [E], of scenes, leaves [E, ...], and keys [E].

        The networks see groups of scenes that fit the memory. Under vmap they would see all.
        """
        learner = learning.make(self.cfg)
        dense_maps = learning.look(learner, self.params, _observation(scenes))
        nothing = jnp.zeros(len(keys), jnp.int32)
        unchanged = scenes.steps_without_change if isinstance(scenes, State) else nothing
        best = jax.vmap(policy.best_action, (0, None, None, 0, None, 0))
        return best(keys, self.cfg, learner.frames, dense_maps, _return_range(learner), unchanged)

    @jax.jit
    def debug(self, scene: Observation | State, key: jax.Array) -> PolicyDebug:
        """What the action in this scene with this key follows from."""
        learner = learning.make(self.cfg)
        obs = jax.tree.map(lambda leaf: leaf[None], _observation(scene))
        batch = learning.look(learner, self.params, obs)
        dense_maps = jax.tree.map(lambda leaf: leaf[0], batch)
        places = geometry.cell_centres(self.cfg.heightmap)
        q, _ = maps.best_over_yaws(learner.frames, dense_maps, places)
        candidates = policy.candidates(
            key, self.cfg, learner.frames, dense_maps, _return_range(learner)
        )
        return PolicyDebug(q, candidates, learning.best_grasp(dense_maps))


@struct.dataclass
class RandomPolicy:
    """Grasps at a random place above a block, with a random yaw."""

    cfg: Config = struct.field(pytree_node=False)

    @jax.jit
    def __call__(self, scene: Observation | State, key: jax.Array) -> Action:
        """See `Policy`."""
        frames = maps.frames(self.cfg)
        return policy.random_grasp(key, frames, maps.actionable(frames, _observation(scene)))


@struct.dataclass
class OraclePolicy:
    """A planner that reads the poses of the blocks: what physics allows at best.

    `cfg` must be that of the environment, whose kinds of blocks it holds.
    """

    cfg: Config = struct.field(pytree_node=False)

    @jax.jit
    def __call__(self, scene: Observation | State, key: jax.Array) -> Action:
        """See `Policy`. Raises TypeError for an observation."""
        if not isinstance(scene, State):
            raise TypeError("the oracle reads the blocks' poses: give it a State, no Observation")
        cfg = self.cfg
        return oracle.grasp(cfg.sim, cfg.heightmap, cfg.scene.slots, scene.scene, scene.obs.height)


def _observation(scene: Observation | State) -> Observation:
    return scene.obs if isinstance(scene, State) else scene


def _return_range(learner: Learner) -> float:
    low, high = learner.bounds
    return high - low


def in_world(policy: Policy, cfg: Config) -> Policy:
    """The policy for an environment of this config; a policy of the user's own as it is."""
    if isinstance(policy, LearnedPolicy | RandomPolicy | OraclePolicy):
        return dataclasses.replace(policy, cfg=cfg)
    return policy


def act(policy: Policy, states: State, keys: jax.Array) -> Action:
    """Actions, leaves [E], of a policy in states, leaves [E, ...], with keys [E]."""
    if isinstance(policy, LearnedPolicy):
        return policy.batched(states, keys)
    return jax.vmap(policy)(states, keys)


def load_config(source: str | Path) -> Config:
    """The config of a policy, see `load`."""
    path = _path(source)
    return policy_file.load(path)[0] if path.is_file() else checkpoint.load_config(path)


def load(source: str | Path) -> LearnedPolicy:
    """The policy `shipped`, of a policy file, or of the newest checkpoint in a run's folder.

    Raises FileNotFoundError, PolicyFileError or CheckpointError, with the remedy.
    """
    path = _path(source)
    if path.is_file():
        return LearnedPolicy(*policy_file.load(path))
    cfg = checkpoint.load_config(path)
    state, _ = checkpoint.restore(path, step.abstract_state(cfg))
    return LearnedPolicy(cfg, state.learner.online)


def _path(source: str | Path) -> Path:
    path = policy_file.SHIPPED if source == "shipped" else Path(source)
    if not path.exists():
        raise FileNotFoundError(
            f"there is no folder {path}; give the folder of a run, a policy file, or shipped"
        )
    return path


POLICIES: dict[str, Callable[[str], Policy]] = {
    "learned": load,
    "random": lambda source: RandomPolicy(load_config(source)),
    "oracle": lambda source: OraclePolicy(load_config(source)),
}
"""Kinds of policy by name: each made from a source, whose config it takes, see `load`."""
