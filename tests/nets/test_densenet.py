"""DenseNet-121 against Keras 3 with the same weights, and its parts."""

import os
from collections.abc import Callable, Iterator
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

os.environ.setdefault("KERAS_BACKEND", "jax")

from csac_jax.config import DenseNet121
from csac_jax.nets import densenet, networks
from tests.sections import with_constants

TINY = with_constants(DenseNet121(head=8), block_layers=(1, 1, 1, 1), block_growth=4, upsample=1)
KERAS = {"norm1": "0_bn", "conv1": "1_conv", "norm2": "1_bn", "conv2": "2_conv"}


def random_variables(module: nn.Module, seed: int, *shapes: tuple[int, ...]) -> Any:
    """Variables that are all random, with activations of about 1; nothing is compiled."""
    rng = np.random.default_rng(seed)
    blanks = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]

    def draw(path: Any, leaf: jax.ShapeDtypeStruct) -> jax.Array:
        kind = path[-1].key
        if kind == "kernel":
            values = rng.normal(scale=np.sqrt(2.0 / np.prod(leaf.shape[:-1])), size=leaf.shape)
        elif kind in ("scale", "var"):
            values = rng.uniform(0.5, 1.5, leaf.shape)
        else:
            values = rng.normal(scale=0.2, size=leaf.shape)
        return jnp.asarray(values, leaf.dtype)

    return jax.tree_util.tree_map_with_path(
        draw, jax.eval_shape(module.init, jax.random.key(0), *blanks)
    )


def _keras_name(modules: tuple[str, ...]) -> str:
    """Keras's name of the layer that a module's output is compared with."""
    if modules[0] in ("conv0", "norm0", "norm5"):
        return {"conv0": "conv1_conv", "norm0": "conv1_bn", "norm5": "bn"}[modules[0]]
    stage = int(modules[0][-1]) + 1
    if modules[0].startswith("transition"):
        return f"pool{stage}_" + {"norm": "bn", "conv": "conv"}.get(modules[-1], "pool")
    return f"conv{stage}_block{modules[1].removeprefix('denselayer')}_{KERAS[modules[2]]}"


def _outputs(tree: Any, modules: tuple[str, ...] = ()) -> Iterator[tuple[str, jax.Array]]:
    """Keras's name and output of every captured module but dense layers, which give what their last
    convolution gives, whole blocks and the trunk."""
    for name, entry in tree.items():
        if name != "__call__":
            yield from _outputs(entry, (*modules, name))
        elif modules and not modules[-1].startswith("dense"):
            is_piece = modules[-1].startswith("transition")
            yield _keras_name(modules), entry[0].maps if is_piece else entry[0]


def _weights(
    variables: Any, modules: tuple[str, ...] = ()
) -> Iterator[tuple[str, list[np.ndarray]]]:
    """Keras's name and weights of every layer that has some."""
    params, statistics = variables
    for name, entry in params.items():
        own, keras_name = statistics.get(name, {}), (*modules, name)
        if "kernel" in entry:
            yield _keras_name(keras_name), [np.asarray(entry["kernel"])]
        elif "scale" in entry:
            leaves = entry["scale"], entry["bias"], own["mean"], own["var"]
            yield _keras_name(keras_name), [np.asarray(leaf) for leaf in leaves]
        else:
            yield from _weights((entry, own), keras_name)


def _compare(block_layers: tuple[int, int, int, int], size: int) -> int:
    """Compares every module with Keras's in both modes of batch norm; returns their number."""
    cfg = with_constants(DenseNet121(norm="batch"), block_layers=block_layers, upsample=1)
    trunk = densenet.DenseNetTrunk(cfg)
    variables = random_variables(trunk, 0, (1, size, size, 3))
    maps = jnp.asarray(np.random.default_rng(1).normal(size=(4, size, size, 3)), jnp.float32)

    with (
        jax.numpy_rank_promotion("allow"),
        jax.numpy_dtype_promotion("standard"),
        jax.debug_key_reuse(False),
    ):
        call, names = _keras(block_layers, size, variables)
        theirs = {train: jax.tree.map(np.asarray, call(maps, train)) for train in (False, True)}

    def ours(variables: Any, maps: jax.Array, train: bool) -> Any:
        kinds = ["intermediates", "batch_stats"]
        return trunk.apply(variables, maps, train, capture_intermediates=True, mutable=kinds)[1]

    for train, (outputs, statistics) in theirs.items():
        state = jax.jit(ours, static_argnums=2)(variables, maps, train)
        got = dict(_outputs(state["intermediates"]))
        assert got.keys() == set(names)
        for name, wanted in zip(names, outputs, strict=True):
            error = np.abs(got[name] - wanted).max() / np.abs(wanted).max()
            assert error <= 1e-4, (name, train, error)
        after = dict(_weights((variables["params"], state["batch_stats"])))
        for name, (_, _, *wanted) in statistics.items():
            for mine, other in zip(after[name][2:], wanted, strict=True):
                assert_allclose(mine, other, rtol=1e-4, atol=1e-4, err_msg=name)
    return len(names)


def _keras(block_layers: tuple[int, ...], size: int, variables: Any) -> tuple[Callable, list[str]]:
    """Builds Keras's net with our weights: (maps, train) -> outputs, statistics; names."""
    import keras
    from keras.src.applications.densenet import DenseNet

    net = DenseNet(list(block_layers), include_top=False, weights=None, input_shape=(size, size, 3))
    norms = []
    for name, weights in _weights((variables["params"], variables["batch_stats"])):
        layer = net.get_layer(name)
        layer.set_weights(weights)
        if len(weights) == 4:
            # torchvision's in place of Keras's 0.99 and 1.001e-5
            layer.momentum, layer.epsilon = 0.9, 1e-5
            norms.append(name)
    kinds = ("_conv", "_bn", "_pool", "bn")
    wanted = [layer.name for layer in net.layers if layer.name.endswith(kinds)]
    whole = keras.Model(net.inputs, [net.get_layer(name).output for name in wanted])
    groups = whole.trainable_variables, whole.non_trainable_variables
    trained, other = ([v.value for v in group] for group in groups)

    def run(trained: Any, other: Any, maps: jax.Array, train: bool) -> Any:
        return whole.stateless_call(trained, other, maps, training=train)

    compiled = jax.jit(run, static_argnums=3)

    def call(maps: jax.Array, train: bool) -> Any:
        outputs, after = compiled(trained, other, maps, train)
        paths = [variable.path for variable in whole.non_trainable_variables]
        by_path = dict(zip(paths, after, strict=True))
        statistics = {
            name: [by_path.get(v.path, v.value) for v in net.get_layer(name).variables]
            for name in norms
        }
        return outputs, statistics

    return call, wanted


@pytest.mark.slow
def test_every_stage_of_densenet_121_is_kerass():
    """Claim: with weights ported, every convolution, norm and transition is Keras's within 1e-4 of
    the largest value, batch norm both with running statistics and with the batch's."""
    assert _compare((6, 12, 24, 16), 64) == 2 + 58 * 4 + 3 * 3 + 1


def test_a_zoomed_trunk_doubles_its_cells():
    """Claim: with a upsample a trunk says of maps what one without says of pixels repeated."""
    nets = (densenet.DenseNetTrunk(with_constants(TINY, upsample=upsample)) for upsample in (1, 2))
    whole, doubling = (jax.jit(net.apply) for net in nets)
    maps = jnp.asarray(np.random.default_rng(5).normal(size=(2, 32, 48, 3)), jnp.float32)
    variables = random_variables(densenet.DenseNetTrunk(TINY), 0, (1, 64, 64, 3))
    got = doubling(variables, maps)
    assert got.shape == (2, 2, 3, 8)
    repeated = jnp.repeat(jnp.repeat(maps, 2, axis=1), 2, axis=2)
    # Rounding, which norms of random scales amplify.
    assert_allclose(got, whole(variables, repeated), atol=1e-4)


def test_inputs():
    """Claim: bare table is 0; on blocks colours are normalised as ImageNet's and 3 cm of height are
    1; without colour only the height is left."""
    height, colour = jnp.array([[0.0, 0.03]]), jnp.full((1, 2, 3), 0.5)
    sees, blind = (networks.make(DenseNet121(colour=colour)) for colour in (True, False))
    net_input = np.asarray(sees.inputs(colour, height, jnp.array([[True, False]])))
    assert_array_equal(net_input[0, 0], [0.0, 0.0, 0.0, 0.0, 1.0])
    assert_allclose(
        net_input[0, 1], [0.015 / 0.229, 0.044 / 0.224, 0.094 / 0.225, 1.0, 0.0], rtol=1e-4
    )
    assert_allclose(blind.inputs(colour, height, None), [[[0.0], [1.0]]], rtol=1e-6)


def test_trunks_have_weights_of_their_own():
    """Claim: each trunk has its own weights, and features are joined colour first, height second:
    changing what one trunk sees, or one trunk's weights, changes its share of the features only."""
    critic = densenet.DenseNetCritic(TINY)
    maps = jnp.asarray(np.random.default_rng(2).normal(size=(1, 64, 64, 4)), jnp.float32)
    variables = random_variables(critic, 0, maps.shape)
    features = jax.jit(lambda variables, maps: critic.apply(variables, maps)[1])
    before, half = features(variables, maps), 8
    assert before.shape == (1, 2, 2, 2 * half)
    trunk = jax.tree.map(lambda leaf: leaf.at[0].multiply(1.5), variables["params"]["trunk"])
    heavier = {"params": {**variables["params"], "trunk": trunk}}
    for after in (features(heavier, maps), features(variables, maps.at[..., :3].multiply(-1.0))):
        assert_array_equal(after[..., half:], before[..., half:])
        assert np.any(after[..., :half] != before[..., :half])
    after = features(variables, maps.at[..., 3:].multiply(-1.0))
    assert_array_equal(after[..., :half], before[..., :half])
    assert np.any(after[..., half:] != before[..., half:])


@pytest.mark.parametrize(
    ("upsample", "output_stride", "factor"), [(1, 4, 8), (2, 1, 16), (2, 16, 1)]
)
def test_head_upsamples(upsample: int, output_stride: int, factor: int):
    """Claim: maps have the resolution that `output_stride` says; they are bilinear between the
    features' cells, which keep their places, and constant features give a constant map."""
    cfg = with_constants(DenseNet121(), upsample=upsample, output_stride=output_stride)
    plane = np.add.outer(3.0 * np.arange(4), np.arange(5))[None, ..., None]
    plane = jnp.asarray(plane, jnp.float32)
    got = np.asarray(densenet._upsample(plane, 32 // (cfg.upsample * cfg.output_stride)))[0, ..., 0]
    assert got.shape == (4 * factor, 5 * factor)
    at = [(np.arange(n * factor) + 0.5) / factor - 0.5 for n in (4, 5)]
    rows, cols = [(a >= 0) & (a <= n - 1) for a, n in zip(at, (4, 5), strict=True)]
    expected = np.add.outer(3.0 * at[0][rows], at[1][cols])
    assert_allclose(got[np.ix_(rows, cols)], expected, atol=1e-5)


def test_group_norm_sees_one_map():
    """Claim: with group norm a picture's maps do not depend on the rest of the batch."""
    head = densenet.DenseNetHead(TINY)
    features = jnp.asarray(np.random.default_rng(3).normal(size=(2, 3, 2, 2, 16)), jnp.float32)
    variables = random_variables(head, 0, (1, 2, 2, 16))
    apply = jax.jit(head.apply)
    together = apply(variables, features)
    assert together.shape == (2, 3, 16, 16, 3)
    assert_allclose(together[1, 2], apply(variables, features[1, 2:])[0], atol=1e-5)


HALF = with_constants(TINY, dtype="bfloat16")


@pytest.mark.slow
def test_bfloat16_is_near_float32():
    """Claim: Q in bfloat16 is that in float32 within 5 % of the largest; parameters and Q stay
    float32, features are bfloat16."""
    critic, plain = (densenet.DenseNetCritic(cfg) for cfg in (HALF, TINY))
    maps = jnp.asarray(np.random.default_rng(4).normal(size=(1, 64, 64, 4)), jnp.float32)
    variables = random_variables(plain, 0, maps.shape)
    with jax.numpy_dtype_promotion("standard"):  # Flax's norm promotes in half precision
        abstract = jax.eval_shape(critic.init, jax.random.key(0), maps)
        q, features = jax.jit(critic.apply)(variables, maps)
    assert {leaf.dtype for leaf in jax.tree.leaves(abstract)} == {jnp.dtype("float32")}
    assert (q.dtype, features.dtype) == (jnp.float32, jnp.bfloat16)
    wanted, _ = jax.jit(plain.apply)(variables, maps)
    assert 0.0 < np.abs(q - wanted).max() <= 0.05 * np.abs(wanted).max()
