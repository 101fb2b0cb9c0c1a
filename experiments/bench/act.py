"""Speed of the dense Q maps of a state, 2 primitives x 16 yaws, as JSON: `csac-jax bench act
[--states N] [--zoom N] [--pixels N] [--repeats N]`.

DenseNet-121 over colour and height maps of PIXELS (224) cells, one state and STATES (64) at once,
each cell ZOOM (1) pixels wide, maps as fine as the height map; beside it, if torch is installed,
the way of VPG: each yaw, primitive and trunk is a pass of its own of one picture of twice the size,
float32. Then the small net, one critic, at the size that it is used at: as it is by default, in
`quick` and in `fast`. All weights are random; the median of REPEATS (10) calls counts.
"""

import dataclasses
import importlib.util
import json
import math
import time
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import presets
from csac_jax.agent import actor_critic, critic, values
from csac_jax.agent.actor_critic import ActorCritic
from csac_jax.cli.failures import BadArgumentsError
from csac_jax.config import Config, DenseNet121, HeightmapConfig, NetConfig, SmallNet
from csac_jax.runtime import compiler, provenance
from csac_jax.training import programs
from csac_jax.vision.heightmap import Observation
from experiments.bench._options import read
from experiments.bench._timing import medians


class FineDenseNet(DenseNet121):
    """DenseNet-121 whose maps are as fine as the height map."""

    output_stride: ClassVar[int] = 1


def _canvas(pixels: int, multiple: int) -> int:
    """Side of turned maps of `pixels` cells: their diagonal, rounded up; less where the margin may
    not be so large."""
    sides = range(-(-pixels // multiple) * multiple, int(1.5 * pixels) + 1, multiple)
    return next(
        (side for side in sides if side >= math.sqrt(2.0) * pixels), max(sides, default=pixels)
    )


def _densenet(pixels: int, zoom: int) -> Config:
    """The preset `paper`, which clears the table as VPG does, on maps of `pixels` cells as fine as
    its height map."""
    paper = presets.paper().change(task={"kind": "clear"})
    try:
        margin = _canvas(pixels, max(DenseNet121.STRIDE // zoom, 1)) / pixels - 1.0
        net = FineDenseNet(**dataclasses.asdict(paper.net) | {"margin": margin, "zoom": zoom})
        return dataclasses.replace(paper, heightmap=HeightmapConfig(size=pixels), net=net)
    except ValueError as error:
        raise BadArgumentsError(f"bench act: {error}") from None


def _random(tree: Any) -> Any:
    """Arrays of the shapes of `tree`: norms at their start, everything else random, nothing
    compiled."""
    rng = np.random.default_rng(0)

    def draw(path: Any, leaf: jax.ShapeDtypeStruct) -> jax.Array:
        if path[-1].key in ("scale", "var"):
            return jnp.ones(leaf.shape, leaf.dtype)
        return jnp.asarray(rng.normal(scale=0.05, size=leaf.shape), leaf.dtype)

    return jax.tree_util.tree_map_with_path(draw, tree)


def _observations(size: int, num: int) -> Observation:
    rng = np.random.default_rng(1)
    return Observation(
        colour=jnp.asarray(rng.uniform(size=(num, size, size, 3)), jnp.float32),
        height=jnp.asarray(rng.uniform(0.0, 0.1, (num, size, size)), jnp.float32),
        target=jnp.ones((num, size, size), bool),
    )


def _ours(cfg: Config, states: int, repeats: int) -> dict[str, Any]:
    """Time of the Q maps of `states` states at once."""
    learner = actor_critic.make(cfg)
    abstract = jax.eval_shape(lambda: actor_critic.init(jax.random.key(0), learner))
    params, obs = _random(abstract.online), _observations(cfg.heightmap.size, states)
    begun = time.perf_counter()
    jitted = jax.jit(
        lambda params, obs: values.dense_maps(learner, params, obs).q,
        compiler_options=compiler.options(cfg),
    )
    dense_maps = jitted.lower(params, obs).compile()
    compiled = time.perf_counter() - begun
    seconds = medians({"maps": lambda: dense_maps(params, obs)}, repeats)["maps"]
    memory = dense_maps.memory_analysis()
    assert memory is not None
    return {
        "states": states,
        "pixels_of_a_pass": learner.frames.tables.canvas
        * (cfg.net.zoom if isinstance(cfg.net, DenseNet121) else 1),
        "maps": list(dense_maps.out_info.shape),
        "seconds_per_state": seconds / states,
        "compile_seconds": round(compiled, 1),
        "temporary_bytes": memory.temp_size_in_bytes,
    }


def _update_memory(learner: ActorCritic) -> int:
    """Bytes that one update of the critic needs beside the networks and the batch."""
    state = jax.eval_shape(lambda: actor_critic.init(jax.random.key(0), learner))
    size = learner.cfg.learn.batch
    batch = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct((size, *leaf.shape), leaf.dtype),
        programs.example(learner.cfg),
    )
    update = jax.jit(lambda *given: critic.update(jax.random.key(0), learner, *given))
    compiled = update.lower(state, batch, jax.ShapeDtypeStruct((size,), jnp.float32)).compile()
    memory = compiled.memory_analysis()
    assert memory is not None
    return memory.temp_size_in_bytes


def _small(net: NetConfig, states: int, repeats: int) -> dict[str, Any]:
    """A small net with the map and the batch of `quick`."""
    cfg = dataclasses.replace(presets.quick(), net=net)
    learner = actor_critic.make(cfg)
    abstract = jax.eval_shape(lambda: actor_critic.init(jax.random.key(0), learner)).online
    return {
        "pixels": cfg.heightmap.size,
        "parameters": {
            name: sum(leaf.size for leaf in jax.tree.leaves(getattr(abstract, name)))
            for name in ("critic", "actor")
        },
        "times": [_ours(cfg, 1, repeats), _ours(cfg, states, repeats)],
        "update": {"batch": cfg.learn.batch, "temporary_bytes": _update_memory(learner)},
    }


def _torch_trunk(layers: tuple[int, ...], growth: int) -> Any:
    """DenseNet-121 without its top, in PyTorch, random weights."""
    import torch
    from torch import nn

    def convolution(ins: int, outs: int, size: int, stride: int = 1) -> nn.Module:
        return nn.Conv2d(ins, outs, size, stride, size // 2, bias=False)

    class Layer(nn.Module):
        def __init__(self, channels: int) -> None:
            super().__init__()
            wide = 4 * growth
            self.new = nn.Sequential(
                nn.BatchNorm2d(channels), nn.ReLU(inplace=False), convolution(channels, wide, 1),
                nn.BatchNorm2d(wide), nn.ReLU(inplace=True), convolution(wide, growth, 3),
            )  # fmt: skip

        def forward(self, maps: Any) -> Any:
            return torch.cat([maps, self.new(maps)], dim=1)

    channels = 2 * growth
    parts = [
        convolution(3, channels, 7, 2),
        nn.BatchNorm2d(channels),
        nn.ReLU(inplace=True),
        nn.MaxPool2d(3, 2, 1),
    ]
    for i, count in enumerate(layers):
        if i:
            parts += [
                nn.BatchNorm2d(channels),
                nn.ReLU(inplace=True),
                convolution(channels, channels // 2, 1),
            ]
            parts += [nn.AvgPool2d(2, 2)]
            channels //= 2
        parts += [Layer(channels + j * growth) for j in range(count)]
        channels += count * growth
    return nn.Sequential(*parts, nn.BatchNorm2d(channels))


def _vpg(net: DenseNet121, pixels: int, repeats: int) -> dict[str, Any]:
    """Time of the Q maps of one state as VPG makes them, in PyTorch; float32, PyTorch's
    defaults."""
    if importlib.util.find_spec("torch") is None:
        return {"missing": "torch is not installed"}
    import torch
    from torch import nn
    from torch.nn import functional

    device = "cuda" if torch.cuda.is_available() else "cpu"
    side = math.ceil(2.0 * math.sqrt(2.0) * pixels / DenseNet121.STRIDE) * DenseNet121.STRIDE
    trunks = [
        [_torch_trunk(net.block_layers, net.block_growth) for _ in range(2)] for _ in range(2)
    ]
    with torch.no_grad():
        width = 2 * trunks[0][0].eval()(torch.zeros(1, 3, 64, 64)).shape[1]
    heads = [
        nn.Sequential(
            nn.BatchNorm2d(width), nn.ReLU(), nn.Conv2d(width, 64, 1, bias=False),
            nn.BatchNorm2d(64), nn.ReLU(), nn.Conv2d(64, 1, 1, bias=False),
        )
        for _ in range(2)
    ]  # fmt: skip
    trunks = [[trunk.to(device).eval() for trunk in pair] for pair in trunks]
    heads = [head.to(device).eval() for head in heads]
    pictures = [torch.rand(1, 3, side, side, device=device) for _ in range(2)]

    def turn(maps: Any, angle: float) -> Any:
        cos, sin = math.cos(angle), math.sin(angle)
        matrix = torch.tensor([[[cos, sin, 0.0], [-sin, cos, 0.0]]], device=device)
        grid = functional.affine_grid(matrix, list(maps.shape), align_corners=False)
        return functional.grid_sample(maps, grid, mode="nearest", align_corners=False)

    def call() -> Any:
        maps = []
        with torch.no_grad():
            for k in range(net.rotations):
                angle = 2.0 * math.pi * k / net.rotations
                for pair, head in zip(trunks, heads, strict=True):
                    turned = [turn(picture, angle) for picture in pictures]
                    seen = [trunk(picture) for trunk, picture in zip(pair, turned, strict=True)]
                    q = turn(head(torch.cat(seen, dim=1)), -angle)
                    maps.append(
                        functional.interpolate(
                            q, scale_factor=16, mode="bilinear", align_corners=False
                        )
                    )
        if device == "cuda":
            torch.cuda.synchronize()
        return maps

    return {
        "device": torch.cuda.get_device_name() if device == "cuda" else device,
        "torch": torch.__version__,
        "tf32_convolutions": torch.backends.cudnn.allow_tf32,
        "passes": net.rotations * 4,
        "pixels_of_a_pass": side,
        "seconds_per_state": medians({"passes": call}, repeats)["passes"],
    }


def main(arguments: list[str]) -> None:
    """Prints the result."""
    options = read("act", arguments, pixels=224, states=64, zoom=1, repeats=10)
    pixels, repeats = options["pixels"], options["repeats"]
    cfg = _densenet(pixels, options["zoom"])
    ours = [_ours(cfg, states, repeats) for states in (1, options["states"])]
    assert isinstance(cfg.net, DenseNet121)
    vpg = _vpg(cfg.net, pixels, min(repeats, 3))
    ratios = (
        [vpg["seconds_per_state"] / one["seconds_per_state"] for one in ours]
        if "missing" not in vpg
        else None
    )
    nets = {"default": SmallNet(), "quick": presets.quick().net, "fast": presets.fast().net}
    result = {
        "options": options,
        "densenet121": ours,
        "vpg_in_torch": vpg,
        "vpg_over_densenet121": ratios,
        "small": {name: _small(net, options["states"], repeats) for name, net in nets.items()},
    }
    print(json.dumps(result | provenance.record(), indent=2))
