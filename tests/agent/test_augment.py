"""Augmentation of transitions."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation
from scipy.stats import chisquare

from csac_jax import presets
from csac_jax.agent import augment
from csac_jax.agent.learner import Transition
from csac_jax.constants import Primitive
from csac_jax.robot.primitives import Action
from csac_jax.vision import heightmap, observe
from csac_jax.world import blocks, scene_state
from csac_jax.world.scene_state import SceneState

FLAGS = list(itertools.product((False, True), repeat=3))
CFG = presets.smoke()  # four yaws: turning to the nearest cell is exact
CELL = CFG.heightmap.cell
ROTATION = Rotation.from_euler("zyx", [[0.4, 0.3, 0.0], [1.1, -0.2, 0.35], [2.0, 0.0, 0.0]])
POSITION = np.array([[0.06, 0.05, 0.05], [-0.12, 0.02, 0.04], [0.03, -0.14, 0.0243]])
POSE = np.array([0.071, -0.033, 0.6])

apply_symmetry = jax.jit(augment.apply_symmetry)
look = jax.jit(lambda scene: heightmap.pack(observe.observe(CFG, scene)))
shift = jax.jit(lambda transition, cells: augment.shift(CFG, transition, jnp.array(cells)))


def _matrix(flags: tuple[bool, bool, bool]) -> np.ndarray:
    """The symmetry as a matrix [3, 3] on points of the workspace."""
    mirror_x, mirror_y, swap = flags
    matrix = np.diag([-1.0 if mirror_x else 1.0, -1.0 if mirror_y else 1.0, 1.0])
    return matrix[[1, 0, 2]] if swap else matrix


def _turn(flags, transition: Transition) -> Transition:
    return apply_symmetry(transition, *(jnp.array(flag) for flag in flags))


def _scene(rotation: Rotation, position: np.ndarray, matrix: np.ndarray = np.eye(3)) -> SceneState:  # noqa: B008
    """Three blocks in a workspace turned or mirrored by `matrix`: each is its own mirror image in
    its x."""
    body = np.diag([np.linalg.det(matrix), 1.0, 1.0])
    turned = Rotation.from_matrix(matrix @ rotation.as_matrix() @ body)
    half_size = np.stack([blocks.SHAPES[name].half_size for name in ("cuboid", "plank", "prism")])
    return jax.tree.map(jnp.asarray, scene_state.parked(CFG.scene.slots)).replace(
        position=jnp.asarray(position @ matrix.T, jnp.float32),
        quaternion=jnp.asarray(turned.as_quat(scalar_first=True), jnp.float32),
        half_size=jnp.asarray(half_size, jnp.float32),
        colour=jnp.array([1, 4, 7], jnp.int32),
        in_play=jnp.ones(len(CFG.scene.slots), bool),
    )


def _action(primitive: int = 0, pose: np.ndarray = POSE) -> Action:
    return Action(primitive=jnp.int32(primitive), pose=jnp.asarray(pose, jnp.float32))


def _transition(scene: SceneState) -> Transition:
    obs = look(scene)
    return Transition(obs, _action(), jnp.float32(0.5), obs, jnp.array(True))


@pytest.fixture(scope="module")
def transition() -> Transition:
    """A transition of a scene without any symmetry."""
    return _transition(_scene(ROTATION, POSITION))


def _off(a, b, name: str) -> float:
    """Share of cells whose heights, or any of whose colours, differ by more than 1."""
    off = np.abs(np.asarray(getattr(a, name), int) - np.asarray(getattr(b, name), int)) > 1
    return off.reshape(*off.shape[:2], -1).any(axis=-1).mean()


@pytest.mark.parametrize("flags", FLAGS)
def test_view_is_that_of_the_mirrored_scene(transition, flags):
    """Claim: the camera sees the mirrored, turned scene as the map turned over, to a tenth of a
    millimetre; place and direction of the action are those of the turned workspace.

    Heights everywhere, colours of the table: the light does not turn, so that sloping faces differ
    in brightness.
    """
    view = look(_scene(ROTATION, POSITION, _matrix(flags)))
    turned = _turn(flags, transition)
    for obs in (turned.obs, turned.next_obs):
        assert _off(view, obs, "height") < 0.003  # a ray along an edge
        bare = (np.asarray(view.height) == 0) & (np.asarray(obs.height) == 0)
        assert_array_equal(np.asarray(view.colour)[bare], np.asarray(obs.colour)[bare])
        assert_array_equal(view.target, obs.target)
    assert np.mean(np.asarray(view.height) > 100) > 0.05
    matrix, (x, y, yaw) = _matrix(flags)[:2, :2], np.asarray(turned.action.pose)
    assert_allclose([x, y], matrix @ POSE[:2], atol=1e-7)
    direction = matrix @ [np.cos(POSE[2]), np.sin(POSE[2])]
    assert_allclose([np.cos(yaw), np.sin(yaw)], direction, atol=1e-6)
    assert 0.0 <= yaw < 2.0 * np.pi
    assert (turned.action.primitive, turned.reward, turned.terminated) == (0, 0.5, True)


def _signature(transition: Transition) -> tuple:
    return np.asarray(transition.obs.height).tobytes(), np.asarray(transition.obs.colour).tobytes()


def test_symmetries_are_drawn_alike(transition):
    """Claim: each symmetry is equally likely (chi-square)."""
    small = jax.tree.map(lambda leaf: leaf[:2, :2] if leaf.ndim > 1 else leaf, transition)
    small = small.replace(obs=small.obs.replace(height=jnp.array([[1, 2], [3, 4]], jnp.uint16)))
    keys = jax.random.split(jax.random.key(0), 4000)
    drawn = jax.jit(jax.vmap(lambda key: augment.augment(key, CFG, small).obs.height))(keys)
    _, counts = np.unique(np.asarray(drawn).reshape(-1, 4), axis=0, return_counts=True)
    assert counts.size == 8
    assert chisquare(counts).pvalue > 1e-4


@pytest.mark.parametrize("cells", [(0, 0), (2, 1), (-1, 3)])
def test_shift_is_the_view_of_the_shifted_scene(transition, cells):
    """Claim: a shift by whole cells gives height, colour and target mask of the shifted scene,
    table that comes in included, and moves the action as far; another shift takes it back, cell by
    cell."""
    moved, step = shift(transition, cells), np.array([cells[1] * CELL, cells[0] * CELL, 0.0])
    view = look(_scene(ROTATION, POSITION + step))
    for obs in (moved.obs, moved.next_obs):
        assert _off(view, obs, "height") < 0.005  # a ray along an edge
        assert _off(view, obs, "colour") < 0.005
        assert_array_equal(view.target, obs.target)
    assert_allclose(moved.action.pose, POSE + step, atol=1e-6)
    assert _signature(shift(moved, (-cells[0], -cells[1]))) == _signature(transition)


def test_what_would_be_cut_off_stays(transition):
    """Claim: a shift that would cut off a block, a place or a push leaves all as it was."""
    grasp, push, nothing = Primitive.GRASP, Primitive.PUSH, jnp.zeros((32, 32), jnp.uint16)
    bare = transition.replace(
        obs=transition.obs.replace(height=nothing),
        next_obs=transition.next_obs.replace(height=nothing),
    )
    cases = (
        (transition, (-6, 0), _action(grasp), False),  # a block out
        (bare, (-6, 0), _action(grasp), True),
        (bare.replace(next_obs=transition.next_obs), (-6, 0), _action(grasp), False),
        (bare, (0, 12), _action(grasp), False),  # the place out
        (bare, (0, 6), _action(grasp), True),
        (bare, (0, 6), _action(push), False),  # the end of the push out
        (bare, (0, -6), _action(push, np.array([0.2, 0.0, 0.0])), False),  # cut off before
    )
    for before, cells, action, goes in cases:
        after = shift(before.replace(action=action), cells)
        assert (not np.array_equal(after.action.pose, action.pose)) == goes
        assert goes or _signature(after) == _signature(before)


def test_augment_is_what_the_config_says(transition):
    """Claim: shifts stay in their bounds and reach them; with everything off it changes nothing."""
    off = CFG.change(learn={"augment": False})
    same = jax.jit(augment.augment, static_argnums=1)(jax.random.key(0), off, transition)
    jax.tree.map(assert_array_equal, same, transition)
    wide = off.change(learn={"augment_shift": 2})
    keys = jax.random.split(jax.random.key(1), 300)
    poses = jax.jit(jax.vmap(lambda key: augment.augment(key, wide, transition).action.pose))(keys)
    shifts = (np.asarray(poses) - POSE)[:, :2] / CELL
    assert_allclose(shifts, shifts.round(), atol=1e-4)
    assert len(np.unique(shifts.round(), axis=0)) == 25
