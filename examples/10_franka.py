"""Moves a Franka arm and its hand through the waypoints of a decision.

    python examples/10_franka.py decision.json                    # prints the set-points
    python examples/10_franka.py decision.json --host 172.16.0.2  # pip install franky-control

`csac-jax act ... --gripper franka_hand --workspace workspace.json --json decision.json` writes the
decision. The arm's end effector must be the hand's own, as the Desk sets it. It was tested with a
fake arm and in the simulator franky-sim (`--host 127.0.0.1 --sim`), never with a real arm.
"""

import argparse
import importlib
import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

TIPS = 0.0095  # m from the Desk's end effector to the tips: 0.1129 - 0.1034 from the flange
CLOSING = 0.05  # m/s, of the fingers
# Columns are the hand's axes in the tool's: its fingers close along its y, the tool's along x.
HAND = np.array([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, -TIPS], [0, 0, 0, 1]], float)
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])  # the hand is the same after it


def set_points(decision: dict[str, Any], reach: float, lowest: float) -> list[np.ndarray]:
    """Returns the end effector's pose [4, 4] at each waypoint, in the robot's frame. Raises
    ValueError for tips that are farther than `reach` m or lower than `lowest` m."""
    tools = [np.array(waypoint["tool"], float) for waypoint in decision["waypoints"]]
    for place in (tool[:3, 3] for tool in tools):
        if not (np.linalg.norm(place) <= reach and place[2] >= lowest):  # NaN is neither
            raise ValueError(f"{np.round(place, 3)} m is out of reach, or lower than {lowest} m")
    return [tool @ HAND for tool in tools]


def nearer(points: list[np.ndarray], here: np.ndarray) -> list[np.ndarray]:
    """Turns all poses by half a turn if the wrist, now at `here` [4, 4], then turns less."""
    alike = np.trace(points[0][:3, :3].T @ here[:3, :3])
    return [point @ HALF_TURN for point in points] if alike < 1.0 else points


def hold(hand: Any, opening: float, before: float, force: float) -> None:
    """Moves the fingers to an opening, m. Open ones that close keep pressing with `force` N."""
    if opening == 0.0 < before:
        hand.grasp(0.0, CLOSING, force, epsilon_inner=0.1, epsilon_outer=0.1)
    elif opening != before:
        hand.move(min(opening, hand.max_width), CLOSING)


def execute(franky: Any, arm: Any, hand: Any, decision: Any, args: argparse.Namespace) -> bool:
    """Goes through the waypoints; after contact straight up. Whether it came through."""

    def move(point: np.ndarray) -> None:
        arm.move(franky.CartesianMotion(franky.Affine(point)))

    points = set_points(decision, args.reach, args.lowest)
    points, before = nearer(points, arm.current_pose.end_effector_pose.matrix), -1.0
    for waypoint, point in zip(decision["waypoints"], points, strict=True):
        hold(hand, waypoint["opening"], before, args.grip)
        before = waypoint["opening"]
        try:
            move(point)
        except franky.ControlException:
            arm.recover_from_errors()
            above = arm.current_pose.end_effector_pose.matrix.copy()
            above[2, 3] = points[-1][2, 3]
            move(above)
            return False
    return True


def main(*arguments: str) -> None:
    """Prints the set-points; with --host goes through them."""
    parser = argparse.ArgumentParser(description="see the head of this file")
    parser.add_argument("decision", type=Path)
    parser.add_argument("--host")
    parser.add_argument("--sim", action="store_true", help="without a real-time kernel")
    limits = {"speed": 0.05, "force": 15.0, "grip": 20.0, "reach": 0.8, "lowest": 0.0}
    for name, default in limits.items():  # share of the arm's limits, N, N, m, m
        parser.add_argument(f"--{name}", type=float, default=default)
    args = parser.parse_args(arguments)
    if not all(math.isfinite(getattr(args, name)) for name in limits):
        parser.error("limits must be finite")
    decision = json.loads(args.decision.read_text())["decisions"][0]
    for point in set_points(decision, args.reach, args.lowest):
        print(" ".join(f"{value:+.4f}" for value in point[:3].ravel()))
    if args.host:
        franky = importlib.import_module("franky")
        real_time = franky.RealtimeConfig.Ignore if args.sim else franky.RealtimeConfig.Enforce
        options = {"default_force_threshold": args.force, "realtime_config": real_time}
        arm = franky.Robot(args.host, relative_dynamics_factor=args.speed, **options)
        done = execute(franky, arm, franky.Gripper(args.host), decision, args)
        print("done" if done else "stopped by contact")


if __name__ == "__main__":
    main(*sys.argv[1:])
