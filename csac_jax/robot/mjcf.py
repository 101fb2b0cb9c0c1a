"""Robots as MJCF, checked against the gripper's numbers: a hand on four drives, or an arm."""

import contextlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from csac_jax import grippers
from csac_jax.assets import assets
from csac_jax.config import SimConfig
from csac_jax.errors import SceneError
from csac_jax.grippers import Gripper

PREFIX = "hand/"  # of the gripper's names in the model
PRESS = PREFIX + "z"  # drive along the tool, which gives way to more than sim.down_force
ARM_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist1", "wrist2", "wrist3")
FLOAT_MASS, FLOAT_COM, FLOAT_INERTIA = 1.0, 0.1, 0.002  # kg, m, kg m^2: ours, of all floating hands
# Of contacts with the gripper, where its MJCF leaves MuJoCo's own: a finger sinks less (ours).
_GRIPPER_IMPEDANCE = 0.99, 0.995
_MUJOCO_IMPEDANCE = 0.9, 0.95
_TOLERANCE = 0.001  # m, ours: between MJCF and numbers


class Drive(NamedTuple):
    """A joint of the floating hand and the position actuator that moves it."""

    name: str
    kind: mujoco.mjtJoint
    axis: tuple[float, float, float]
    kp: float  # N/m or N m/rad
    kv: float
    force: float  # most, N or N m


_SLIDE, _HINGE = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
_PRESS = Drive("z", _SLIDE, (0.0, 0.0, 1.0), 6000.0, 150.0, 100.0)  # downwards: sim.down_force
FLOAT = (  # ours
    Drive("x", _SLIDE, (1.0, 0.0, 0.0), 6000.0, 150.0, 150.0),
    Drive("y", _SLIDE, (0.0, 1.0, 0.0), 6000.0, 150.0, 150.0),
    _PRESS,
    Drive("yaw", _HINGE, (0.0, 0.0, 1.0), 60.0, 1.2, 10.0),
)


def pads(gripper: Gripper) -> tuple[str, str]:
    """Returns the names in the model of low pad and high pad."""
    low, high = gripper.pads
    return PREFIX + low, PREFIX + high


def hand_geoms(spec: mujoco.MjSpec, gripper: Gripper) -> tuple[list[str], list[str], list[str]]:
    """Returns the names in the model of the palm, of the low finger's geoms and of the high one's.

    A finger is its pad, which comes first, and the rest of the largest subtree without the other.
    """
    low, high = pads(gripper)
    return [PREFIX + gripper.palm], _finger(spec, low, high), _finger(spec, high, low)


def _finger(spec: mujoco.MjSpec, pad: str, other: str) -> list[str]:
    found, body = [pad], spec.geom(pad).parent
    while other not in (below := [geom.name for geom in body.find_all("geom")]):
        found, body = below, body.parent
    touch = [name for name in found if spec.geom(name).contype or spec.geom(name).conaffinity]
    return [pad, *(name for name in touch if name != pad)]


def joint_names(sim: SimConfig, gripper: Gripper) -> list[str]:
    """Returns the names in the model of all joints of the robot, the gripper's last."""
    fingers = [PREFIX + name for name in gripper.joints]
    if sim.robot == "hand":
        return [PREFIX + drive.name for drive in FLOAT] + fingers
    return [f"{sim.robot}/{name}" for name in ARM_JOINTS] + [PRESS] + fingers


def add(spec: mujoco.MjSpec, sim: SimConfig, gripper: Gripper) -> None:
    """Adds the robot of a config. Raises SceneError for MJCF that does not fit."""
    tool = read(gripper.folder / grippers.MJCF)
    _check(tool, gripper)
    for geom in tool.geoms:
        if tuple(geom.solimp[:2]) == _MUJOCO_IMPEDANCE:
            geom.solimp[:2] = _GRIPPER_IMPEDANCE
    for number, geom in enumerate(tool.geoms):
        geom.name = geom.name or f"{geom.parent.name}-{number}"  # a sensor names it
    if sim.robot == "hand":
        _add_floating(spec, tool, gripper)
        place = {"frame": spec.worldbody.add_frame()}
    else:
        _add_arm(spec, sim, gripper)
        _add_drive(spec, tool.body(gripper.body), _PRESS)
        place = {"site": spec.site(f"{sim.robot}/tip")}
    spec.attach(tool, prefix=PREFIX, **place)
    spec.actuator(PRESS).forcerange[0] = -sim.down_force


def read(path: Path) -> mujoco.MjSpec:
    """Reads an MJCF file. Raises SceneError."""
    with errors_of(path):
        return mujoco.MjSpec.from_file(str(path))


def _compile(path: Path) -> mujoco.MjModel:
    """Compiles a file alone: `attach` drops elements that refer to missing ones."""
    with errors_of(path):
        return mujoco.MjModel.from_xml_path(str(path))


@contextlib.contextmanager
def errors_of(path: Path) -> Iterator[None]:
    """Turns MuJoCo's errors in the block into SceneErrors of one line with the file."""
    try:
        yield
    except ValueError as error:
        raise SceneError(f"{path}: {' '.join(str(error).split())}") from None


def require(path: Path, kind: str, required: Iterable[str], elements: Iterable[Any]) -> None:
    """Raises SceneError for a missing element that the package addresses by name."""
    present = [element.name for element in elements if element.name]
    for name in required:
        if name not in present:
            has = ", ".join(present) or "none"
            raise SceneError(f"{path}: {kind} '{name}' is missing; it has: {has}")


def _require_actuators(path: Path, required: tuple[str, ...], spec: mujoco.MjSpec) -> None:
    present = [actuator.name for actuator in spec.actuators]
    if present != [*required]:
        names = f"{', '.join(required)}, not {', '.join(present)}"
        raise SceneError(f"{path}: actuators must be {names}")


def _add_floating(spec: mujoco.MjSpec, tool: mujoco.MjSpec, gripper: Gripper) -> None:
    root = tool.body(gripper.body)
    for geom in list(root.geoms):
        if not geom.contype and not geom.conaffinity:  # only visual
            tool.delete(geom)
    # The drives are made for one weight: all grippers get it.
    root.explicitinertial, root.mass, root.ipos = True, FLOAT_MASS, [0.0, 0.0, FLOAT_COM]
    root.inertia, root.iquat = [FLOAT_INERTIA] * 3, [1.0, 0.0, 0.0, 0.0]
    for drive in FLOAT:
        _add_drive(spec, root, drive)


def _add_drive(spec: mujoco.MjSpec, root: mujoco.MjsBody, drive: Drive) -> None:
    root.add_joint(name=drive.name, type=drive.kind, axis=drive.axis)
    actuator = spec.add_actuator(name=PREFIX + drive.name, target=PREFIX + drive.name)
    actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
    actuator.set_to_position(kp=drive.kp, kv=drive.kv)
    actuator.forcerange = [-drive.force, drive.force]


def _add_arm(spec: mujoco.MjSpec, sim: SimConfig, gripper: Gripper) -> None:
    path = assets() / f"{sim.robot}.xml"
    arm = read(path)
    require(path, "joint", ARM_JOINTS, arm.joints)
    require(path, "site", ("flange",), arm.sites)
    require(path, "body", ("base",), arm.bodies)
    require(path, "geom", ("base",), arm.geoms)
    _require_actuators(path, ARM_JOINTS, arm)
    _compile(path)
    x, y, z, yaw = sim.base
    base, pedestal, flange = arm.body("base"), arm.geom("base"), arm.site("flange")
    base.pos, base.quat = [x, y, z], [np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw)]
    pedestal.fromto = [0.0, 0.0, -z, *pedestal.fromto[3:]]
    length = flange.pos[2] + sim.adapter + gripper.depth[1]
    flange.parent.add_site(name="tip", pos=[0.0, 0.0, length], quat=[0.0, 1.0, 0.0, 0.0])
    spec.attach(arm, prefix=f"{sim.robot}/", frame=spec.worldbody.add_frame())


def _check(tool: mujoco.MjSpec, gripper: Gripper) -> None:
    path = gripper.folder / grippers.MJCF
    require(path, "body", (gripper.body,), tool.bodies)
    require(path, "joint", gripper.joints, tool.joints)
    require(path, "geom", (gripper.palm, *gripper.pads), tool.geoms)
    _require_actuators(path, (gripper.actuator,), tool)
    for name in {joint.name for joint in tool.joints} - {*gripper.joints}:
        raise SceneError(f"{path}: joint '{name}' is not among 'joints' of {grippers.NUMBERS}")
    model = _compile(path)
    for end, name in enumerate(("closed", "open")):
        opening, height = _measure(model, gripper, end)
        _require_same(path, f"opening when {name}", opening, gripper.opening[end])
        below = float(gripper.drop(gripper.half[end]))
        _require_same(path, f"height of the tips when {name}", height, -below)
    if gripper.varies is not None:
        _check_pads(path, model, gripper)


def _check_pads(path: Path, model: mujoco.MjModel, gripper: Gripper) -> None:
    thickness, width, _ = gripper.finger
    for name in gripper.pads:
        pad = model.geom(name)
        _require_same(path, f"thickness of {name}", 2.0 * pad.size[0], thickness)
        _require_same(path, f"width of {name}", 2.0 * pad.size[1], width)
        inner = abs(pad.pos[0]) - pad.size[0]
        _require_same(path, f"inner face of {name} in its finger's frame", inner, 0.0)


def _require_same(path: Path, what: str, measured: float, wanted: float) -> None:
    if abs(measured - wanted) > _TOLERANCE:
        by_numbers = f"by {grippers.NUMBERS} {1e3 * wanted:.1f} mm"
        raise SceneError(f"{path}: {what} is {1e3 * measured:.1f} mm, {by_numbers}")


def _measure(model: mujoco.MjModel, gripper: Gripper, end: int) -> tuple[float, float]:
    """Measures opening and height of the tips, m, with the joints at one end."""
    data = mujoco.MjData(model)
    for name, ends in zip(gripper.joints, gripper.positions, strict=True):
        data.qpos[model.joint(name).qposadr[0]] = ends[end]
    mujoco.mj_kinematics(model, data)
    root = data.body(gripper.body)
    turn, inner, lowest = root.xmat.reshape(3, 3), [], []
    for name, side in zip(gripper.pads, (1.0, -1.0), strict=True):
        geom = model.geom(name).id
        box = model.geom_aabb[geom]
        rotation = turn.T @ data.geom_xmat[geom].reshape(3, 3)
        centre = turn.T @ (data.geom_xpos[geom] - root.xpos) + rotation @ box[:3]
        half = np.abs(rotation) @ box[3:]
        inner.append(centre[0] + side * half[0])
        lowest.append(centre[2] - half[2])
    return float(inner[1] - inner[0]), float(min(lowest))
