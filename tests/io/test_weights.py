"""Pretrained weights: files that the tests write, in the names and shapes of torchvision's
densenet121."""

from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy

from csac_jax import cli, presets
from csac_jax.agent import actor_critic
from csac_jax.config import DenseNet121
from csac_jax.io import weights
from csac_jax.runtime import signals
from tests.sections import with_constants

LAYERS, GROWTH = (1, 2, 1, 1), 4
NET = with_constants(
    DenseNet121(norm="batch", rotations=4, head=8), block_layers=LAYERS, block_growth=GROWTH
)


def _norm(name: str, channels: int) -> Iterator[tuple[str, tuple[int, ...]]]:
    for kind in ("weight", "bias", "running_mean", "running_var"):
        yield f"{name}.{kind}", (channels,)
    yield f"{name}.num_batches_tracked", ()


def _names(layers: tuple[int, ...], growth: int) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Names and shapes of torchvision's densenet121, its classifier included."""
    channels = 2 * growth
    yield "features.conv0.weight", (channels, 3, 7, 7)
    yield from _norm("features.norm0", channels)
    for block, count in enumerate(layers, start=1):
        for layer in range(1, count + 1):
            name = f"features.denseblock{block}.denselayer{layer}"
            yield from _norm(f"{name}.norm1", channels)
            yield f"{name}.conv1.weight", (4 * growth, channels, 1, 1)
            yield from _norm(f"{name}.norm2", 4 * growth)
            yield f"{name}.conv2.weight", (growth, 4 * growth, 3, 3)
            channels += growth
        if block < len(layers):
            yield from _norm(f"features.transition{block}.norm", channels)
            yield f"features.transition{block}.conv.weight", (channels // 2, channels, 1, 1)
            channels //= 2
    yield from _norm("features.norm5", channels)
    yield "classifier.weight", (1000, channels)
    yield "classifier.bias", (1000,)


@pytest.fixture
def tensors() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        name: rng.normal(size=shape).astype(np.float32) for name, shape in _names(LAYERS, GROWTH)
    }


def _file(path: Path, tensors: dict[str, np.ndarray]) -> Path:
    """The file `path`, written with these tensors."""
    safetensors.numpy.save_file(tensors, path)
    return path


def test_weights_reach_their_places(tmp_path, tensors):
    """Claim: every tensor of the file is in the trunk, kernels turned to [k, k, I, O]; a
    half-precision file too."""
    got = weights.read(NET, _file(tmp_path / "w.safetensors", tensors))
    layer = "denseblock2", "denselayer2"
    params, statistics = (got[kind][layer[0]][layer[1]] for kind in ("params", "batch_stats"))
    prefix = "features.denseblock2.denselayer2."
    kernel = tensors[prefix + "conv2.weight"]
    for k in np.ndindex(3, 3):
        np.testing.assert_array_equal(params["conv2"]["kernel"][k], kernel[:, :, k[0], k[1]].T)
    np.testing.assert_array_equal(params["norm1"]["scale"], tensors[prefix + "norm1.weight"])
    np.testing.assert_array_equal(params["norm2"]["bias"], tensors[prefix + "norm2.bias"])
    np.testing.assert_array_equal(
        statistics["norm1"]["mean"], tensors[prefix + "norm1.running_mean"]
    )
    np.testing.assert_array_equal(statistics["norm2"]["var"], tensors[prefix + "norm2.running_var"])
    used = [t for n, t in tensors.items() if "classifier" not in n and "tracked" not in n]
    sums = [sum(t.sum(dtype=np.float64) for t in each) for each in (jax.tree.leaves(got), used)]
    np.testing.assert_allclose(*sums, rtol=1e-6)
    rounded = {name: tensor.astype(np.float16) for name, tensor in tensors.items()}
    half = weights.read(NET, _file(tmp_path / "h.safetensors", rounded))
    assert {leaf.dtype for leaf in jax.tree.leaves(half)} == {np.dtype("float32")}


def test_names_of_densenet_121_fit():
    """Claim: the names and shapes of torchvision's densenet121 are those of a trunk, all 7,037,504
    numbers."""
    zeros = {
        name: np.broadcast_to(np.float32(0.0), shape) for name, shape in _names((6, 12, 24, 16), 32)
    }
    got = weights.variables(DenseNet121(norm="batch"), zeros)
    assert sum(leaf.size for leaf in jax.tree.leaves(got)) == 7_037_504


def _lost(tensors: dict[str, np.ndarray]) -> None:
    del tensors["features.transition1.norm.running_var"]


def _added(tensors: dict[str, np.ndarray]) -> None:
    tensors["features.denseblock1.denselayer7.conv1.weight"] = np.zeros(1, np.float32)


def _bent(tensors: dict[str, np.ndarray]) -> None:
    tensors["features.conv0.weight"] = tensors["features.conv0.weight"][:, :1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_lost, "tensor features.transition1.norm.running_var is missing"),
        (
            _added,
            "tensor features.denseblock1.denselayer7.conv1.weight is not part of DenseNet-121",
        ),
        (_bent, r"tensor features.conv0.weight has the shape \[8, 1, 7, 7\], not \[8, 3, 7, 7\]"),
    ],
)
def test_bad_tensor_is_named(tmp_path, tensors, change, message):
    """Claim: a missing, an extra and a misshapen tensor is an error of one line with its name and
    the file's."""
    change(tensors)
    path = _file(tmp_path / "w.safetensors", tensors)
    with pytest.raises(ValueError, match=f"^in .*w.safetensors, {message}; give .*$"):
        weights.read(NET, path)


@pytest.mark.parametrize(
    ("content", "code", "message"),
    [("nothing", 1, "there is no"), ("pickle", 2, "cannot be read as"), ("net", 2, "the shape")],
)
def test_command_line_complains_before_training(tmp_path, tensors, capsys, content, code, message):
    """Claim: `train` refuses weights that are no .safetensors or of another net with exit code 2,
    that are not there with 1, in one line, before anything is made."""
    run, path = tmp_path / "run", tmp_path / "w.safetensors"
    if content == "pickle":
        path.write_bytes(b"pickle")
    elif content == "net":
        _file(path, tensors)
    flags = ["--init", str(path), "--run-dir", str(run)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(signals, "install", signals.Stop)
        assert cli.main(["train", "paper", *flags]) == code
    line = capsys.readouterr().err
    assert line.startswith("csac-jax: ")
    assert "w.safetensors" in line
    assert message in line
    assert line.count("\n") == 1
    assert not run.exists()


@pytest.mark.optax
def test_networks_begin_with_the_weights(tmp_path, tensors):
    """Claim: every trunk of every critic, online and target, begins with the file's weights and
    statistics; heads and optimisers are as without."""
    cfg = presets.smoke().change(net=NET, learn={"critics": 2})
    learner = actor_critic.make(cfg)
    with jax.numpy_dtype_promotion("standard"):
        abstract = jax.eval_shape(lambda: actor_critic.init(jax.random.key(0), learner))
    blank = jax.tree.map(lambda leaf: jnp.full(leaf.shape, 7, leaf.dtype), abstract)
    trunk = weights.read(NET, _file(tmp_path / "w.safetensors", tensors))
    state = actor_critic.with_trunk(blank, trunk)
    for params in (state.online, state.target):
        for kind in ("params", "batch_stats"):
            for leaf, one in zip(
                jax.tree.leaves(params.critic[kind]["trunk"]),
                jax.tree.leaves(trunk[kind]),
                strict=True,
            ):
                assert leaf.shape == (2, 2, *one.shape)
                np.testing.assert_array_equal(leaf, np.broadcast_to(one, leaf.shape))
            for leaf in jax.tree.leaves(params.critic[kind]["head"]):
                np.testing.assert_array_equal(leaf, 7)
    for name in ("critic_optimiser", "actor_optimiser", "updates"):
        jax.tree.map(np.testing.assert_array_equal, getattr(state, name), getattr(blank, name))
