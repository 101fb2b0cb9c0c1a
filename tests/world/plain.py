"""Plain geometry of arrangements, for tests: open grasps, and distances between arrangements."""

import itertools

import numpy as np

from csac_jax import grippers
from csac_jax.baselines.oracle import OPENING_ROOM, YAWS
from csac_jax.config import SimConfig
from csac_jax.grippers import Gripper

PARALLEL = 0.1  # rad, of a closing direction to the normals of two faces


def open_grasps(
    position: np.ndarray, yaw: np.ndarray, half: np.ndarray, sim: SimConfig
) -> np.ndarray:
    """Tests if an antipodal grasp of each block at each of the oracle's yaws is open [n, YAWS].

    Open: two faces across, no wider than the hand, no other block where fingers go down or close.
    Args: centres [n, 3] m, yaws [n] rad and half extents [n, 3] m, as the blocks lie. Blocks are
    their bounding boxes. A closing finger is a grid of points at the height of the grasp.
    """
    top = position[:, 2] + half[:, 2]
    gripper = grippers.load(sim.gripper)
    tip = np.maximum(top - sim.grasp_depth, gripper.clearance) + 0.002
    widest = gripper.opening[1] - OPENING_ROOM
    is_open, angle = np.zeros((len(half), YAWS), bool), np.arange(YAWS) * np.pi / YAWS
    for i in range(len(half)):
        off = (angle - yaw[i] + 0.25 * np.pi) % (0.5 * np.pi) - 0.25 * np.pi
        across = np.round((angle - yaw[i] - off) / (0.5 * np.pi)).astype(int) % 2  # x or y
        face = half[i, across]
        fits = np.flatnonzero((np.abs(off) <= PARALLEL) & (2.0 * face <= widest))
        fingers = [position[i, :2] + _fingers(gripper, face[j]) @ _turn(angle[j]).T for j in fits]
        points = np.reshape(fingers, (-1, 120, 2))
        blocked = np.zeros(len(fits), bool)
        for k in np.flatnonzero((top > tip[i]) & (np.arange(len(half)) != i)):
            inside = np.abs((points - position[k, :2]) @ _turn(yaw[k])) < half[k, :2]
            blocked |= inside.all(axis=2).any(axis=1)
        is_open[i, fits] = ~blocked
    return is_open


def _fingers(gripper: Gripper, face: float) -> np.ndarray:
    """Returns points [120, 2] m of fingers that close along x on faces at +-`face` m."""
    thickness, width = gripper.footprint
    outside = gripper.half[1] + 0.5 * gripper.finger[0] + thickness
    along = np.linspace(face + 0.0005, outside, 12)
    x, y = np.meshgrid([*-along, *along], np.linspace(-1.0, 1.0, 5) * width)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _turn(angle: float) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin], [sin, cos]])


def distance(one: np.ndarray, others: np.ndarray) -> float:
    """Computes the RMS distance, m, of centres `one` [n, 3] from as many of `others` [m, 3].

    Best one-to-one match, shift and rotation about z, mirrored or not; inf if m < n.
    """
    n = len(one)
    orders = np.array(list(itertools.permutations(range(len(others)), n)), int).reshape(-1, n)
    if not len(orders):
        return np.inf
    a, b = one - one.mean(axis=0), others[orders]
    a, b = np.broadcast_to(a, b.shape).copy(), b - b.mean(axis=1, keepdims=True)
    best = np.inf
    for mirror in (1.0, -1.0):
        p = a[..., 0] + 1j * mirror * a[..., 1]
        q = b[..., 0] + 1j * b[..., 1]
        flat = np.sum(abs(p) ** 2 + abs(q) ** 2, axis=1) - 2.0 * abs(np.sum(p.conj() * q, axis=1))
        high = np.sum((a[..., 2] - b[..., 2]) ** 2, axis=1)
        best = min(best, np.sqrt(np.min(np.maximum(flat, 0.0) + high) / n))
    return float(best)
