"""Networks and their updates: the critic towards the TD target, the actor up the critic.

M = critics, one or two of the same shape, their parameters stacked. Everything but the loss sees
the lower of their values in each cell.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from csac_jax.agent import actor, losses, maps, rewards, softmax
from csac_jax.agent.learner import Transition, UpdateInfo
from csac_jax.agent.maps import DenseMaps, Frames
from csac_jax.config import Config
from csac_jax.constants import Primitive
from csac_jax.nets import dense, networks
from csac_jax.nets.networks import Networks
from csac_jax.sim.primitives import Action
from csac_jax.vision import heightmap, rotate
from csac_jax.vision.heightmap import Observation


@struct.dataclass
class Params:
    """Variables of the networks: theta^Q and theta^mu, each with the running statistics of its
    batch norm, if any."""

    critic: Any  # leaves [M, ...]
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
    frames: Frames
    critic_optimiser: optax.GradientTransformation
    actor_optimiser: optax.GradientTransformation
    bounds: tuple[float, float]  # smallest and largest possible return

    @property
    def critic(self) -> Any:
        """The critic, a Flax module."""
        return self.frames.networks.critic

    @property
    def actor(self) -> Any:
        """The actor's head, a Flax module."""
        return self.frames.networks.head

    @property
    def return_range(self) -> float:
        """Distance between the bounds."""
        return self.bounds[1] - self.bounds[0]


def make(cfg: Config, network: Any = None) -> ActorCritic:
    """Networks and optimisers of a config; `network` is a critic of your own, see `networks`."""
    nets = networks.make(cfg.net, network)
    bounds = rewards.bounds(cfg.reward, cfg.target.gamma)
    return ActorCritic(cfg, maps.frames(cfg, nets), *_optimisers(cfg, nets), bounds)


def replace_hyperparams(learner: ActorCritic, cfg: Config, bounds: tuple[Any, Any]) -> ActorCritic:
    """The same networks with hyper-parameters and bounds of returns that may be traced."""
    critic_optimiser, actor_optimiser = _optimisers(cfg, learner.frames.networks)
    return dataclasses.replace(
        learner,
        cfg=cfg,
        critic_optimiser=critic_optimiser,
        actor_optimiser=actor_optimiser,
        bounds=bounds,
    )


def _optimisers(
    cfg: Config, nets: Networks
) -> tuple[optax.GradientTransformation, optax.GradientTransformation]:
    """Of the critic and of the actor."""
    return (
        _optimiser(cfg, nets, cfg.learn.learning_rate, cfg.train.steps * cfg.learn.updates),
        _optimiser(cfg, nets, cfg.learn.actor_learning_rate, cfg.train.steps),
    )


def _optimiser(
    cfg: Config, nets: Networks, rate: float, updates: int
) -> optax.GradientTransformation:
    """Adam on clipped gradients, its step size falling linearly over the run's `updates`."""
    schedule = optax.linear_schedule(rate, rate * cfg.learn.lr_final_fraction, updates)
    optimiser = optax.chain(
        optax.clip_by_global_norm(cfg.learn.gradient_clip), optax.adam(schedule)
    )
    return optax.flatten(optimiser) if nets.one_vector else optimiser


def init(key: jax.Array, learner: ActorCritic) -> LearnerState:
    """Fresh networks; targets are copies (Algorithm 1 lines 1-2)."""
    key_critic, key_actor = jax.random.split(key)
    side = learner.frames.tables.canvas
    size = learner.cfg.heightmap.size
    blank_obs = Observation(
        jnp.zeros((size, size, 3)), jnp.zeros((size, size)), jnp.zeros((size, size), bool)
    )
    blank = jnp.zeros((1, side, side, maps.input_maps(learner.frames, blank_obs).shape[-1]))
    keys = jax.vmap(jax.random.fold_in, (None, 0))(
        key_critic, jnp.arange(learner.cfg.learn.critics)
    )
    (_, features), critic = jax.vmap(learner.critic.init_with_output, (0, None))(keys, blank)
    online = Params(critic, learner.actor.init(key_actor, features[0]))
    return LearnerState(
        online=online,
        target=jax.tree.map(jnp.copy, online),
        critic_optimiser=learner.critic_optimiser.init(networks.learned(online.critic)),
        actor_optimiser=learner.actor_optimiser.init(networks.learned(online.actor)),
        updates=jnp.int32(0),
    )


def abstract_params(cfg: Config, network: Any = None) -> Params:
    """Shapes and types of a config's networks; no arrays."""
    return jax.eval_shape(lambda: init(jax.random.key(0), make(cfg, network))).online


def with_params(state: LearnerState, params: Params) -> LearnerState:
    """The state before the first update with these networks, targets included.

    Leaves of `state` may have more leading axes, as those of several runs.
    """

    def fill(old: jax.Array, new: Any) -> jax.Array:
        return jnp.broadcast_to(jnp.asarray(new, old.dtype), old.shape)

    online = jax.tree.map(fill, state.online, params)
    return state.replace(online=online, target=jax.tree.map(jnp.copy, online))


def with_trunk(state: LearnerState, trunk: Any) -> LearnerState:
    """The state before the first update, every trunk of the critics being `trunk`, see
    `torchvision.variables`."""
    critic = {name: {**part, "trunk": trunk[name]} for name, part in state.online.critic.items()}
    return with_params(state, state.online.replace(critic=critic))


def dense_maps(learner: ActorCritic, params: Params, obs: Observation) -> DenseMaps:
    """Dense maps of a batch of states: `obs` leaves [B, ...], result leaves [B, P, K, h, w]."""
    q, features = _critic_maps(learner, params, obs)
    correction: Any = (
        learner.actor.apply(params.actor, features)
        if learner.cfg.learn.actor
        else jnp.zeros_like(q)
    )
    return _dense_maps(learner, obs, q, correction)


def _critic_maps(
    learner: ActorCritic, params: Params, obs: Observation
) -> tuple[jax.Array, jax.Array]:
    """Q [B, K / 2, h, w, OUTPUTS] and features [B, K / 2, ., ., F] of a batch, in the frames of the
    passes.

    Q is the lower of both critics in each cell, before anything is read between cells; features are
    the first one's.
    """
    rotated = jax.vmap(maps.rotated_inputs, (None, 0))(learner.frames, obs)
    q, features = _of_each_critic(
        lambda variables: networks.apply(learner.frames.networks, variables, rotated), params.critic
    )
    return jnp.min(q, axis=0), features[0]


def _of_each_critic(call: Callable[[Any], Any], variables: Any) -> Any:
    """What `call` makes of the variables of each critic, leaves [M, ...] in and out.

    One after another: under vmap their convolutions become grouped ones, which take longer than
    both by themselves.
    """
    num = jax.tree.leaves(variables)[0].shape[0]
    each = [call(jax.tree.map(lambda leaf, m=m: leaf[m], variables)) for m in range(num)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)


def _dense_maps(
    learner: ActorCritic, obs: Observation, q: jax.Array, correction: jax.Array
) -> DenseMaps:
    """The maps of all yaws from those of the passes; `correction` [B, K / 2, h, w, OUTPUTS] is the
    actor's."""
    unfold = jax.vmap(maps.unfold)
    return DenseMaps(
        q=unfold(q),
        logits=unfold(actor.logits(q, correction)),
        valid=jax.vmap(maps.actionable_cells, (None, 0))(learner.frames, obs),
    )


def best_grasp(state: DenseMaps) -> jax.Array:
    """phi_g(s) of eq. 16, []: the largest valid grasp value; 0 if there is nothing to grasp."""
    valid = state.valid[Primitive.GRASP]
    best = jnp.max(jnp.where(valid, state.q[Primitive.GRASP], -jnp.inf))
    return jnp.where(jnp.any(valid), best, 0.0)


def next_value(learner: ActorCritic, key: jax.Array, state: DenseMaps) -> jax.Array:
    """V(s') [] over the primitives that the policy takes, as `target.value` says."""
    return NEXT_VALUES[learner.cfg.target.value](learner, key, state)


def _max_value(learner: ActorCritic, key: jax.Array, state: DenseMaps) -> jax.Array:
    """max Q'(s', .) [] over the dense map's valid cells, eq. 9 and VPG; over all if none is valid.

    The limit of the softmax over the map: samples would miss the highest cell, and a trilinear map
    is highest in one.
    """
    del key
    chosen = np.array(maps.allowed_primitives(learner.cfg.policy))
    valid = state.valid[chosen]
    return jnp.max(jnp.where(valid | ~jnp.any(valid), state.q[chosen], -jnp.inf))


def _softmax_value(learner: ActorCritic, key: jax.Array, state: DenseMaps) -> jax.Array:
    """softmax_beta(Q'(s', .)) [] over noisy target actions, Algorithm 1 line 17.

    Samples above nothing do not count, unless all are; a state's two primitives count alike.
    """
    cfg, frames = learner.cfg.target, learner.frames

    def of(primitive: Primitive) -> tuple[jax.Array, jax.Array, jax.Array]:
        mean = maps.normalise(frames, actor.pose(frames, state, primitive))
        noisy, log_density = softmax.noisy_actions(
            jax.random.fold_in(key, primitive), cfg, mean, cfg.samples
        )
        poses = jax.vmap(maps.denormalise, (None, 0))(frames, noisy)
        which = jnp.int32(primitive)
        q = jax.vmap(maps.read, (None, None, None, 0))(frames, state.q, which, poses)
        return (
            q,
            log_density,
            jax.vmap(maps.is_valid, (None, None, None, 0))(frames, state.valid, which, poses),
        )

    sampled = map(of, maps.allowed_primitives(learner.cfg.policy))
    q, log_density, valid = (jnp.concatenate(leaves) for leaves in zip(*sampled, strict=True))
    low, high = learner.bounds
    shown = valid | ~jnp.any(valid)
    inverse_temperature = softmax.scaled_inverse_temperature(cfg, high - low)
    return softmax.expectation(
        jnp.where(shown, q, low), jnp.where(shown, log_density, jnp.inf), inverse_temperature
    )


NEXT_VALUES = {"softmax": _softmax_value, "max": _max_value}


def _value(
    learner: ActorCritic, critic: Any, obs: Observation, action: Action
) -> tuple[jax.Array, Any]:
    """Q(s, a) of a batch by each critic [M, B], from two passes per state: the frames next to the
    action's yaw.

    The nets run as in training: beside Q, the running statistics after the batch.
    """
    frames = learner.frames
    num = frames.yaws.shape[0]
    turns = action.pose[:, 2] * (num / (2.0 * np.pi))
    lower = jnp.floor(turns)
    k = jnp.mod(lower[:, None].astype(jnp.int32) + np.array([[0, 1]], np.int32), num)  # [B, 2]
    half = jnp.mod(k, num // 2)
    inputs = maps.input_maps(frames, obs)
    one = jax.vmap(rotate.rotate, (None, 0, 0))(frames.tables, inputs, half)
    flat = one.reshape(-1, *one.shape[2:])
    (q, _), statistics = _of_each_critic(
        lambda variables: networks.train(learner.critic, variables, flat), critic
    )
    q = q.reshape(q.shape[0], *k.shape, *q.shape[2:])  # [M, B, 2, h, w, OUTPUTS]
    push_output = (k >= num // 2).astype(jnp.int32)
    output = jnp.where(
        (action.primitive == Primitive.GRASP)[:, None], dense.OUTPUTS - 1, push_output
    )

    def at(q: jax.Array, output: jax.Array, half: jax.Array, xy: jax.Array) -> jax.Array:
        yaw = jnp.asarray(frames.yaws)[half]
        position = rotate.to_cell(frames.side, frames.cell, yaw, xy)
        return rotate.bilinear(q[..., output], position)

    read = jax.vmap(jax.vmap(at, (0, 0, 0, None)))
    near = jax.vmap(read, (0, None, None, None))(q, output, half, action.pose[:, :2])  # [M, B, 2]
    share = (turns - lower)[None]
    return (1.0 - share) * near[..., 0] + share * near[..., 1], statistics


def update_critic(
    key: jax.Array, learner: ActorCritic, state: LearnerState, batch: Transition, weights: jax.Array
) -> tuple[LearnerState, UpdateInfo]:
    """One step of theta^Q on a batch, then of theta^Q' and theta^mu' after them; Algorithm 1 lines
    17-26.

    L = mean_i w_i huber(y_i - Q(s_i, a_i)) with `weights` w [B], 1 but for a prioritised replay.
    """
    cfg = learner.cfg
    next_maps = dense_maps(learner, state.target, heightmap.unpack(batch.next_obs))
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(batch.reward.shape[0]))
    values = jax.vmap(next_value, (None, 0, 0))(learner, keys, next_maps)
    low, high = learner.bounds
    target = losses.td_target(
        batch.reward, cfg.target.gamma, batch.terminated, jnp.clip(values, low, high)
    )
    obs, critic = heightmap.unpack(batch.obs), state.online.critic

    def loss(learned: Any) -> tuple[jax.Array, tuple[jax.Array, Any]]:
        q, statistics = _value(learner, {**critic, **learned}, obs, batch.action)  # [M, B]
        each = jnp.sum(losses.td_loss(cfg.learn, target[None] - q), axis=0)
        return jnp.mean(weights * each), (jnp.mean(q, axis=0), statistics)

    before = networks.learned(critic)
    (critic_loss, (q, statistics)), gradient = jax.value_and_grad(loss, has_aux=True)(before)
    step, optimiser = learner.critic_optimiser.update(gradient, state.critic_optimiser)
    online = state.online.replace(critic={**optax.apply_updates(before, step), **statistics})
    state = state.replace(
        online=online,
        target=losses.update_target(cfg.learn, online, state.target, state.updates + 1),
        critic_optimiser=optimiser,
        updates=state.updates + 1,
    )
    return state, UpdateInfo(critic_loss, jnp.mean(q), target - q)


def update_actor(
    learner: ActorCritic, state: LearnerState, obs: Observation
) -> tuple[LearnerState, jax.Array]:
    """One step of theta^mu up the critic, Algorithm 1 lines 22-23; returns the loss [], minus the
    mean of Q(s, mu(s)).

    grad J = mean grad_a Q(s, a)|_{a = mu(s)} grad mu(s), through the interpolated map, for each
    primitive that the policy takes. Without an actor (`learn.actor`) nothing changes and the loss
    is 0.
    """
    if not learner.cfg.learn.actor:
        return state, jnp.zeros(())
    chosen = maps.allowed_primitives(learner.cfg.policy)
    q, features = jax.lax.stop_gradient(_critic_maps(learner, state.online, obs))

    def value(state_maps: DenseMaps, primitive: Primitive) -> jax.Array:
        pose = actor.pose(learner.frames, state_maps, primitive)
        return maps.read(learner.frames, state_maps.q, jnp.int32(primitive), pose)

    def loss(learned: Any) -> tuple[jax.Array, Any]:
        correction, statistics = networks.train(
            learner.actor, {**state.online.actor, **learned}, features
        )
        batch_maps = _dense_maps(learner, obs, q, correction)
        values = [jax.vmap(lambda one, p=p: value(one, p))(batch_maps) for p in chosen]
        return -jnp.mean(jnp.stack(values)), statistics

    before = networks.learned(state.online.actor)
    (actor_loss, statistics), gradient = jax.value_and_grad(loss, has_aux=True)(before)
    step, optimiser = learner.actor_optimiser.update(gradient, state.actor_optimiser)
    online = state.online.replace(actor={**optax.apply_updates(before, step), **statistics})
    return state.replace(online=online, actor_optimiser=optimiser), actor_loss
