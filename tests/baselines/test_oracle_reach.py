"""The planner on an arm: what it does not reach, it does not choose."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax.baselines import oracle
from csac_jax.config import Config
from csac_jax.world import scene_state

pytestmark = pytest.mark.mjx  # flags are promoted in the planner's costs
FAR = Config().change(
    scene={"slots": ("box", "box"), "min_blocks": 2},
    sim={"robot": "ur5", "base": (0.87, 0.0, 0.35, 0.0), "physics": "c"},
)


@pytest.mark.slow
def test_the_planner_takes_what_the_arm_reaches():
    """Claim: of two blocks a far arm takes the near one, also after failures; the hand either."""
    place = np.array([[-0.15, 0.0, 0.025], [0.15, 0.0, 0.025]], np.float32)
    scene = scene_state.parked(FAR.scene.slots)
    half = np.full_like(scene.half_size, 0.025)
    here = np.ones(2, bool)
    scene = scene.replace(position=place, half_size=half, in_play=here)
    height = jnp.zeros((FAR.heightmap.size, FAR.heightmap.size))
    for cfg, sides in ((FAR, {1.0}), (FAR.change(sim={"robot": "hand"}), {-1.0, 1.0})):
        choose = jax.jit(functools.partial(oracle.grasp, cfg))
        poses = [choose(scene, height, jnp.int32(tries)).pose for tries in range(4)]
        assert {float(np.sign(pose[0])) for pose in poses} == sides
