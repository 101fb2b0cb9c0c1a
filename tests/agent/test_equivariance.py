"""A turned scene gives the turned maps and the turned best action, with fixed random networks."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from csac_jax.agent import actor_critic, maps, values
from csac_jax.agent.actor_critic import ActorCritic
from csac_jax.agent.maps import DenseMaps
from csac_jax.config import DenseNet121, HeightmapConfig, SmallNet
from csac_jax.vision.heightmap import Observation
from tests.sections import with_constants

K = 12  # no yaw of 45 degrees, where the nearest cell of a diagonal is a matter of rounding
QUARTER = K // 4
SIZE = 96
SMALL: Any = {"rotations": K, "growth": 8, "dilations": (1, 2), "stem": 8, "head": 8}
NETS = {
    "small": with_constants(SmallNet(**SMALL), pad_fraction=0.5),
    "fit": with_constants(SmallNet(**SMALL, fit=True), pad_fraction=0.5),
    "densenet121": with_constants(
        DenseNet121(rotations=K, head=8),
        pad_fraction=0.5,
        block_layers=(1, 1, 1, 1),
        block_growth=8,
    ),
}


class Fixed(NamedTuple):
    """A net with random weights."""

    learner: ActorCritic
    params: Any
    look: Callable[[Any, Observation], DenseMaps]


@pytest.fixture(scope="module", params=list(NETS))
def net(request, cfg) -> Fixed:
    """Either net, random in every parameter; nothing but `look` is compiled."""
    learner = actor_critic.make(
        cfg.change(net=NETS[request.param], heightmap=HeightmapConfig(size=SIZE))
    )
    rng = np.random.default_rng(0)
    with jax.numpy_dtype_promotion("standard"):
        abstract = jax.eval_shape(lambda: actor_critic.init(jax.random.key(0), learner)).online
    params = jax.tree.map(
        lambda leaf: jnp.asarray(rng.normal(scale=0.3, size=leaf.shape), leaf.dtype), abstract
    )
    return Fixed(
        learner, params, jax.jit(lambda params, obs: values.dense_maps(learner, params, obs))
    )


def _hills(seed: int, yaw: float) -> Observation:
    """Draws four smooth coloured hills near the centre, turned by `yaw`, leaves [1, ...]."""
    rng = np.random.default_rng(seed)
    along = ((np.arange(SIZE) + 0.5) / SIZE - 0.5) * 0.448
    x, y = _rotated(along[None, :], along[:, None], yaw)  # where it was before
    height, colour = np.zeros((SIZE, SIZE)), np.full((SIZE, SIZE, 3), 0.5)
    for _ in range(4):
        distance, angle, turn = rng.uniform(0.0, 0.12), *rng.uniform(0.0, 2.0 * np.pi, 2)
        a, b = _rotated(x - distance * np.cos(angle), y - distance * np.sin(angle), turn)
        hill = np.exp(-0.5 * ((a / 0.05) ** 2 + (b / 0.03) ** 2))
        height, colour = height + 0.05 * hill, colour + rng.uniform(-0.4, 0.4, 3) * hill[..., None]
    leaves = (jnp.asarray(leaf[None], jnp.float32) for leaf in (colour, height))
    return Observation(*leaves, target=jnp.ones((1, SIZE, SIZE), bool))


def _rotated(x, y, yaw: float) -> tuple:
    """Coordinates in axes that are turned by `yaw`."""
    return np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x


def _quarter(obs: Observation) -> Observation:
    """The scene turned by a quarter turn, counterclockwise: rows are y, columns x."""
    return jax.tree.map(lambda leaf: jnp.swapaxes(leaf[:, ::-1], 1, 2), obs)


def _kept(steps: int) -> list[int]:
    """Yaws whose pass is still the picture of one pass, not of one upside down, `steps` yaws on."""
    return [k for k in range(K) if k % (K // 2) < K // 2 - steps]


def _best(fixed: Fixed, seen: DenseMaps, yaws: np.ndarray) -> tuple[int, np.ndarray]:
    """Primitive and pose of the highest valid cell of one state among `yaws`."""
    valid = np.array(seen.valid[0]) & np.isin(np.arange(K), yaws)[None, :, None, None]
    cell = int(np.argmax(np.where(valid, seen.q[0], -np.inf)))
    primitive, cell = divmod(cell, valid[0].size)
    return primitive, np.asarray(maps.cell_pose(fixed.learner.frames, jnp.int32(cell)))


def _turned(pose: np.ndarray, yaw: float) -> np.ndarray:
    return np.array([*_rotated(*pose[:2], -yaw), np.mod(pose[2] + yaw, 2.0 * np.pi)])


def _value(fixed: Fixed, seen: DenseMaps, primitive: int, pose: np.ndarray) -> float:
    at = jnp.int32(primitive), jnp.asarray(pose, jnp.float32)
    return float(maps.read(fixed.learner.frames, seen.q[0], *at))


@pytest.mark.parametrize("seed", range(2))
def test_quarter_turn(net, seed):
    """Claim: of a scene turned by a quarter turn each net's maps are the same, a quarter turn on,
    and its best action is the turned one, among yaws whose pass does not turn upside down with
    it."""
    first = np.array(_kept(QUARTER))
    then, obs = first + QUARTER, _hills(seed, 0.0)
    before, after = net.look(net.params, obs), net.look(net.params, _quarter(obs))
    assert_allclose(after.q[:, :, then], before.q[:, :, first], atol=1e-5)
    assert_array_equal(after.valid[:, :, then], before.valid[:, :, first])
    assert_allclose(after.logits[:, :, then], before.logits[:, :, first], atol=1e-3)
    assert np.std(before.q) > 0.01
    (primitive, pose), (other, turned) = _best(net, before, first), _best(net, after, then)
    assert primitive == other
    assert_allclose(turned, _turned(pose, 0.5 * np.pi), atol=1e-5)


@pytest.mark.parametrize("seed", range(2))
def test_one_yaw_step(net, seed):
    """Claim: of a smooth scene turned by one yaw step, 30 degrees here, maps change by a twentieth
    of their spread at most, those of DenseNet by a quarter, for cells are the nearest ones; and the
    turned best action is worth the best one within as much."""
    if net.learner.cfg.net.fit:
        pytest.skip("what a hand fits about ends at an edge: those maps are not smooth")
    first = np.array(_kept(1))
    before, after = (net.look(net.params, _hills(seed, yaw)) for yaw in (0.0, 2.0 * np.pi / K))
    change = np.asarray(after.q[:, :, first + 1] - before.q[:, :, first])
    bound = np.std(before.q) * (0.05 if net.learner.cfg.net.kind == "small" else 0.25)
    assert np.std(change) < bound
    (primitive, pose), (other, best) = _best(net, before, first), _best(net, after, first + 1)
    worth = _value(net, after, primitive, _turned(pose, 2.0 * np.pi / K))
    assert worth > _value(net, after, other, best) - bound
