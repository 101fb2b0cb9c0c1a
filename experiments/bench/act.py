"""Times the dense Q maps of a state, 2 primitives x 16 yaws, as JSON: `csac-jax bench act
[--states N] [--pixels N] [--repeats N]`.

DenseNet-121 over colour and height maps of PIXELS (224) cells, one state and STATES (64) at once,
each cell a pixel wide, maps as fine as the height map. Then the small net, one critic, at
the size that it is used at: as it is by default, in `quick` and in `fast`. All weights are random;
the median of REPEATS (10) calls counts.
"""

import dataclasses
import time
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import presets
from csac_jax.agent import actor_critic, critic, values
from csac_jax.agent.actor_critic import ActorCritic
from csac_jax.config import Config, DenseNet121, HeightmapConfig, NetConfig, SmallNet
from csac_jax.errors import SettingsError
from csac_jax.runtime import compiler
from csac_jax.training import programs
from csac_jax.vision.heightmap import Observation
from experiments.bench._options import emit, read
from experiments.bench._timing import medians


class FineDenseNet(DenseNet121):
    """DenseNet-121 whose maps are as fine as the height map, as are the pixels that it sees."""

    output_stride: ClassVar[int] = 1
    upsample: ClassVar[int] = 1
    canvas_step: ClassVar[int] = DenseNet121.STRIDE


def _densenet(pixels: int) -> Config:
    """Returns the preset `paper` for clearing, on maps of `pixels` cells as its height map."""
    paper = presets.paper().change(task={"kind": "clear"})
    try:
        net = FineDenseNet(**dataclasses.asdict(paper.net))
        return dataclasses.replace(paper, heightmap=HeightmapConfig(size=pixels), net=net)
    except ValueError as error:
        raise SettingsError(f"bench act: {error}") from None


def _random(tree: Any) -> Any:
    """Draws arrays of the shapes of `tree`; norms are ones."""
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
        "pixels_of_a_pass": learner.frames.tables.canvas * getattr(cfg.net, "upsample", 1),
        "maps": list(dense_maps.out_info.shape),
        "seconds_per_state": seconds / states,
        "compile_seconds": round(compiled, 1),
        "temporary_bytes": memory.temp_size_in_bytes,
    }


def _update_memory(learner: ActorCritic) -> int:
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


def main(arguments: list[str]) -> None:
    """Prints the result."""
    options = read("act", arguments, pixels=224, states=64, repeats=10)
    pixels, repeats = options["pixels"], options["repeats"]
    cfg = _densenet(pixels)
    ours = [_ours(cfg, states, repeats) for states in (1, options["states"])]
    nets = {"default": SmallNet(), "quick": presets.quick().net, "fast": presets.fast().net}
    small = {name: _small(net, options["states"], repeats) for name, net in nets.items()}
    emit({"options": options, "densenet121": ours, "small": small})
