"""Moves a Universal Robots arm and its gripper through the waypoints of a decision.

    python examples/11_ur_rtde.py decision.json                         # prints the set-points
    python examples/11_ur_rtde.py decision.json --host 192.168.1.10     # needs: pip install ur-rtde

`decision.json` is what `csac-jax act ... --workspace workspace.json --json decision.json` writes.
The controller's tool centre point must lie between the finger tips, its z along the fingers. Put
your gripper's driver into `gripper`. It was tested with a fake arm, never with a real one.
"""

import argparse
import importlib
import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation


def set_points(decision: dict[str, Any], reach: float, lowest: float) -> list[list[float]]:
    """Returns poses as `moveL` takes them: x, y, z m and a rotation vector, rad, robot's frame.
    Raises ValueError for one that is farther than `reach` m or lower than `lowest` m."""
    tools = np.array([waypoint["tool"] for waypoint in decision["waypoints"]], float)
    vectors = Rotation.from_matrix(tools[:, :3, :3]).as_rotvec()
    for place in tools[:, :3, 3]:
        if not (np.linalg.norm(place) <= reach and place[2] >= lowest):  # NaN is neither
            raise ValueError(f"{np.round(place, 3)} m is out of reach, or lower than {lowest} m")
    return np.concatenate([tools[:, :3, 3], vectors], axis=1).tolist()


def move(arm: Any, sense: Any, point: list[float], args: argparse.Namespace) -> bool:
    """Moves until the pose is reached; False where the force at the tool changed by more."""
    rest, idle = np.array(sense.getActualTCPForce()[:3]), arm.getAsyncOperationProgress()
    arm.moveL(point, args.speed, args.acceleration, True)
    while (progress := arm.getAsyncOperationProgress()) >= 0 or progress == idle:
        if np.linalg.norm(np.array(sense.getActualTCPForce()[:3]) - rest) > args.force:
            arm.stopL(2.0)
            return False
        time.sleep(0.008)
    return True


def execute(arm: Any, sense: Any, gripper: Any, decision: Any, args: argparse.Namespace) -> bool:
    """Goes through the waypoints; after contact straight up. Whether it came through."""
    points = set_points(decision, args.reach, args.lowest)
    if not all(map(arm.isPoseWithinSafetyLimits, points)):
        raise ValueError("a set-point is outside of the controller's safety limits")
    for waypoint, point in zip(decision["waypoints"], points, strict=True):
        gripper(waypoint["opening"])
        if not move(arm, sense, point, args):
            here = sense.getActualTCPPose()
            return move(arm, sense, [*here[:2], points[-1][2], *here[3:]], args) and False
    return True


def gripper(opening: float) -> None:
    """Opens the fingers to this width, m, and waits until they stand still: your gripper's."""
    raise NotImplementedError(f"the driver of your gripper, to {opening} m")


def main(*arguments: str) -> None:
    """Prints the set-points; with --host goes through them."""
    parser = argparse.ArgumentParser(description="see the head of this file")
    parser.add_argument("decision", type=Path)
    parser.add_argument("--host")
    limits = {"speed": 0.05, "acceleration": 0.2, "force": 15.0, "reach": 0.85, "lowest": 0.0}
    for name, default in limits.items():  # m/s, m/s^2, N, m, m
        parser.add_argument(f"--{name}", type=float, default=default)
    args = parser.parse_args(arguments)
    if not all(math.isfinite(getattr(args, name)) for name in limits):
        parser.error("limits must be finite")
    decision = json.loads(args.decision.read_text())["decisions"][0]
    for point in set_points(decision, args.reach, args.lowest):
        print(" ".join(f"{value:+.4f}" for value in point))
    if args.host:
        arm = importlib.import_module("rtde_control").RTDEControlInterface(args.host)
        sense = importlib.import_module("rtde_receive").RTDEReceiveInterface(args.host)
        print("done" if execute(arm, sense, gripper, decision, args) else "stopped by contact")
        arm.stopScript()


if __name__ == "__main__":
    main(*sys.argv[1:])
