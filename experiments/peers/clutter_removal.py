"""The simulator of Edge-Grasp-Network (arXiv:2211.00191), which descends from VGN and GIGA, in a
clone of the user's: its camera gives images, and a decision becomes a grasp of its hand.

Frames: its world has the table at the height of a finger and the square of 0.3 m in its corner; our
workspace is centred on that square, on the table. Its hand closes along y, with z ahead.
"""

import contextlib
import hashlib
import importlib
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from csac_jax.deploy.decision import Decision
from csac_jax.errors import SettingsError

View = Literal["above", "oblique"]
SIMULATOR = "simulator/simulation_clutter_bandit.py"
TIPS = 0.072  # m, from the hand's frame, its centre of mass, to its finger tips: hand.urdf
ABOVE = 0.6  # m (ours), of the camera that looks straight down, over the table
LOOKED_AT = 0.25  # m, height of the point that its oblique camera looks at, in its world
DISTANCE = (2.0, 2.5)  # of that camera, over the side of the square
POLAR, AZIMUTH = (np.pi / 4, np.pi / 3), (0.0, np.pi)  # rad, its direction from that point
UNUSED = ("open3d", "torch")  # it imports them for what an exam does not use


class Peer(NamedTuple):
    """The parts of the clone that an exam needs."""

    simulator: Any  # class
    grasp: Any  # class of a pose and a width
    transform: Any  # class of a pose
    digest: str  # SHA-256 of the simulator's file


class Image(NamedTuple):
    """The arguments of `CameraPolicy.observe`."""

    rgb: np.ndarray  # [h, w, 3] uint8
    depth: np.ndarray  # [h, w] m; 0 where it ends
    intrinsics: dict[str, float]
    camera_pose: np.ndarray  # [4, 4] camera to workspace


def load(clone: Path) -> Peer:
    """Imports the simulator of a clone. Raises SettingsError if it or PyBullet is missing."""
    path = clone / SIMULATOR
    if not path.is_file():
        raise SettingsError(f"'{clone}' is no clone of Edge-Grasp-Network: it has no {SIMULATOR}")
    with _importable(path.parent):
        try:
            simulation, grasp = map(importlib.import_module, (path.stem, "grasp"))
        except ImportError as error:
            raise SettingsError(f"{path} needs {error.name}: pip install pybullet") from None
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return Peer(simulation.ClutterRemovalSim, grasp.Grasp, simulation.Transform, digest)


@contextlib.contextmanager
def _importable(folder: Path) -> Iterator[None]:
    """Lets its modules be imported, with empty ones for those of `UNUSED` that are missing."""
    missing = [name for name in UNUSED if importlib.util.find_spec(name) is None]
    sys.modules.update({name: types.ModuleType(name) for name in missing})
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))
        for name in missing:
            del sys.modules[name]


def start(peer: Peer, clone: Path, scene: str, objects: str) -> Any:
    """Starts the simulator, whose working directory must be the clone.

    Raises SettingsError for objects that the clone does not have.
    """
    folder = Path("data_robot", "urdfs", scene, objects)
    if not any((clone / folder).glob("*.urdf")):
        raise SettingsError(f"'{clone}' has no objects in {folder}: get the data its README names")
    return peer.simulator(scene, f"{scene}/{objects}", gui=False, rand=True)


def workspace(sim: Any) -> np.ndarray:
    """Returns the pose [4, 4] of our workspace in its world."""
    pose = np.eye(4)
    pose[:3, 3] = 0.5 * sim.size, 0.5 * sim.size, sim.gripper.finger_depth
    return pose


def camera(sim: Any, view: View, rng: np.random.Generator) -> np.ndarray:
    """Returns a camera's pose [4, 4] in its world: straight down, or drawn as its own exam does."""
    place = workspace(sim)[:3, 3]
    if view == "above":
        place[2] += ABOVE
        return _looking(place, [0.0, 0.0, -1.0], [0.0, 1.0, 0.0])
    polar, azimuth = rng.uniform(*POLAR), rng.uniform(*AZIMUTH)
    away = np.array(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]
    )
    place[2] = LOOKED_AT
    return _looking(place + rng.uniform(*DISTANCE) * sim.size * away, -away, [0.0, 0.0, 1.0])


def _looking(place: Any, ahead: Any, up: Any) -> np.ndarray:
    right = np.cross(ahead, up) / np.linalg.norm(np.cross(ahead, up))
    pose = np.eye(4)
    pose[:3] = np.column_stack([right, np.cross(ahead, right), ahead, place])
    return pose


def photograph(
    peer: Peer, sim: Any, pose: np.ndarray, noise: float, rng: np.random.Generator
) -> Image:
    """Renders a scene from a camera's `pose` [4, 4] in its world.

    Its pixels have their centres half a pixel inside, ours at whole numbers. Depth gets `noise` m.
    """
    rgb, depth = sim.camera.render(peer.transform.from_matrix(np.linalg.inv(pose)))
    lens = sim.camera.intrinsic
    depth = np.where(depth < 0.99 * sim.camera.far, depth, 0.0)
    depth = depth + noise * (depth > 0.0) * rng.standard_normal(depth.shape)
    centre = {"cx": float(lens.cx) - 0.5, "cy": float(lens.cy) - 0.5}
    intrinsics = {"fx": float(lens.fx), "fy": float(lens.fy), **centre}
    size = {"width": int(lens.width), "height": int(lens.height)}
    to_workspace = np.linalg.inv(workspace(sim))
    return Image(np.ascontiguousarray(rgb), depth, size | intrinsics, to_workspace @ pose)


def to_grasp(peer: Peer, sim: Any, decision: Decision) -> Any:
    """Converts a decision whose waypoints are in its world to its grasp."""
    down = decision.waypoints[1]
    tool = np.array(down.tool)  # closes along x, z ahead
    hand = np.array([[0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, -TIPS]])
    pose = tool @ np.vstack([hand, [0.0, 0.0, 0.0, 1.0]])
    width = min(decision.width, sim.gripper.max_opening_width)
    return peer.grasp(peer.transform.from_matrix(pose), width)
