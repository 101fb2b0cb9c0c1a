"""Share of this machine's float32 peak that the parts of an update reach, as JSON: `csac-jax bench
learner [PRESET] [--repeats N] [SETTING ...]`, PRESET `quick` if none is given, a preset of the
small net, settings as `csac-jax train` takes them.

The peak is that of a product of two matrices of 2,048 x 2,048, timed turn by turn with the parts.
Operations are counted from the shapes: two for a multiplication with its addition, of convolutions
and the head alone; gradients count three times a forward pass. A part without a count is moves and
sums. Each part is compiled by itself, on random maps; the median of REPEATS (7) calls counts.

`forward` is the critic's pass over the next states of a batch, in all its frames; `convolutions`,
`norm` and `head` are parts of it, compiled alone. `turn` turns the batch's maps into those frames,
`target_value` makes values of the maps. `gradients` is the pass over the batch's own states, with
its gradients; `actor` the actor's update; `optimiser` a step of Adam and of the target networks.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from csac_jax.agent import actor, actor_critic, critic, losses, maps, values
from csac_jax.agent.actor_critic import ActorCritic
from csac_jax.config import Config, SmallNet
from csac_jax.errors import SettingsError
from csac_jax.nets import dense, networks
from csac_jax.nets.convolution import conv2d
from csac_jax.robot.primitives import Action
from csac_jax.runtime import compiler
from csac_jax.training import programs
from csac_jax.vision import heightmap
from experiments.bench._options import Parser, config, emit, split
from experiments.bench._timing import medians

PRODUCT = 2048  # side of the matrices whose product is the peak


def _layers(net: SmallNet, inputs: int) -> list[tuple[int, int, int, int, int]]:
    """Lists channels, kernel, stride and dilation of the trunk's convolutions."""
    stem = (inputs, net.stem, 2 * net.stride, net.stride, 1)
    ins = [net.stem + i * net.growth for i in range(len(net.dilations))]
    return [stem, *((i, net.growth, 3, 1, d) for i, d in zip(ins, net.dilations, strict=True))]


def _operations(net: SmallNet, inputs: int, cells: int) -> dict[str, float]:
    """Counts floating-point operations of a forward pass with cells x cells features."""
    convolutions = sum(2.0 * k * k * i * o for i, o, k, _, _ in _layers(net, inputs))
    features = net.stem + len(net.dilations) * net.growth
    outputs = dense.OUTPUTS * net.subpixel**2
    head = 2.0 * (features * net.head + net.head * outputs)
    return {"convolutions": convolutions * cells**2, "head": head * cells**2}


def _random(shapes: Any) -> Any:
    """Draws maps, images and networks of these shapes."""
    rng = np.random.default_rng(0)

    def draw(leaf: jax.ShapeDtypeStruct) -> jax.Array:
        if leaf.dtype == np.float32:
            return jnp.asarray(rng.uniform(0.0, 0.1, leaf.shape), leaf.dtype)
        return jnp.asarray(rng.integers(0, 2, leaf.shape), leaf.dtype)

    return jax.tree.map(draw, shapes)


def _parts(cfg: Config, parts: ActorCritic) -> dict[str, tuple[Callable[[], Any], float]]:
    """Compiles each part; returns a call and its operations."""
    nets, net, tables = parts.frames.networks, cfg.net, parts.frames.tables
    assert isinstance(net, SmallNet)
    jit = functools.partial(jax.jit, compiler_options=compiler.options(cfg))
    state = jit(lambda key: actor_critic.init(key, parts))(jax.random.key(0))
    first = jax.tree.map(lambda leaf: leaf[0], state.online.critic)
    keys = jax.random.split(jax.random.key(1), cfg.learn.batch)
    packed = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct((cfg.learn.batch, *leaf.shape), leaf.dtype),
        programs.example(cfg).obs,
    )
    obs = jit(heightmap.unpack)(_random(packed))
    turn = jit(lambda obs: jax.vmap(maps.rotated_inputs, (None, 0))(parts.frames, obs))
    turned = turn(obs)
    flat = turned.reshape(-1, *turned.shape[2:])
    passes, inputs, cells = flat.shape[0], flat.shape[-1], tables.canvas // net.stride
    each = _operations(net, inputs, cells)
    forward = each["convolutions"] + each["head"]
    layers = _layers(net, inputs)
    rng = np.random.default_rng(1)
    kernels = [jnp.asarray(rng.normal(size=(k, k, i, o)), jnp.float32) for i, o, k, _, _ in layers]

    def convolutions(flat: jax.Array, kernels: list[jax.Array]) -> jax.Array:
        """Runs the trunk's convolutions with nothing between them."""
        features = None
        for kernel, (_, _, k, stride, dilation) in zip(kernels, layers, strict=True):
            seen = flat if features is None else features
            new = conv2d(seen, kernel, stride, dilation, dilation * (k - stride) // 2)
            features = new if features is None else jnp.concatenate([features, new], axis=-1)
        return features

    norm = dense.GroupNorm(jnp.float32)
    made = [
        jnp.asarray(rng.normal(size=(passes, cells, cells, o)), jnp.float32) for _, o, *_ in layers
    ]
    scales = [{"params": {"scale": jnp.ones(o), "bias": jnp.zeros(o)}} for _, o, *_ in layers]
    features = jnp.concatenate(made, axis=-1)
    head = dense.Head(net)
    head_of = {"params": first["params"]["head"]}
    action = Action(
        primitive=jnp.arange(cfg.learn.batch) % 2,
        pose=jnp.asarray(rng.uniform(-0.1, 0.1, (cfg.learn.batch, 3)), jnp.float32),
    )

    def loss(learned: Any) -> jax.Array:
        variables = {**state.online.critic, **learned}
        return jnp.mean(critic.q_of_actions(parts, variables, obs, action)[0] ** 2)

    def optimise(state: actor_critic.LearnerState, gradient: Any) -> Any:
        before = networks.learned(state.online.critic)
        moved, optimiser = parts.critic_optimiser.update(gradient, state.critic_optimiser)
        online = state.online.replace(critic=optax.apply_updates(before, moved))
        return losses.update_target(cfg.learn, online, state.target), optimiser

    forward_of = jit(nets.critic.apply)
    dense_maps = jit(lambda params, obs: values.dense_maps(parts, params, obs))
    seen_maps = dense_maps(state.target, obs)
    next_values = jit(jax.vmap(functools.partial(critic.next_value, parts), (0, 0)))
    convolve, gradients = jit(convolutions), jit(jax.grad(loss))
    normalise = jit(lambda scales, made: list(map(norm.apply, scales, made)))
    head_only, adam = jit(head.apply), jit(optimise)
    learn_actor = jit(lambda state, obs: actor.update(parts, state, obs))
    some = jax.tree.map(lambda leaf: leaf[: cfg.learn.actor_batch or None], obs)
    gradient = networks.learned(state.online.critic)
    actors, frames = (cfg.learn.actor_batch or cfg.learn.batch), turned.shape[1]
    critics = cfg.learn.critics
    return {
        "forward": (lambda: forward_of(first, flat), passes * forward),
        "convolutions": (lambda: convolve(flat, kernels), passes * each["convolutions"]),
        "norm": (lambda: normalise(scales, made), 0.0),
        "head": (lambda: head_only(head_of, features), passes * each["head"]),
        "turn": (lambda: turn(obs), 0.0),
        "target_value": (lambda: next_values(keys, seen_maps), 0.0),
        "gradients": (lambda: gradients(gradient), critics * 2 * cfg.learn.batch * 3.0 * forward),
        "actor": (
            lambda: learn_actor(state, some),
            actors * frames * (critics * forward + 3.0 * each["head"]),
        ),
        "optimiser": (lambda: adam(state, gradient), 0.0),
    }


def measure(cfg: Config, repeats: int) -> dict[str, Any]:
    """Measures seconds, GFLOP/s and share of the peak of every part."""
    parts = _parts(cfg, actor_critic.make(cfg))
    matrix = jnp.asarray(np.random.default_rng(2).normal(size=(PRODUCT, PRODUCT)), jnp.float32)
    product = jax.jit(jnp.matmul)
    calls = {name: call for name, (call, _) in parts.items()}
    seconds = medians({**calls, "product": lambda: product(matrix, matrix)}, repeats)
    peak = 2.0 * PRODUCT**3 / seconds.pop("product")
    found: dict[str, dict[str, float]] = {}
    for name, (_, operations) in parts.items():
        found[name] = {"seconds": seconds[name]}
        if operations:
            rate = operations / seconds[name]
            found[name] |= {"gflop": operations / 1e9, "gflop_per_second": rate / 1e9}
            found[name] |= {"share_of_peak": rate / peak}
    return {"peak_gflop_per_second": peak / 1e9, "parts": found}


def main(arguments: list[str]) -> None:
    """Prints the result."""
    parser = Parser(prog="bench learner", allow_abbrev=False)
    parser.add_argument("--repeats", type=int, default=7)
    preset, options, flags = split(parser, arguments)
    cfg = config("learner", preset, flags)
    if options.repeats < 1:
        raise SettingsError("bench learner: --repeats: at least 1")
    if not isinstance(cfg.net, SmallNet):
        raise SettingsError(f"bench learner: {preset} has no small net; give quick or fast")
    emit({"preset": preset, **measure(cfg, options.repeats)})
