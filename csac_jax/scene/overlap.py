"""How deep two convex bodies overlap, exactly; on the host, for the few blocks of a file.

Contacts of C MuJoCo would give the same depth, but none at all for two meshes in one place.
"""

import numpy as np

_PARALLEL = 1e-6  # sine of the angle below which two directions count as one


def depth(corners: tuple[np.ndarray, np.ndarray], normals: tuple[np.ndarray, np.ndarray]) -> float:
    """Length in m of the shortest shift that parts two convex bodies; not above 0 where they are
    apart.

    Separating axis theorem: that shift runs along a face normal of either, or square to an edge of
    each.

    Args: corners [V, 3] m and face normals [F, 3] of both, in one frame; the numbers of corners and
    faces may differ.
    """
    axes = np.concatenate([*normals, _crosses(_edges(normals[0]), _edges(normals[1]))])
    one, two = (corner @ axes.T for corner in corners)  # [V, axes]
    shift = np.minimum(one.max(axis=0) - two.min(axis=0), two.max(axis=0) - one.min(axis=0))
    return float(shift.min())


def _edges(normals: np.ndarray) -> np.ndarray:
    """Directions [D, 3] of a body's edges: an edge is square to the normals of its two faces.

    Faces that do not meet add directions that no edge has; they cannot make the shortest shift
    shorter than it is.
    """
    crosses = _crosses(normals, normals)
    leading = np.take_along_axis(
        crosses, np.argmax(np.abs(crosses) > _PARALLEL, axis=1)[:, None], axis=1
    )
    return np.unique(
        np.round(crosses * np.sign(leading), 6), axis=0
    )  # a direction and its opposite are one


def _crosses(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """Unit vectors [D, 3] square to every pair of the directions [A, 3] and [B, 3] that are not
    parallel."""
    crosses = np.cross(one[:, None], two[None]).reshape(-1, 3)
    length = np.linalg.norm(crosses, axis=1)
    crossed = length > _PARALLEL
    return crosses[crossed] / length[crossed, None]
