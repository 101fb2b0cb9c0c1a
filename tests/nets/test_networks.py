"""Networks by config, and configs that are refused."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from csac_jax import presets
from csac_jax.agent import maps
from csac_jax.config import Config, DenseNet121, SmallNet
from csac_jax.nets import dense, densenet, networks
from tests.sections import with_constants

TINY = {
    "small": with_constants(SmallNet(rotations=4), pad_fraction=0.5),
    "densenet121": with_constants(
        DenseNet121(rotations=4, head=8),
        pad_fraction=0.5,
        block_layers=(1, 1, 1, 1),
        block_growth=4,
    ),
}


def _config(size: int = 224, **net: Any) -> Config:
    return presets.smoke().change(heightmap={"size": size}, net={"kind": "densenet121", **net})


@pytest.mark.parametrize("kind", ["small", "densenet121"])
def test_strides_divide_rotated_maps(kind: str):
    """Claim: rotated maps of any height map are about 1/8, or sqrt(2) - 1, larger, by whole cells
    of the features at any stride. The paper's are 320 cells, for 224."""
    assert (DenseNet121().canvas(224), SmallNet().canvas(64)) == (320, 72)
    for size in range(16, 225, 8):
        cfg = _config(size, kind=kind)
        frames = maps.frames(cfg, networks.make(cfg.net))
        assert frames.tables.canvas % cfg.net.canvas_step == 0
        exact = size * (1.125 if cfg.net.kind == "small" else 2.0**0.5)
        assert abs(frames.tables.canvas - exact) <= 0.5 * cfg.net.canvas_step + 0.02 * size


@pytest.mark.parametrize("colour", [True, False])
@pytest.mark.parametrize("target", [True, False])
@pytest.mark.parametrize("kind", ["small", "densenet121"])
def test_maps_have_the_size_that_frames_say(kind: str, target: bool, colour: bool):
    """Claim: critic and head give maps of the size that the frames say."""
    cfg = presets.smoke().change(
        heightmap={"size": 64},
        net=dataclasses.replace(TINY[kind], colour=colour),
        task={"kind": "target" if target else "clear"},
    )
    nets = networks.make(cfg.net)
    frames = maps.frames(cfg, nets)
    mask = jax.ShapeDtypeStruct((1, 96, 96), bool) if frames.shows_target else None
    inputs = jax.eval_shape(nets.inputs, jnp.zeros((1, 96, 96, 3)), jnp.zeros((1, 96, 96)), mask)
    assert inputs.shape == (1, 96, 96, 3 * colour + 1 + target)
    critic, head = nets.critic, nets.head
    (q, features), _ = jax.eval_shape(critic.init_with_output, jax.random.key(0), inputs)
    actor, _ = jax.eval_shape(head.init_with_output, jax.random.key(0), features)
    assert q.shape == actor.shape == (1, frames.side, frames.side, dense.OUTPUTS)
    assert frames.side * nets.stride == frames.tables.canvas == 96
    assert isinstance(critic, densenet.DenseNetCritic if kind == "densenet121" else dense.Critic)


def test_mirrored_maps_are_the_mean_of_four_looks():
    """Claim: of a scene in a mirror along or across the frame, the mirrored Q is the mirror of the
    scene's Q, pushes ahead and back swapped along it; and it is the mean of four looks."""
    nets = networks.make(TINY["small"])
    passes = jax.random.normal(jax.random.key(0), (2, 3, 24, 24, 4))
    variables = jax.eval_shape(nets.critic.init, jax.random.key(1), passes[0])
    noise = np.random.default_rng(2)
    variables = jax.tree.map(
        lambda leaf: jnp.asarray(0.3 * noise.normal(size=leaf.shape), jnp.float32), variables
    )
    look = jax.jit(functools.partial(networks.apply, nets, variables))
    mirrored = jax.jit(functools.partial(networks.apply_mirrored, nets, variables))
    q, features = mirrored(passes)
    plain, expected = look(passes)
    assert_allclose(features, expected, atol=1e-5)

    def along(q: Any) -> np.ndarray:
        return np.asarray(q)[:, :, :, ::-1][..., [1, 0, 2]]

    def across(q: Any) -> np.ndarray:
        return np.asarray(q)[:, :, ::-1]

    assert_allclose(mirrored(passes[:, :, :, ::-1])[0], along(q), atol=1e-5)
    assert_allclose(mirrored(passes[:, :, ::-1])[0], across(q), atol=1e-5)
    looks = [
        plain,
        across(look(passes[:, :, ::-1])[0]),
        along(look(passes[:, :, :, ::-1])[0]),
        across(along(look(passes[:, :, ::-1, ::-1])[0])),
    ]
    assert_allclose(q, np.mean(looks, axis=0), atol=1e-5)
    assert np.abs(np.asarray(q - plain)).max() > 0.1
