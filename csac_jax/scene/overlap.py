"""How deep two convex bodies overlap, exactly; on the host, for the few blocks of a file.

Contacts of C MuJoCo would give the same depth, but none at all for two meshes in one place.
"""

import numpy as np

_PARALLEL = 1e-6  # sine of the angle below which two directions count as one


def depth(corners: tuple[np.ndarray, np.ndarray], normals: tuple[np.ndarray, np.ndarray]) -> float:
    """Length in m of the shortest shift that separates two convex bodies; <= 0 without overlap.

    Separating axis theorem: the shift runs along a face normal of either, or square to an edge of
    each.

    Args: corners [V, 3] m and face normals [F, 3] of both, in one frame; V and F may differ.
    """
    axes = np.concatenate([*normals, _crosses(_edges(normals[0]), _edges(normals[1]))])
    one, two = (corner @ axes.T for corner in corners)  # [V, axes]
    shift = np.minimum(one.max(axis=0) - two.min(axis=0), two.max(axis=0) - one.min(axis=0))
    return float(shift.min())


def _edges(normals: np.ndarray) -> np.ndarray:
    """Directions [D, 3] of a body's edges: an edge is square to the normals of its two faces.

    Faces that do not meet add directions that no edge has. They cannot make the shift shorter.
    """
    crosses = _crosses(normals, normals)
    first = np.argmax(np.abs(crosses) > _PARALLEL, axis=1)[:, None]
    sign = np.sign(np.take_along_axis(crosses, first, axis=1))  # opposite directions are one
    return np.unique(np.round(crosses * sign, 6), axis=0)


def _crosses(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """Unit vectors [D, 3] square to both directions, of all pairs that are not parallel."""
    crosses = np.cross(one[:, None], two[None]).reshape(-1, 3)
    length = np.linalg.norm(crosses, axis=1)
    crossed = length > _PARALLEL
    return crosses[crossed] / length[crossed, None]
