"""The sensor's errors follow their laws, and cost nothing when there are none."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from csac_jax import presets
from csac_jax.config import CameraConfig, Config, HeightmapConfig, SensorConfig
from csac_jax.env import Env
from csac_jax.robot.primitives import Action
from csac_jax.sim import outcome
from csac_jax.vision import camera, heightmap, observe, sensor
from csac_jax.world import scene_state
from csac_jax.world.scene_state import SceneState
from tests.sections import scaled

ERRORS = SensorConfig(depth_noise=(0.001, 0.0014), dropped=0.1, colour=0.05)
JITTER = dataclasses.replace(ERRORS, pose_noise=(0.005, 0.01))
STEREO = SensorConfig(kind="d415", intrinsics_noise=(0.002, 0.002), light=0.1)
SMALL = HeightmapConfig(32)


@pytest.mark.parametrize("distance", [0.3, 1.0, 2.0])
def test_depth_errors_grow_with_the_square(distance):
    """Claim: depths err with sigma = floor + square d^2; the stated share is dropped."""
    true = jnp.full((200, 200), distance)
    measured, kept = sensor.depth(jax.random.key(0), ERRORS, true)
    sigma = 0.001 + 0.0014 * distance**2
    assert kstest((np.asarray(measured).ravel() - distance) / sigma, "norm").pvalue > 1e-3
    assert abs(float(jnp.mean(kept)) - 0.9) < 0.01


def _real(errors: SensorConfig) -> tuple[camera.Camera, camera.Camera]:
    """The believed camera, and 3,000 real ones."""
    eye, keys = camera.make(CameraConfig()), jax.random.split(jax.random.key(1), 3000)
    draw = jax.jit(jax.vmap(lambda key: sensor.pose(key, errors, eye)))
    return jax.device_get((eye, draw(keys)))


def test_the_camera_is_jittered():
    """Claim: place and rotation scatter with the stated standard deviations."""
    eye, real = _real(SensorConfig(pose_noise=(0.01, 0.02)))
    shift = real.position - eye.position
    np.testing.assert_allclose(shift.std(0), 0.01, rtol=0.06)
    np.testing.assert_allclose(shift.mean(0), 0.0, atol=0.001)
    turn = Rotation.from_matrix(real.rotation @ eye.rotation.T).as_rotvec()
    np.testing.assert_allclose(turn.std(0), 0.02, rtol=0.06)
    product = np.einsum("nij,nkj->nik", real.rotation, real.rotation)
    np.testing.assert_allclose(product, np.tile(np.eye(3), (3000, 1, 1)), atol=1e-5)


def test_colours_change_together():
    """Claim: one gain for each of red, green and blue in a view, and colours stay in 0 .. 1."""
    true = jnp.asarray(np.random.default_rng(0).uniform(0.2, 0.8, (8, 8, 3)), jnp.float32)
    gains = np.asarray(sensor.colour(jax.random.key(2), ERRORS, true)) / np.asarray(true)
    np.testing.assert_allclose(gains, np.broadcast_to(gains[0, 0], gains.shape), rtol=1e-5)
    assert len(np.unique(gains[0, 0].round(4))) == 3
    bright = sensor.colour(jax.random.key(2), SensorConfig(colour=0.5), 10.0 * true)
    assert np.asarray(bright).max() <= 1.0


def test_the_lens_is_another():
    """Claim: focal lengths and the axis scatter by the stated shares; nothing else changes."""
    eye, real = _real(SensorConfig(intrinsics_noise=(0.01, 0.02)))
    np.testing.assert_allclose((real.focal / eye.focal).std(0), 0.01, rtol=0.06)
    np.testing.assert_allclose(((real.centre - eye.centre) / eye.focal).std(0), 0.02, rtol=0.06)
    np.testing.assert_array_equal(real.rotation[7], eye.rotation)


def test_light_changes_in_every_view():
    """Claim: the light's direction, and the log of its brightness, scatter as stated."""
    errors = SensorConfig(light=0.1)
    keys, others = jax.random.split(jax.random.key(5), (2, 3000))
    towards = np.asarray(jax.jit(jax.vmap(lambda key: sensor.light(key, errors)))(keys))
    np.testing.assert_allclose(np.linalg.norm(towards, axis=1), 1.0, atol=1e-5)
    np.testing.assert_allclose(towards.mean(0), camera.LIGHT, atol=0.02)
    assert 0.05 < towards.std(0).max() < 0.11
    grey = jnp.full((1, 1, 3), 0.3)
    colour = jax.jit(jax.vmap(lambda key: sensor.colour(key, errors, grey)))
    gains = np.asarray(colour(others)) / 0.3
    np.testing.assert_allclose(np.log(gains[:, 0, 0, 0]).std(), 0.1, rtol=0.06)
    np.testing.assert_allclose(gains, np.broadcast_to(gains[..., :1], gains.shape), rtol=1e-5)


class Still:
    """Physics in which nothing moves."""

    def run(self, scene, joints):
        seen = outcome.nothing_seen(len(joints.control), len(scene.colour))
        return scene_state.park(scene, scene.in_play), outcome.trace_of(presets.smoke().sim, seen)


def _env(**changes) -> Env:
    cfg = dataclasses.replace(presets.smoke(), heightmap=SMALL, camera=scaled(CameraConfig(), 0.1))
    return Env(dataclasses.replace(cfg, **changes), Still(), _scenes(cfg))


def _look(env: Env, scene: SceneState) -> heightmap.Observation:
    return jax.jit(lambda scene: observe.observe(env.cfg, scene))(scene)


def _scenes(cfg: Config) -> SceneState:
    """A pool of one scene: a cube and a prism."""
    scene = scene_state.parked(cfg.scene.slots)
    position = np.array([[0.05, 0.0, 0.025], scene.position[1], [-0.08, 0.06, 0.0243]], np.float32)
    scene = scene.replace(position=position, in_play=np.array([True, False, True]))
    return jax.tree.map(lambda leaf: np.asarray(leaf)[None], scene)


OBLIQUE = HeightmapConfig(32, view="oblique")
_PUSH = Action(primitive=jnp.int32(0), pose=jnp.array([0.15, 0.15, 0.0]))


@pytest.mark.mjx  # steps, whose health check promotes ranks
@pytest.mark.parametrize(
    ("view", "errors"),
    [
        (SMALL, ERRORS),
        pytest.param(OBLIQUE, JITTER, marks=pytest.mark.slow),
        pytest.param(OBLIQUE, STEREO, marks=pytest.mark.slow),
    ],
)
def test_views_differ_from_step_to_step(view, errors):
    """Claim: every view has its own errors, another episode others; the same key, the same."""
    env = _env(heightmap=view, sensor=errors)
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    first, other, again = (reset(jax.random.key(seed)) for seed in (0, 1, 0))
    jax.tree.map(np.testing.assert_array_equal, first.obs, again.obs)
    second = step(first, _PUSH)
    third = step(second, _PUSH)
    states = (first, second, third, other)
    assert len({np.asarray(state.obs.height).tobytes() for state in states}) == 4
    jax.tree.map(np.testing.assert_array_equal, second.obs, step(again, _PUSH).obs)
    true = _look(env, first.scene)
    off = np.abs(np.asarray(first.obs.height) - np.asarray(true.height))
    assert 0.0 < np.mean(off) < 0.01


@pytest.mark.mjx
@pytest.mark.parametrize("view", [SMALL, pytest.param(OBLIQUE, marks=pytest.mark.slow)])
def test_colours_are_dropped_for_whole_episodes(view):
    """Claim: in the stated share of episodes every colour of every view is one grey; heights, and
    the colours of other episodes, are as they were."""
    env = _env(heightmap=view, sensor=SensorConfig(grey=0.3))
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(6), 300))
    later = jax.jit(jax.vmap(env.step, (0, None)))(states, _PUSH)
    true = jax.jit(jax.vmap(lambda scene: observe.observe(env.cfg, scene)))(states.scene)
    grey = [(np.asarray(each.obs.colour) == sensor.GREY).all((1, 2, 3)) for each in (states, later)]
    np.testing.assert_array_equal(*grey)
    assert 0.2 < grey[0].mean() < 0.4
    np.testing.assert_allclose(states.obs.height, true.height, atol=1e-6)
    np.testing.assert_array_equal(states.obs.colour[~grey[0]], true.colour[~grey[0]])
    every = jax.jit(_env(heightmap=view, sensor=SensorConfig(grey=1.0)).reset)(jax.random.key(0))
    assert (every.obs.colour == sensor.GREY).all()


@pytest.mark.mjx
def test_without_errors_there_is_no_randomness():
    """Claim: by default a state carries no key and the compiled view draws no random numbers; a
    reset with noise but without a key says so."""
    env = _env()
    state = jax.eval_shape(env.reset, jax.random.key(0))
    assert state.noise_key is None
    assert "random" not in str(jax.make_jaxpr(env.step)(state, _PUSH))
    noisy = _env(sensor=ERRORS)
    scene = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), noisy.scenes)
    assert "random" in str(jax.make_jaxpr(noisy.reset_to)(scene, jax.random.key(0)))
    with pytest.raises(ValueError, match=r"sensor.*key"):
        noisy.reset_to(scene)
