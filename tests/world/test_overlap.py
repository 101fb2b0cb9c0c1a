"""Depth of overlap of blocks against closed forms and against contacts of C MuJoCo."""

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from csac_jax.config import SceneConfig, SimConfig
from csac_jax.scenes import cases
from csac_jax.world import model, scene_state
from tests.world import placed


@pytest.mark.parametrize(
    "kinds", [("prism", "cylinder"), ("half_cylinder", "box"), ("prism", "prism"), ("box", "box")]
)
def test_depth_is_that_of_contacts(kinds: tuple):
    """Claim: for two blocks that overlap by up to 10 mm, the depth is that of the deepest contact
    of C MuJoCo."""
    world = model.build(SceneConfig(slots=kinds, min_blocks=1), SimConfig())
    exact, data = placed.in_c(world, scene_state.parked(kinds))
    rng, compared = np.random.default_rng(0), 0
    for turn in Rotation.random(200, rng=rng):
        data.qpos[world.block_qpos[0]] = [0.0, 0.0, 0.3, 1.0, 0.0, 0.0, 0.0]
        pose = [*rng.uniform(-0.05, 0.05, 2), 0.34, *turn.as_quat(scalar_first=True)]
        data.qpos[world.block_qpos[1]] = pose
        mujoco.mj_kinematics(exact, data)
        mujoco.mj_collision(exact, data)
        one, two = (placed.corners(exact, data, geom) for geom in world.block_geoms)
        depth = cases.overlap(one, two)
        deepest = -data.contact.dist.min() if data.ncon else 0.0
        assert (depth <= 1e-6) == (deepest == 0.0)
        if 0.0 < depth < 0.01:
            compared += 1
            assert deepest == pytest.approx(depth, abs=1e-4)  # theirs is iterative between meshes
    assert compared > 20
