"""The faces of blocks against convex hulls of their corners."""

import xml.etree.ElementTree

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from csac_jax.world import blocks, model

CONVEX = [name for name in blocks.SHAPES if name != "arch"]


def _half(shape: str) -> np.ndarray:
    return np.float32(blocks.SHAPES[shape].half_size)


def _corners(kind: str, half: np.ndarray) -> np.ndarray:
    """Returns corners [V, 3] m: of a box by its size, else those in scenes/blocks.xml."""
    if kind == "box":
        return half * np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
    root = xml.etree.ElementTree.parse(model.assets() / "blocks.xml").getroot()
    vertex = root.find(f"asset/mesh[@name='{kind}']").get("vertex")
    return np.array(vertex.split(), float).reshape(-1, 3)


@pytest.mark.parametrize("scale", [1.0, 0.9])
@pytest.mark.parametrize("shape", CONVEX)
def test_half_spaces_are_those_of_the_hull(shape: str, scale: float):
    """Claim: a point lies inside a block where n . p <= offset for all its faces, whatever its
    size. The origin is the centre of the bounding box, whose half sizes are in the table."""
    kind, half = blocks.SHAPES[shape].kind, np.float32(scale) * _half(shape)
    normals, offsets = map(np.asarray, blocks.half_spaces((kind,), jnp.asarray(half[None])))
    points = np.random.default_rng(0).uniform(-0.08, 0.08, (4000, 3))
    corners = _corners(kind, half) * (1.0 if kind == "box" else scale)
    np.testing.assert_allclose([corners.max(axis=0), -corners.min(axis=0)], [half] * 2, atol=1e-6)
    hull = ConvexHull(corners).equations
    depth = (points @ normals[0].T - offsets[0]).max(axis=1)  # of the farthest face: < 0 inside
    np.testing.assert_allclose(depth, (points @ hull[:, :3].T + hull[:, 3]).max(axis=1), atol=2e-6)
    present = offsets[0] < blocks.PADDING_OFFSET
    np.testing.assert_allclose(np.linalg.norm(normals[0], axis=1), present, atol=1e-6)
