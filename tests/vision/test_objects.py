"""Objects of many convex parts and blocks of every kind, seen by our rays and by C MuJoCo's."""

import functools

import jax
import numpy as np
import pytest

from csac_jax import geometry
from csac_jax.config import CameraConfig, Config
from csac_jax.vision import camera, observe
from csac_jax.vision.heightmap import VIEW_HEIGHT
from csac_jax.world import blocks, model, object_slots, scene_state
from csac_jax.world.scene_state import SceneState
from tests.sections import scaled
from tests.vision import mujoco_rays

SHAPES = tuple(shape.kind for shape in blocks.SHAPES.values())
KINDS = ("object", "object", *dict.fromkeys(SHAPES))
CONFIG = Config().change(
    scene={"slots": KINDS, "min_blocks": 1, "objects": "procedural:0:60", "split": "all"},
    sim={"physics": "c"},
    camera=scaled(CameraConfig(), 0.25),
)


@pytest.fixture(scope="module")
def world() -> model.World:
    with mujoco_rays.nominal_meshes():
        return model.build(CONFIG.scene, CONFIG.sim)


def scattered(rng: np.random.Generator) -> SceneState:
    """A scene with random objects and a block of each kind in random poses over the square."""
    num = len(KINDS)
    quaternion = rng.normal(size=(num, 4))
    scene = scene_state.parked(KINDS).replace(
        position=rng.uniform([-0.2, -0.2, 0.02], [0.2, 0.2, 0.15], (num, 3)).astype(np.float32),
        quaternion=np.float32(quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)),
        in_play=np.ones(num, bool),
        colour=rng.permutation(num).astype(np.int32),
    )
    return object_slots.drawn(rng, CONFIG.scene, scene)


from_above = jax.jit(functools.partial(observe.observe, CONFIG))


def compare(world: model.World, seeds: range) -> float:
    """Share of cells whose height is off by over 0.1 mm; the target's cells must be C's."""
    cells = np.asarray(geometry.cell_centres(CONFIG.heightmap), np.float64).reshape(-1, 2)
    origin = np.column_stack([cells, np.full(len(cells), VIEW_HEIGHT)])
    down = np.tile([0.0, 0.0, -1.0], (len(cells), 1))
    apart = []
    for seed in seeds:
        scene = scattered(np.random.default_rng(seed)).replace(target=np.int32(seed % len(KINDS)))
        obs = jax.device_get(from_above(scene))
        distance, geom, _ = mujoco_rays.cast(*mujoco_rays.placed(world, scene), origin, down)
        apart.append(np.abs(obs.height.ravel() - (VIEW_HEIGHT - distance)) > 1e-4)
        own = world.slot_of_geom[geom] == scene.target
        assert np.mean(own != obs.target.ravel()) < 1e-3
        assert (distance < VIEW_HEIGHT - 1e-3).mean() > 0.03
    return float(np.mean(apart))


@pytest.mark.parametrize("views", [12, pytest.param(1000, marks=pytest.mark.slow)])
def test_heights_of_objects_agree_with_mujoco(world: model.World, views: int):
    """Claim: heights of objects in random poses are C's to 0.1 mm off edges, targets too."""
    assert compare(world, range(views)) < 5e-5


def test_camera_at_the_side_agrees_with_mujoco(world: model.World):
    """Claim: the depths that a camera at the side sees of objects are C's; no window cuts one."""

    @jax.jit
    def depths(scene: SceneState) -> jax.Array:
        shapes = observe.scene_shapes(CONFIG.scene, scene)
        return observe.cast_pixels(CONFIG, camera.make(CONFIG.camera), shapes).distance

    rays = np.asarray(camera.directions(camera.make(CONFIG.camera)), np.float64).reshape(-1, 3)
    for seed in range(6):
        scene = scattered(np.random.default_rng(seed))
        distance = mujoco_rays.cast(
            *mujoco_rays.placed(world, scene), CONFIG.camera.position, rays
        ).distance
        apart = np.abs(np.asarray(depths(scene)).ravel() - distance) > 1e-4
        assert apart.mean() < 1e-4, seed
