"""Policies: objects that take one scene and a key, and return an action."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from csac_jax import geometry
from csac_jax.agent import actor_critic, maps, policy, values
from csac_jax.agent.learner import Learner
from csac_jax.baselines import antipodal, oracle, planner
from csac_jax.config import Config
from csac_jax.constants import Primitive
from csac_jax.env import State
from csac_jax.errors import SettingsError
from csac_jax.io import checkpoint, files, made_for, policy_file
from csac_jax.nets import networks
from csac_jax.robot.primitives import Action
from csac_jax.runtime import modules, short
from csac_jax.section import require
from csac_jax.training import memory, own_parts, programs
from csac_jax.vision import heightmap
from csac_jax.vision.heightmap import Observation
from csac_jax.world import scene_state

PROPOSALS = 8  # grasps, and as many pushes, that networks propose to the planner (ours)
Which = int | Literal["last", "best"]  # checkpoint of a run, see `load`


class Policy(Protocol):
    """A pure function of one scene and a key that returns an action: vmap and jit it."""

    @property
    def cfg(self) -> Config:
        """Returns the config of the scenes, views and task that the policy acts in."""

    def __call__(self, scene: Observation | State, key: jax.Array) -> Action:
        """Chooses the action in a scene, given as its observation or as the environment's state."""


class PolicyDebug(NamedTuple):
    """Values behind a decision of a network policy. P = primitives, J = CEM candidates."""

    q: jax.Array  # [P, H, W] largest value over the yaws; -inf where there is nothing to act on
    candidates: jax.Array  # [P, J, 3] m, m, rad: the poses of the last CEM round
    best_grasp: jax.Array  # [] phi_g of CSAC eq. 16, by the critic that acts

    def __repr__(self) -> str:
        return short.text(self)


@struct.dataclass
class NetworkPolicy:
    """The greedy policy of trained networks, without exploration. With `policy.primitive rule`,
    which pushes after no visible change, and with `policy.retry_temperature`, it needs a State."""

    cfg: Config = struct.field(pytree_node=False)
    params: actor_critic.Params
    network: Any = struct.field(pytree_node=False, default=None)  # a custom critic

    __repr__ = short.text

    @jax.jit
    def __call__(self, scene: Observation | State, key: jax.Array) -> Action:
        return _first(self.batched(*_alone((scene, key))))

    def batched(self, scenes: Observation | State, keys: jax.Array) -> Action:
        """Chooses actions, leaves [E], for scenes, leaves [E, ...], and keys [E]. The networks see
        groups of scenes that fit the memory; under vmap they would see all."""
        parts, (obs, unchanged, failed) = actor_critic.make(self.cfg, self.network), _seen(scenes)
        dense_maps = values.decision_maps(parts, self.params, obs)
        retried = jax.vmap(policy.after_failures, (0, None, 0, 0))
        dense_maps = retried(keys, parts, dense_maps, failed)
        return jax.vmap(policy.best_action, (0, None, 0, 0))(keys, parts, dense_maps, unchanged)

    def proposals(self, scene: Observation | State, num: int) -> tuple[Action, Action]:
        """Returns the best distinct grasps and pushes, leaves [num, ...] each."""
        parts = actor_critic.make(self.cfg, self.network)
        dense_maps = _first(values.decision_maps(parts, self.params, _alone(_seen(scene)[0])))
        grasps, pushes = (
            policy.proposals(parts, dense_maps, kind, num)
            for kind in (Primitive.GRASP, Primitive.PUSH)
        )
        return grasps, pushes

    @jax.jit
    def debug(self, scene: Observation | State, key: jax.Array) -> PolicyDebug:
        """Returns the values behind the action in this scene with this key."""
        parts, (obs, _, failed) = actor_critic.make(self.cfg, self.network), _seen(scene)
        dense_maps = _first(values.decision_maps(parts, self.params, _alone(obs)))
        places = geometry.cell_centres(self.cfg.heightmap)
        q = maps.best_over_yaws(parts.frames, dense_maps, places)
        retried = policy.after_failures(key, parts, dense_maps, failed)
        candidates = policy.candidates(key, parts, retried)
        return PolicyDebug(q, candidates, values.best_grasp(dense_maps))


@struct.dataclass
class CustomLearnerPolicy:
    """The greedy policy of a custom learner."""

    cfg: Config = struct.field(pytree_node=False)
    learner: Learner = struct.field(pytree_node=False)
    state: Any

    __repr__ = short.text

    @jax.jit
    def __call__(self, scene: Observation | State, key: jax.Array) -> Action:
        obs, unchanged, _ = _alone(_seen(scene))
        return _first(self.learner.act(key, self.state, obs, unchanged))


@struct.dataclass
class RandomPolicy:
    """Random grasps, above a block unless `policy.action_mask` is `none`."""

    cfg: Config = struct.field(pytree_node=False)

    __repr__ = short.text

    @jax.jit
    def __call__(self, scene: Observation | State, key: jax.Array) -> Action:
        frames = maps.frames(self.cfg, networks.make(self.cfg.net))
        return policy.random_grasp(key, frames, maps.actionable_cells(frames, _seen(scene)[0]))


@struct.dataclass
class OraclePolicy:
    """A planner that reads the poses of the blocks. `cfg` must be the environment's, whose kinds of
    blocks it holds."""

    cfg: Config = struct.field(pytree_node=False)

    __repr__ = short.text

    @jax.jit
    def __call__(self, scene: Observation | State, key: jax.Array) -> Action:
        """Chooses a grasp. Raises TypeError for an observation."""
        if not isinstance(scene, State):
            raise TypeError("the oracle reads the blocks' poses: give it a State, no Observation")
        # The same scene would have the same grasp fail again; a little turn is no change to see.
        turned = jnp.maximum(scene.steps_without_change, 1 + scene.actions % 2)
        failures = jnp.where(_without_lift(scene), turned, 0)
        return oracle.grasp(self.cfg, scene.scene, scene.obs.height, failures)


@struct.dataclass
class GeometricPolicy:
    """Antipodal grasps from the height map's edges, without networks; see `baselines.antipodal`."""

    cfg: Config = struct.field(pytree_node=False)
    weights: antipodal.Weights = antipodal.Weights()

    __repr__ = short.text

    @jax.jit
    def __call__(self, scene: Observation | State, key: jax.Array) -> Action:
        obs, failures, _ = _seen(scene)
        if isinstance(scene, State):  # it may have moved without being lifted
            failures = jnp.maximum(failures, jnp.int32(_without_lift(scene)))
        wanted = heightmap.wanted(obs.target)
        return antipodal.grasp(key, self.cfg, obs.height, wanted, failures, self.weights)


@struct.dataclass
class PlannerPolicy:
    """A planner that reads the scene's state and simulates its choices, see `baselines.planner`.

    Networks, if there are any, propose the actions; else they are random. `cfg` must be the
    environment's. Under vmap, scenes are planned one after the other: each has a batch of its own.
    """

    cfg: Config = struct.field(pytree_node=False)
    proposer: NetworkPolicy | None = None
    budget: planner.Budget = planner.Budget()

    __repr__ = short.text

    @jax.jit
    def __call__(self, scene: Observation | State, key: jax.Array) -> Action:
        """Chooses an action. Raises TypeError for an observation."""
        if not isinstance(scene, State):
            raise TypeError("the planner simulates the scene: give it a State, no Observation")
        return _planned(self, scene, key)


@jax.custom_batching.sequential_vmap
def _planned(policy: PlannerPolicy, state: State, key: jax.Array) -> Action:
    cfg, physics = policy.cfg, planner.make_physics(policy.cfg)
    scene = scene_state.park(state.scene, ~state.done & state.scene.in_play)
    proposed = policy.proposer.proposals(state, PROPOSALS) if policy.proposer else None
    return planner.plan(key, cfg, physics, scene, state.obs.height, policy.budget, proposed)


def _alone(tree: Any) -> Any:
    """Makes a batch of one, leaves [1, ...]."""
    return jax.tree.map(lambda leaf: leaf[None], tree)


def _first(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[0], tree)


def _seen(scenes: Observation | State) -> tuple[Observation, jax.Array, jax.Array]:
    """Returns observations, and actions without change and failed grasps in a row [...], both 0 for
    a bare observation."""
    if isinstance(scenes, State):
        return scenes.obs, scenes.steps_without_change, scenes.failed_grasps
    zero = jnp.zeros(scenes.height.shape[:-2], jnp.int32)
    return scenes, zero, zero


def _without_lift(scene: State) -> jax.Array:
    """Returns True where the last action took no block, [] bool."""
    return (scene.actions > 0) & (scene.info.cleared == 0)


def is_learned(policy: Policy) -> bool:
    """Returns whether networks act or propose, which must know a suite's task."""
    if isinstance(policy, PlannerPolicy):
        return policy.proposer is not None
    return isinstance(policy, NetworkPolicy)


def warn_if_elsewhere(policy: Policy, cfg: Config) -> None:
    """Warns of networks in a world that they were not trained in."""
    if is_learned(policy):
        made_for.warn_if_elsewhere(policy.cfg, cfg)


def in_world(policy: Policy, cfg: Config) -> Policy:
    """Gives a policy the config of an environment, of which networks keep the task that they were
    trained for: it decides if they see a mask. A custom policy stays as it is."""
    if isinstance(policy, PlannerPolicy) and policy.proposer is not None:
        return policy.replace(cfg=cfg, proposer=in_world(policy.proposer, cfg))
    if isinstance(policy, NetworkPolicy):
        return policy.replace(cfg=cfg.change(task={"kind": policy.cfg.task.kind}))
    baselines = RandomPolicy | GeometricPolicy | OraclePolicy | PlannerPolicy
    ours = CustomLearnerPolicy | baselines
    return dataclasses.replace(policy, cfg=cfg) if isinstance(policy, ours) else policy


def load_config(source: str | Path, which: Which = "last") -> Config:
    """Reads the config of a policy; see `load`."""
    if (path := policy_file.find(source)).is_file():
        return policy_file.load(path)[0]
    return checkpoint.load_config(*_checkpoint(path, which), acts=True)


def load(
    source: str | Path, network: Any = None, learner: Learner | None = None, which: Which = "last"
) -> Policy:
    """Loads a shipped policy, a policy file, or a checkpoint in a run's folder.

    Args: network and learner, of a run that was trained with custom ones; which, the
    checkpoint: `last`, the newest sound one; `best` of the evaluations on the way; or a step.
    Raises FileNotFoundError, PolicyFileError or CheckpointError, with the remedy.
    """
    if (path := policy_file.find(source)).is_file():
        return NetworkPolicy(*policy_file.load(path))
    folder, step = _checkpoint(path, which)
    cfg = checkpoint.load_config(folder, step, acts=True)
    own_parts.check_loadable(folder, cfg, own_parts.OwnParts(network=network, learner=learner))
    shapes = programs.abstract_state(cfg, learner, network)
    needed, room = memory.tree_bytes(shapes) / memory.GIB, memory.limit() / memory.GIB
    if needed > room:
        fault = f"its state takes {needed:.1f} GiB, there are {room:.1f}"
        raise checkpoint.CheckpointError(f"{folder}: {fault}; use a machine with more memory")
    state, _ = checkpoint.restore(folder, shapes, step)
    if learner is None:
        policy_file.check_finite(folder, state.learner.online)
    return policy_from_state(cfg, state.learner, network, learner)


def policy_from_state(
    cfg: Config, state: Any, network: Any = None, learner: Learner | None = None
) -> Policy:
    """Builds the policy of a learner's state; see `load`."""
    if learner is not None:
        return CustomLearnerPolicy(cfg, learner, state)
    return NetworkPolicy(cfg, state.online, network)


def _checkpoint(run_dir: Path, which: Which) -> tuple[Path, int | None]:
    if which != "best":
        return run_dir, None if which == "last" else int(which)
    if not (best := files.inside(run_dir, files.BEST)).exists():
        raise FileNotFoundError(f"there is no {best}; a run keeps its best with eval_every")
    return best, None


def make(kind: str, source: str | Path, which: Which = "last") -> Policy:
    """Makes the policy of a kind: `learned`, the networks of `source`, see `load`;
    `learned+planner`, which has physics choose among what they propose; or a name of `BASELINES` or
    `MODULE:NAME`, a callable that takes the config of `source`. Raises SettingsError for an unknown
    kind."""
    if kind in LEARNED:
        learned: Any = load(source, which=which)
        return learned if kind == "learned" else PlannerPolicy(learned.cfg, learned)
    if kind not in BASELINES and ":" not in kind:
        known = ", ".join((*LEARNED, *BASELINES))
        raise SettingsError(f"policy: '{kind}' is neither MODULE:NAME nor one of: {known}")
    build = BASELINES[kind] if kind in BASELINES else _imported(kind)
    return build(load_config(source, which))


def _imported(path: str) -> Callable[[Config], Policy]:
    """Imports `MODULE:NAME`, also from the current folder."""
    module, _, name = path.partition(":")
    try:
        return getattr(modules.load(module), name)
    except (SettingsError, AttributeError) as error:
        raise SettingsError(f"policy: '{path}' cannot be imported ({error})") from None


def register(name: str, build: Callable[[Config], Policy]) -> None:
    """Registers a policy, made from the config that it acts in, for `eval` and `play`.

    Raises SettingsError if the name is taken.
    """
    taken = name in BASELINES or name in LEARNED
    require(not taken, f"policy '{name}' exists; choose another name")
    BASELINES[name] = build


LEARNED = ("learned", "learned+planner")
"""Kinds with the networks of a source."""
BASELINES: dict[str, Callable[[Config], Policy]] = {
    "random": RandomPolicy,
    "geometric": GeometricPolicy,
    "oracle": OraclePolicy,
    "planner": PlannerPolicy,
}
"""Policies without networks, each made from the config that it acts in."""
