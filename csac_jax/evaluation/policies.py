"""What acts: a policy is an object that takes one scene and a key, and returns an action."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from csac_jax import geometry
from csac_jax.agent import actor_critic, antipodal, maps, policy
from csac_jax.agent.actor_critic import Params
from csac_jax.agent.learner import Learner
from csac_jax.config import Config
from csac_jax.env import State
from csac_jax.io import checkpoint, files, policy_file
from csac_jax.nets import networks
from csac_jax.sim import oracle
from csac_jax.sim.primitives import Action
from csac_jax.training import programs
from csac_jax.vision.heightmap import Observation

Which = int | Literal["last", "best"]  # checkpoint of a run, see `load`


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
    """The greedy policy of trained networks, without exploration. With `policy.primitive rule`,
    which pushes after no visible change, and with `policy.retry`, it needs a State."""

    cfg: Config = struct.field(pytree_node=False)
    params: Params
    network: Any = struct.field(pytree_node=False, default=None)  # a critic of one's own

    @jax.jit
    def __call__(self, scene: Observation | State, key: jax.Array) -> Action:
        actions = self.batched(*jax.tree.map(lambda leaf: leaf[None], (scene, key)))
        return jax.tree.map(lambda leaf: leaf[0], actions)

    def batched(self, scenes: Observation | State, keys: jax.Array) -> Action:
        """Actions, leaves [E], of scenes, leaves [E, ...], and keys [E]. The networks see groups of
        scenes that fit the memory; under vmap they would see all."""
        parts, (obs, unchanged) = actor_critic.make(self.cfg, self.network), _seen(scenes)
        dense_maps = actor_critic.decision_maps(parts, self.params, obs)
        each = keys, parts, dense_maps, _failed(scenes)
        dense_maps = jax.vmap(policy.after_failures, (0, None, 0, 0))(*each)
        return jax.vmap(policy.best_action, (0, None, 0, 0))(keys, parts, dense_maps, unchanged)

    @jax.jit
    def debug(self, scene: Observation | State, key: jax.Array) -> PolicyDebug:
        """What the action in this scene with this key follows from."""
        parts = actor_critic.make(self.cfg, self.network)
        obs = jax.tree.map(lambda leaf: leaf[None], _seen(scene)[0])
        batch = actor_critic.decision_maps(parts, self.params, obs)
        dense_maps = jax.tree.map(lambda leaf: leaf[0], batch)
        places = geometry.cell_centres(self.cfg.heightmap)
        q = maps.best_over_yaws(parts.frames, dense_maps, places)
        candidates = policy.candidates(
            key, parts, policy.after_failures(key, parts, dense_maps, _failed(scene))
        )
        return PolicyDebug(q, candidates, actor_critic.best_grasp(dense_maps))


@struct.dataclass
class LearnerPolicy:
    """What a learner of one's own does without exploration."""

    cfg: Config = struct.field(pytree_node=False)
    learner: Learner = struct.field(pytree_node=False)
    state: Any

    @jax.jit
    def __call__(self, scene: Observation | State, key: jax.Array) -> Action:
        obs, unchanged = jax.tree.map(lambda leaf: leaf[None], _seen(scene))
        actions = self.learner.act(key, self.state, obs, unchanged)
        return jax.tree.map(lambda leaf: leaf[0], actions)


@struct.dataclass
class RandomPolicy:
    """Grasps at a random place, above a block unless `policy.cells` is `all`, at a random yaw."""

    cfg: Config = struct.field(pytree_node=False)

    @jax.jit
    def __call__(self, scene: Observation | State, key: jax.Array) -> Action:
        frames = maps.frames(self.cfg, networks.make(self.cfg.net))
        return policy.random_grasp(key, frames, maps.actionable_cells(frames, _seen(scene)[0]))


@struct.dataclass
class OraclePolicy:
    """A planner that reads the poses of the blocks: what physics allows at best. `cfg` must be that
    of the environment, whose kinds of blocks it holds."""

    cfg: Config = struct.field(pytree_node=False)

    @jax.jit
    def __call__(self, scene: Observation | State, key: jax.Array) -> Action:
        """Raises TypeError for an observation."""
        if not isinstance(scene, State):
            raise TypeError("the oracle reads the blocks' poses: give it a State, no Observation")
        # The same scene would have the same grasp fail again; a little turn is no change to see.
        failed = (scene.actions > 0) & (scene.info.cleared == 0)
        failures = jnp.where(
            failed, jnp.maximum(scene.steps_without_change, 1 + scene.actions % 2), 0
        )
        return oracle.grasp(self.cfg, scene.scene, scene.obs.height, failures)


@struct.dataclass
class GeometricPolicy:
    """Antipodal grasps from the height map's edges, without networks; see `agent.antipodal`."""

    cfg: Config = struct.field(pytree_node=False)
    weights: antipodal.Weights = antipodal.Weights()

    @jax.jit
    def __call__(self, scene: Observation | State, key: jax.Array) -> Action:
        obs, failures = _seen(scene)
        if isinstance(scene, State):  # it may have moved without being lifted
            failed = (scene.actions > 0) & (scene.info.cleared == 0)
            failures = jnp.maximum(failures, jnp.int32(failed))
        return antipodal.grasp(key, self.cfg, obs.height, obs.target, failures, self.weights)


def _seen(scenes: Observation | State) -> tuple[Observation, jax.Array]:
    """Observations and actions in a row without change [...], none after a bare observation."""
    if isinstance(scenes, State):
        return scenes.obs, scenes.steps_without_change
    return scenes, jnp.zeros(scenes.height.shape[:-2], jnp.int32)


def _failed(scenes: Observation | State) -> jax.Array:
    """Failed grasps in a row [...], none after a bare observation."""
    if isinstance(scenes, State):
        return scenes.failed_grasps
    return jnp.zeros(scenes.height.shape[:-2], jnp.int32)


def in_world(policy: Policy, cfg: Config) -> Policy:
    """The policy for an environment of this config; a policy of the user's own as it is."""
    if isinstance(
        policy, LearnedPolicy | LearnerPolicy | RandomPolicy | GeometricPolicy | OraclePolicy
    ):
        return dataclasses.replace(policy, cfg=cfg)
    return policy


def act(policy: Policy, states: State, keys: jax.Array) -> Action:
    """Actions, leaves [E], of a policy in states, leaves [E, ...], with keys [E]."""
    if isinstance(policy, LearnedPolicy):
        return policy.batched(states, keys)
    return jax.vmap(policy)(states, keys)


def load_config(source: str | Path, which: Which = "last") -> Config:
    """The config of a policy, see `load`."""
    path = policy_file.find(source)
    if path.is_file():
        return policy_file.load(path)[0]
    return checkpoint.load_config(*_checkpoint(path, which))


def load(
    source: str | Path, network: Any = None, learner: Learner | None = None, which: Which = "last"
) -> Policy:
    """The policy `shipped`, of a policy file, or of a checkpoint in a run's folder.

    Args: network and learner of one's own, where the run was trained with them; which, the
    checkpoint: `last`, the newest sound one; `best` of the evaluations on the way; or a step.
    Raises FileNotFoundError, PolicyFileError or CheckpointError, with the remedy.
    """
    path = policy_file.find(source)
    if path.is_file():
        return LearnedPolicy(*policy_file.load(path))
    folder, step = _checkpoint(path, which)
    cfg = checkpoint.load_config(folder, step)
    state, _ = checkpoint.restore(folder, programs.abstract_state(cfg, learner, network), step)
    if learner is None:
        policy_file.check_finite(folder, state.learner.online)
    return of_state(cfg, state.learner, network, learner)


def of_state(
    cfg: Config, state: Any, network: Any = None, learner: Learner | None = None
) -> Policy:
    """The policy of a learner's state; see `load`."""
    if learner is not None:
        return LearnerPolicy(cfg, learner, state)
    return LearnedPolicy(cfg, state.online, network)


def _checkpoint(run_dir: Path, which: Which) -> tuple[Path, int | None]:
    """The folder and step of a run's checkpoint; no step for the newest sound one."""
    if which != "best":
        return run_dir, None if which == "last" else int(which)
    if not (best := run_dir / files.BEST).exists():
        raise FileNotFoundError(f"there is no {best}; a run keeps its best with --eval-every N")
    return best, None


POLICIES: dict[str, Callable[..., Policy]] = {
    "learned": lambda source, which="last": load(source, which=which),
    "random": lambda source, which="last": RandomPolicy(load_config(source, which)),
    "geometric": lambda source, which="last": GeometricPolicy(load_config(source, which)),
    "oracle": lambda source, which="last": OraclePolicy(load_config(source, which)),
}
"""Kinds of policy by name: each made from a source, whose config it takes, see `load`."""
