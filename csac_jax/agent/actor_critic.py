"""Networks and optimisers of an actor-critic: static parts, initial state and parameters."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from csac_jax.agent import maps, rewards
from csac_jax.config import Config
from csac_jax.nets import networks
from csac_jax.vision.heightmap import Observation


@struct.dataclass
class Params:
    """Variables of the networks theta^Q and theta^mu, with running statistics of batch norm."""

    critic: Any  # leaves [M, ...], M critics, one or two
    actor: Any


@struct.dataclass
class LearnerState:
    """Online and target networks and their optimisers."""

    online: Params
    target: Params
    critic_optimiser: optax.OptState
    actor_optimiser: optax.OptState
    updates: jax.Array  # [] int32, critic updates so far


@dataclasses.dataclass(frozen=True, eq=False)
class ActorCritic:
    """Static part: closed over by the compiled step."""

    cfg: Config
    frames: maps.Frames
    critic_optimiser: optax.GradientTransformation
    actor_optimiser: optax.GradientTransformation
    bounds: tuple[float, float]  # smallest and largest possible return


def make(cfg: Config, network: Any = None) -> ActorCritic:
    """Builds networks and optimisers of a config. `network` is a custom critic, see `networks`."""
    frames = maps.frames(cfg, networks.make(cfg.net, network))
    return with_optimisers(cfg, frames, rewards.bounds(cfg.reward, cfg.target.gamma))


def with_optimisers(cfg: Config, frames: maps.Frames, bounds: tuple[Any, Any]) -> ActorCritic:
    """Adds Adam with clipped gradients and a linear learning rate; numbers may be traced."""

    def adam(rate: float, updates: int) -> optax.GradientTransformation:
        schedule = optax.linear_schedule(rate, rate * cfg.learn.lr_final_fraction, updates)
        clip = optax.clip_by_global_norm(cfg.learn.gradient_clip)
        optimiser = optax.chain(clip, optax.adam(schedule))
        return optax.flatten(optimiser) if frames.networks.one_vector else optimiser

    critic_optimiser = adam(cfg.learn.learning_rate, cfg.train.steps * cfg.learn.updates_per_step)
    actor_optimiser = adam(cfg.learn.actor_learning_rate, cfg.train.steps)
    return ActorCritic(cfg, frames, critic_optimiser, actor_optimiser, bounds)


def init(key: jax.Array, learner: ActorCritic) -> LearnerState:
    """Creates random networks; targets are copies (Algorithm 1 lines 1-2)."""
    key_critic, key_actor = jax.random.split(key)
    cfg, nets = learner.cfg, learner.frames.networks
    rows = (cfg.heightmap.size, cfg.heightmap.size)
    fingers = jnp.zeros(3) if cfg.net.gripper else None
    obs = Observation(jnp.zeros((*rows, 3)), jnp.zeros(rows), jnp.zeros(rows, bool), fingers)
    blank = maps.rotated_inputs(learner.frames, obs)[:1]  # [1, C, C, I]
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key_critic, jnp.arange(cfg.learn.critics))
    (_, features), critic = jax.vmap(nets.critic.init_with_output, (0, None))(keys, blank)
    online = Params(critic, nets.head.init(key_actor, features[0]))
    critic_optimiser = learner.critic_optimiser.init(networks.learned(online.critic))
    actor_optimiser = learner.actor_optimiser.init(networks.learned(online.actor))
    target = jax.tree.map(jnp.copy, online)
    return LearnerState(online, target, critic_optimiser, actor_optimiser, jnp.int32(0))


def abstract_params(cfg: Config, network: Any = None) -> Params:
    """Returns shapes and dtypes of a config's networks, without arrays."""
    return jax.eval_shape(lambda: init(jax.random.key(0), make(cfg, network))).online


def with_params(state: LearnerState, params: Params) -> LearnerState:
    """Replaces the networks of an initial state; `state` may hold several runs."""
    online = jax.tree.map(jnp.full_like, state.online, params)
    return state.replace(online=online, target=jax.tree.map(jnp.copy, online))


def with_inputs(params: Params, wanted: Params) -> Params:
    """Adds the last inputs that `wanted` has and `params` lack, with weights of 0.

    The outputs stay the same. Networks that differ in another way are returned unchanged.
    """
    structure: Any = jax.tree.structure(params)
    if structure != jax.tree.structure(wanted):
        return params

    def widen(leaf: jax.Array, like: jax.Array) -> jax.Array:
        missing = [(0, new - old) for old, new in zip(leaf.shape, like.shape, strict=True)]
        others = [more for axis, (_, more) in enumerate(missing) if axis != leaf.ndim - 2]
        fits = leaf.ndim >= 2 and missing[-2][1] > 0 and not any(others)  # ..., input, output
        return jnp.pad(leaf, missing) if fits else leaf

    return jax.tree.map(widen, params, wanted)


def with_trunk(state: LearnerState, trunk: Any) -> LearnerState:
    """Replaces every trunk of the critics in an initial state, see `io.weights`."""
    critic = {name: {**part, "trunk": trunk[name]} for name, part in state.online.critic.items()}
    return with_params(state, state.online.replace(critic=critic))
