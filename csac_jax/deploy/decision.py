"""A decision for a robot: a primitive, its place, and the waypoints of the tool."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from csac_jax.constants import Primitive
from csac_jax.deploy.decision_program import Choice

STATIONS = ("approach", "descend", "act", "retreat")


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
