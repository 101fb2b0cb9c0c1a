"""The faces of blocks against convex hulls of their corners."""

import xml.etree.ElementTree

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from csac_jax.config import SceneConfig, SimConfig
from csac_jax.scene import blocks, model

KINDS = [("box", half) for half in blocks.BOX_HALF_SIZES] + [
    (kind, blocks.half_size_choices(kind)[0]) for kind in ("prism", "cylinder")
]
IDS = ("cube", "cuboid", "plank", "tile", "prism", "cylinder")


def _corners(kind: str, half: np.ndarray) -> np.ndarray:
    """Corners [V, 3] m: of a box by its size, else as they stand in scenes/blocks.xml."""
    if kind == "box":
        return half * np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
    root = xml.etree.ElementTree.parse(model.assets() / "blocks.xml").getroot()
    vertex = root.find(f"asset/mesh[@name='{kind}']").get("vertex")
    return np.array(vertex.split(), float).reshape(-1, 3)


@pytest.mark.parametrize(("kind", "half"), KINDS, ids=IDS)
def test_half_spaces_are_those_of_the_hull(kind: str, half: np.ndarray):
    """Claim: a point lies inside a block where n . p <= offset for all its faces."""
    normals, offsets = map(np.asarray, blocks.half_spaces((kind,), jnp.asarray(half[None])))
    points = np.random.default_rng(0).uniform(-0.08, 0.08, (4000, 3))
    hull = ConvexHull(_corners(kind, half)).equations
    depth = (points @ normals[0].T - offsets[0]).max(axis=1)  # of the farthest face: < 0 inside
    np.testing.assert_allclose(depth, (points @ hull[:, :3].T + hull[:, 3]).max(axis=1), atol=2e-6)
    present = offsets[0] < blocks.PADDING_OFFSET
    np.testing.assert_allclose(np.linalg.norm(normals[0], axis=1), present, atol=1e-6)


@pytest.mark.parametrize(("kind", "half"), KINDS, ids=IDS)
def test_half_sizes_are_those_of_the_bounding_box(kind: str, half: np.ndarray):
    """Claim: the origin of a block is the centre of its bounding box, whose half sizes are in the table."""
    corners = _corners(kind, half)
    np.testing.assert_allclose(corners.max(axis=0), half, atol=1e-6)
    np.testing.assert_allclose(corners.min(axis=0), -half, atol=1e-6)


@pytest.mark.parametrize("kind", ["prism", "cylinder"])
def test_compiler_keeps_the_origin_of_a_mesh(kind: str):
    """Claim: a mesh block's pose in physics is that of its bounding box, although MuJoCo moves meshes to their mass."""
    compiled = model.build(SceneConfig(slots=(kind,), min_blocks=1), SimConfig()).model
    geom, mesh = compiled.geom("block0").id, compiled.mesh(f"blocks/{kind}").id
    start = compiled.mesh_vertadr[mesh]
    vertices = compiled.mesh_vert[start : start + compiled.mesh_vertnum[mesh]]
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, compiled.geom_quat[geom])
    in_body = vertices @ rotation.reshape(3, 3).T + compiled.geom_pos[geom]
    ours, theirs = (np.array(sorted(map(tuple, points.round(6) + 0.0))) for points in (_corners(kind, None), in_body))
    np.testing.assert_allclose(ours, theirs, atol=2e-6)
