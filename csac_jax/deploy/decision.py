"""From points and colours to a decision for a robot: a primitive, a place, waypoints."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import geometry, grippers
from csac_jax.agent import actor_critic, maps, policy, values
from csac_jax.agent.actor_critic import Params
from csac_jax.agent.maps import DenseMaps
from csac_jax.config import Config
from csac_jax.constants import Primitive
from csac_jax.robot import primitives
from csac_jax.robot.primitives import Action
from csac_jax.section import require
from csac_jax.vision import heightmap
from csac_jax.vision.heightmap import VIEW_HEIGHT, Observation

APART = 0.03  # m (ours), between alternatives of one primitive: more than a finger's width
STATIONS = ("approach", "descend", "act", "retreat")


class Choice(NamedTuple):
    """One action."""

    action: Action
    score: jax.Array  # [] Q
    valid: jax.Array  # [] bool, there is something to act on
    stations: jax.Array  # [4, 5] x m, y m, z m, yaw rad, half the opening m; `STATIONS`


class Waypoint(NamedTuple):
    """A pose of the tool, and how far the fingers are open on arrival."""

    name: str  # of STATIONS; on the way to `act` the fingers close, or push
    position: tuple[float, float, float]  # m, between the finger tips, workspace frame
    yaw: float  # rad about z: fingers close along it, a push goes along it
    opening: float  # m, between the fingers
    tool: tuple[tuple[float, ...], ...]  # 4 x 4, tool to robot frame: x along the yaw, z down


@dataclasses.dataclass(frozen=True)
class Decision:
    """One action, in the workspace's frame."""

    primitive: str  # grasp or push
    position: tuple[float, float, float]  # m, of the finger tips where they begin to act
    yaw: float  # rad in [0, 2 pi)
    width: float  # m, opening of the fingers on the way down; 0 for a push
    score: float  # Q: discounted reward that is expected
    waypoints: tuple[Waypoint, ...]

    def to_dict(self) -> dict[str, Any]:
        """Returns the decision as JSON values."""
        waypoints = [waypoint._asdict() for waypoint in self.waypoints]
        return {**dataclasses.asdict(self), "waypoints": waypoints}


def observe(cfg: Config, points: Any, valid: Any, colour: Any, target: Any) -> Observation:
    """Projects points [n, 3] m of the workspace below VIEW_HEIGHT to the view from above.

    Args: valid [n] bool; colour [n, 3] uint8; target [n] bool, or None if any object will do.
    """
    cells = heightmap.from_points(cfg.heightmap, points, valid & (points[:, 2] < VIEW_HEIGHT))
    seen = colour.at[cells.source].get(mode="promise_in_bounds").astype(jnp.float32) / 255.0
    marked = jnp.ones(cells.source.shape, bool)
    if target is not None:
        marked = target.at[cells.source].get(mode="promise_in_bounds")
    obs = heightmap.observation(cells, seen, marked, jnp.array(target is None))
    return obs.replace(fingers=fingers(cfg))


def fingers(cfg: Config) -> jax.Array | None:
    """Returns the gripper's numbers as the networks see them, [3] m; None if they do not.

    Raises SettingsError for a gripper that varies: a robot has one.
    """
    gripper = grippers.load(cfg.sim.gripper)
    known = ", ".join(grippers.shipped())
    fault = f"gripper: name the robot's, one of {known}, or its folder"
    require(gripper.varies is None, fault)
    return jnp.array(gripper.fingers, jnp.float32) if cfg.net.gripper else None


def dense_maps(cfg: Config, params: Params, obs: Observation, only_target: bool) -> DenseMaps:
    """Computes the dense maps of one state; see `batch_maps`."""
    batch = batch_maps(cfg, params, jax.tree.map(lambda leaf: leaf[None], obs), only_target)
    return jax.tree.map(lambda leaf: leaf[0], batch)


def batch_maps(cfg: Config, params: Params, obs: Observation, only_target: bool) -> DenseMaps:
    """Computes the dense maps of states, leaves [B, ...].

    With `only_target`, a policy whose networks see no target may only grasp, and only the target.
    """
    learner = actor_critic.make(cfg)
    state = values.decision_maps(learner, params, obs)
    if not only_target or learner.frames.shows_target:
        return state
    frames = dataclasses.replace(learner.frames, shows_target=True, all_cells=False)
    valid = jax.vmap(maps.actionable_cells, (None, 0))(frames, obs)
    return state.replace(valid=valid.at[:, int(Primitive.PUSH)].set(False))


def choose(cfg: Config, state: DenseMaps, height: jax.Array) -> tuple[Choice, DenseMaps]:
    """Returns the best action in a state of height map [H, W] m, and the state without the cells
    of this primitive within APART of it."""
    learner = actor_critic.make(cfg)
    best = policy.greedy(jax.random.key(0), learner, state, jnp.int32(0))
    pose = maps.denormalise(learner.frames, best.poses[best.primitive])
    action = Action(primitive=best.primitive, pose=pose)
    valid = maps.is_valid(learner.frames, state.valid, best.primitive, pose)
    choice = Choice(action, best.values[best.primitive], valid, stations(cfg, height, action))
    offset = learner.frames.xy - pose[:2][None, None, None]
    far = jnp.sum(offset**2, axis=-1) >= APART**2  # [K, h, w]
    other = jnp.arange(len(Primitive)) != best.primitive
    return choice, state.replace(valid=state.valid & (far[None] | other[:, None, None, None]))


def stations(cfg: Config, height: jax.Array, action: Action) -> jax.Array:
    """Returns the hand's set-points [4, 5] at the ends of the simulated primitive's phases."""
    plan = primitives.plan(cfg.sim, cfg.heightmap, height, action)
    is_grasp = action.primitive == Primitive.GRASP
    ends = [np.cumsum(phases) - 1 for phases in (cfg.sim.push_phases, cfg.sim.grasp_phases)]
    last = jnp.where(is_grasp, ends[1], ends[0])
    return jnp.concatenate([plan.start[None], plan.control[last]])


def best_over_yaws(cfg: Config, state: DenseMaps) -> jax.Array:
    """Returns the largest Q over the yaws [P, H, W], -inf if nothing is there; for pictures."""
    places = geometry.cell_centres(cfg.heightmap)
    return maps.best_over_yaws(actor_critic.make(cfg).frames, state, places)


def from_choice(choice: Choice, workspace_pose: np.ndarray) -> Decision:
    """Converts a choice on the host; `workspace_pose` [4, 4] maps workspace to robot."""
    waypoints = tuple(
        _waypoint(name, station, workspace_pose)
        for name, station in zip(STATIONS, np.asarray(choice.stations, float), strict=True)
    )
    _, position, yaw, width, _ = waypoints[1]
    primitive = Primitive(int(choice.action.primitive)).name.lower()
    return Decision(primitive, position, yaw, width, float(choice.score), waypoints)


def _waypoint(name: str, station: np.ndarray, workspace_pose: np.ndarray) -> Waypoint:
    x, y, z, yaw, half_opening = map(float, station)
    cos, sin = np.cos(yaw), np.sin(yaw)
    tool = np.array([[cos, sin, 0, x], [sin, -cos, 0, y], [0, 0, -1, z], [0, 0, 0, 1]])
    rows = (workspace_pose @ tool).tolist()
    return Waypoint(name, (x, y, z), yaw, 2.0 * half_opening, tuple(map(tuple, rows)))
