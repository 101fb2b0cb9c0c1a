"""Networks and their updates: the critic towards the TD target, the actor up the critic.

M = critics, one or two of the same shape, their parameters stacked. Everything but the loss sees
the lower of their values in each cell.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from csac_jax.agent import actor, losses, maps, offsets, rewards
from csac_jax.agent.learner import Transition, UpdateInfo
from csac_jax.agent.maps import DenseMaps, Frames
from csac_jax.config import Config
from csac_jax.constants import Primitive
from csac_jax.nets import dense, networks
from csac_jax.sim.primitives import Action
from csac_jax.vision import heightmap, rotate
from csac_jax.vision.heightmap import Observation

_QUARTERS = 4  # parts of a batch that are asked for phi one after the other


@struct.dataclass
class Params:
    """Variables of the networks theta^Q and theta^mu, with running statistics of batch norm."""

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
    def return_range(self) -> float:
        """Distance between the bounds."""
        return self.bounds[1] - self.bounds[0]


def make(cfg: Config, network: Any = None) -> ActorCritic:
    """Networks and optimisers of a config; `network` is a critic of your own, see `networks`."""
    frames = maps.frames(cfg, networks.make(cfg.net, network))
    return with_optimisers(cfg, frames, rewards.bounds(cfg.reward, cfg.target.gamma))


def with_optimisers(cfg: Config, frames: Frames, bounds: tuple[Any, Any]) -> ActorCritic:
    """With Adam on clipped gradients, its step size falling linearly; numbers may be traced."""

    def adam(rate: float, updates: int) -> optax.GradientTransformation:
        schedule = optax.linear_schedule(rate, rate * cfg.learn.lr_final_fraction, updates)
        clip = optax.clip_by_global_norm(cfg.learn.gradient_clip)
        optimiser = optax.chain(clip, optax.adam(schedule))
        return optax.flatten(optimiser) if frames.networks.one_vector else optimiser

    critic_optimiser = adam(cfg.learn.learning_rate, cfg.train.steps * cfg.learn.updates)
    actor_optimiser = adam(cfg.learn.actor_learning_rate, cfg.train.steps)
    return ActorCritic(cfg, frames, critic_optimiser, actor_optimiser, bounds)


def init(key: jax.Array, learner: ActorCritic) -> LearnerState:
    """Fresh networks; targets are copies (Algorithm 1 lines 1-2)."""
    key_critic, key_actor = jax.random.split(key)
    cfg, nets = learner.cfg, learner.frames.networks
    rows = (cfg.heightmap.size, cfg.heightmap.size)
    fingers = jnp.zeros(3) if cfg.net.gripper else None
    obs = Observation(jnp.zeros((*rows, 3)), jnp.zeros(rows), jnp.zeros(rows, bool), fingers)
    blank = maps.rotated_inputs(learner.frames, obs)[:1]  # [1, C, C, I]
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key_critic, jnp.arange(cfg.learn.critics))
    (_, features), critic = jax.vmap(nets.critic.init_with_output, (0, None))(keys, blank)
    online = Params(critic, nets.head.init(key_actor, features[0]))
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
    """The state before the first update with these networks; `state` may be of several runs."""
    online = jax.tree.map(jnp.full_like, state.online, params)
    return state.replace(online=online, target=jax.tree.map(jnp.copy, online))


def with_inputs(params: Params, wanted: Params) -> Params:
    """Networks with the inputs of `wanted` that they lack, the last ones, whose weights are 0: they
    see the same until they learn. Those that do not fit so come back as they are."""
    found: Any = jax.tree.structure(params)
    if found != jax.tree.structure(wanted):
        return params

    def widened(leaf: jax.Array, like: jax.Array) -> jax.Array:
        missing = [(0, more - have) for have, more in zip(leaf.shape, like.shape, strict=True)]
        others = [more for axis, (_, more) in enumerate(missing) if axis != leaf.ndim - 2]
        fits = leaf.ndim >= 2 and missing[-2][1] > 0 and not any(others)  # ..., input, output
        return jnp.pad(leaf, missing) if fits else leaf

    return jax.tree.map(widened, params, wanted)


def with_trunk(state: LearnerState, trunk: Any) -> LearnerState:
    """The state before the first update, every trunk of the critics being `trunk`, see
    `torchvision.variables`."""
    critic = {name: {**part, "trunk": trunk[name]} for name, part in state.online.critic.items()}
    return with_params(state, state.online.replace(critic=critic))


def dense_maps(learner: ActorCritic, params: Params, obs: Observation) -> DenseMaps:
    """Dense maps of a batch of states: `obs` leaves [B, ...], result leaves [B, P, K, h, w]."""
    return _corrected(learner, params, obs, *_critic_maps(learner, params.critic, obs))


def exploration_maps(learner: ActorCritic, params: Params, obs: Observation) -> DenseMaps:
    """What a policy that explores acts on: `dense_maps`, with `policy.height_bonus`."""
    return _with_height_bonus(learner, obs, dense_maps(learner, params, obs))


def decision_maps(learner: ActorCritic, params: Params, obs: Observation) -> DenseMaps:
    """What a policy that does not explore acts on: `exploration_maps`, or with `policy.augment` of
    Q's mean over mirror images and critics."""
    if not learner.cfg.policy.augment:
        return exploration_maps(learner, params, obs)
    q, features = _of_passes(learner, params.critic, obs, networks.apply_mirrored)
    state = _corrected(learner, params, obs, jnp.mean(q, axis=0), features)
    return _with_height_bonus(learner, obs, state)


def _with_height_bonus(learner: ActorCritic, obs: Observation, state: DenseMaps) -> DenseMaps:
    """The maps of a batch, Q raised with the height of what lies under each cell."""
    if learner.cfg.policy.height_bonus == 0.0:
        return state
    heights = jax.vmap(maps.cell_heights, (None, 0))(learner.frames, obs.height)
    bonus = learner.cfg.policy.height_bonus * heights[:, None]  # [B, 1, K, h, w]
    terms = state.terms
    if terms is not None:
        terms = terms.at[..., 0].add(bonus)  # the value in the cell
    return state.replace(q=state.q + bonus, terms=terms)


def _corrected(
    learner: ActorCritic, params: Params, obs: Observation, q: jax.Array, features: jax.Array
) -> DenseMaps:
    """The maps of all yaws from Q and features in the frames of the passes."""
    correction: Any = jnp.zeros_like(q[..., : dense.OUTPUTS])
    if learner.cfg.learn.actor:
        correction = learner.frames.networks.head.apply(params.actor, features)
    return _dense_maps(learner, obs, q, correction)


def _critic_maps(learner: ActorCritic, critic: Any, obs: Observation) -> tuple[jax.Array, Any]:
    """Q [B, K / 2, h, w, OUTPUTS], the lower of both critics in each cell of the passes' frames,
    and the first one's features [B, K / 2, ., ., F]."""
    q, features = _of_passes(learner, critic, obs, networks.apply)
    if learner.frames.networks.terms > 1:
        return offsets.lower(q, dense.OUTPUTS), features
    return jnp.min(q, axis=0), features


def _of_passes(
    learner: ActorCritic, critic: Any, obs: Observation, apply: Callable[..., Any]
) -> tuple[jax.Array, Any]:
    """What `apply` makes of the passes of states by each critic: Q [M, B, K / 2, h, w, OUTPUTS],
    and the first one's features [B, K / 2, ., ., F]."""
    rotated = jax.vmap(maps.rotated_inputs, (None, 0))(learner.frames, obs)
    q, features = _of_each_critic(
        lambda variables: apply(learner.frames.networks, variables, rotated), critic
    )
    return q, features[0]


def _of_each_critic(call: Callable[[Any], Any], variables: Any) -> Any:
    """What `call` makes of the variables of each critic, leaves [M, ...] in and out.

    One after another: the grouped convolutions of a vmap take longer than both by themselves.
    """
    num = jax.tree.leaves(variables)[0].shape[0]
    each = [call(jax.tree.map(lambda leaf, m=m: leaf[m], variables)) for m in range(num)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)


def _dense_maps(
    learner: ActorCritic, obs: Observation, q: jax.Array, correction: jax.Array
) -> DenseMaps:
    """The maps of all yaws from Q and the actor's output in the frames of the passes."""
    unfold = jax.vmap(maps.unfold)
    valid = jax.vmap(maps.actionable_cells, (None, 0))(learner.frames, obs)
    values = q[..., : dense.OUTPUTS]
    terms = None if q.shape == values.shape else jax.vmap(maps.unfold_terms)(q)
    return DenseMaps(unfold(values), unfold(actor.logits(values, correction)), valid, terms)


def best_grasp(state: DenseMaps) -> jax.Array:
    """phi_g(s) of eq. 16, []: the largest valid grasp value; 0 if there is nothing to grasp."""
    valid = state.valid[Primitive.GRASP]
    best = jnp.max(jnp.where(valid, state.q[Primitive.GRASP], -jnp.inf))
    return jnp.where(jnp.any(valid), best, 0.0)


def best_grasps(
    learner: ActorCritic, params: Params, obs: Observation, wanted: jax.Array
) -> jax.Array:
    """phi_g [B] of those observations, leaves [B, ...], that are `wanted` [B] bool; else 0.

    These come first, and are passed through the networks by a quarter of the batch at a time, ours;
    quarters with none of them cost nothing. Under vmap as many are computed as the neediest asks.
    """
    num = wanted.shape[0]
    size = -(-num // _QUARTERS)
    # Not by a sort: one whose keys nobody reads ends the process on several devices without Shardy.
    places = jnp.nonzero(wanted, size=num + -num % size, fill_value=num)[0]
    rows = places.astype(jnp.int32).reshape(-1, size)

    def left(carry: tuple[jax.Array, jax.Array]) -> jax.Array:
        return carry[0] * size < jnp.sum(wanted)

    def quarter(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        done, values = carry
        part = jax.tree.map(lambda leaf: leaf.at[rows[done]].get(mode="clip"), obs)
        phi = jax.vmap(best_grasp)(dense_maps(learner, params, part))
        return done + 1, values.at[rows[done]].set(phi, mode="drop")

    _, values = jax.lax.while_loop(left, quarter, (jnp.int32(0), jnp.zeros(num)))
    return jnp.where(wanted, values, 0.0)


def renewed_reward(
    learner: ActorCritic, params: Params, batch: Transition, next_maps: DenseMaps
) -> jax.Array:
    """Rewards [B], eq. 16's label by the networks `params`; as stored if no label is renewed.

    phi(s') is read off `next_maps`, of the same networks; only pushes ask for phi(s).
    """
    if batch.push_better is None:
        return batch.reward
    cfg, pushed = learner.cfg.reward, batch.action.primitive == Primitive.PUSH
    before = best_grasps(learner, params, heightmap.unpack(batch.obs), pushed)
    good = rewards.gains_value(cfg, before, jax.vmap(best_grasp)(next_maps))
    relabelled = rewards.relabel(cfg, batch.reward, batch.push_better, good)
    return jnp.where(pushed, relabelled, batch.reward)


def next_value(learner: ActorCritic, key: jax.Array, state: DenseMaps) -> jax.Array:
    """V(s') [] over the primitives that the policy takes, as `target.value` says."""
    return NEXT_VALUES[learner.cfg.target.value](learner, key, state)


def _max_value(learner: ActorCritic, key: jax.Array, state: DenseMaps) -> jax.Array:
    """max Q'(s', .) [] over the dense map's valid cells, eq. 9 and VPG; over all if none is valid.

    The limit of the softmax over the map: a trilinear map is highest in a cell, which samples miss.
    """
    chosen = np.array(maps.allowed_primitives(learner.cfg.policy))
    valid = state.valid[chosen]
    return jnp.max(jnp.where(valid | ~jnp.any(valid), state.q[chosen], -jnp.inf))


def _softmax_value(learner: ActorCritic, key: jax.Array, state: DenseMaps) -> jax.Array:
    """softmax_beta(Q'(s', .)) [] over noisy target actions, Algorithm 1 line 17.

    Samples above nothing count only if all are. beta is relative to the range of returns (ours).
    """
    cfg, frames = learner.cfg.target, learner.frames

    def of(primitive: jax.Array, one: DenseMaps) -> tuple[jax.Array, jax.Array, jax.Array]:
        mean = maps.normalise(frames, actor.pose(frames, one, 0))
        key_noise = jax.random.fold_in(key, primitive)
        noisy, log_density = losses.noisy_actions(key_noise, cfg, mean)
        poses = jax.vmap(maps.denormalise, (None, 0))(frames, noisy)
        read = jax.vmap(maps.read_valid, (None, None, None, 0))
        return *read(frames, one, 0, poses), log_density

    sampled = maps.of_each_primitive(of, state, maps.allowed_primitives(learner.cfg.policy))
    q, valid, log_density = (leaf.reshape(-1) for leaf in sampled)
    shown = valid | ~jnp.any(valid)
    return losses.softmax(
        jnp.where(shown, q, learner.bounds[0]),
        jnp.where(shown, log_density, jnp.inf),
        cfg.inverse_temperature / learner.return_range,
    )


NEXT_VALUES = {"softmax": _softmax_value, "max": _max_value}


def _value(
    learner: ActorCritic, critic: Any, obs: Observation, action: Action
) -> tuple[jax.Array, Any]:
    """Q(s, a) of a batch by each critic [M, B], and the running statistics after the batch.

    From two passes per state, in the frames next to the action's yaw; nets run as in training.
    """
    frames, num = learner.frames, learner.frames.yaws.shape[0]
    index = maps.yaw_index(frames, action.pose[:, 2])
    lower = rotate.floor(index)
    k = jnp.mod(lower[:, None].astype(jnp.int32) + np.array([[0, 1]], np.int32), num)  # [B, 2]
    half = jnp.mod(k, num // 2)
    inputs = maps.input_maps(frames, obs)
    passes = jax.vmap(rotate.rotate, (None, 0, 0))(frames.tables, inputs, half)
    flat = passes.reshape(-1, *passes.shape[2:])
    (q, _), statistics = _of_each_critic(
        lambda variables: networks.train(frames.networks.critic, variables, flat), critic
    )
    q = q.reshape(q.shape[0], *k.shape, *q.shape[2:])  # [M, B, 2, h, w, OUTPUTS T]
    push_output = (k >= num // 2).astype(jnp.int32)
    is_grasp = (action.primitive == Primitive.GRASP)[:, None]
    output = jnp.where(is_grasp, dense.OUTPUTS - 1, push_output)

    def at(
        q: jax.Array, output: jax.Array, half: jax.Array, turn: jax.Array, xy: jax.Array
    ) -> jax.Array:
        yaw = jnp.asarray(frames.yaws)[half]
        position = rotate.to_cell(frames.side, frames.cell, yaw, xy)
        if frames.networks.terms == 1:
            return rotate.bilinear(q[..., output], position)
        terms = q.reshape(*q.shape[:2], -1, dense.OUTPUTS)[..., output]
        return offsets.blend(terms, position, turn)

    read = jax.vmap(jax.vmap(at, (0, 0, 0, 0, None)))
    turn = (index - lower)[:, None] - np.array([[0.0, 1.0]], np.float32)  # [B, 2] yaws
    near = jax.vmap(read, (0, None, None, None, None))(
        q, output, half, turn, action.pose[:, :2]
    )  # [M, B, 2]
    share = (index - lower)[None]
    return (1.0 - share) * near[..., 0] + share * near[..., 1], statistics


def update_critic(
    key: jax.Array, learner: ActorCritic, state: LearnerState, batch: Transition, weights: jax.Array
) -> tuple[LearnerState, UpdateInfo]:
    """One step of theta^Q on a batch, then of the targets after it; Algorithm 1 lines 17-26.

    L = mean_i w_i huber(y_i - Q(s_i, a_i)) with `weights` w [B], 1 but for a prioritised replay.
    """
    cfg = learner.cfg
    next_maps = dense_maps(learner, state.target, heightmap.unpack(batch.next_obs))
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(batch.reward.shape[0]))
    values = jax.vmap(next_value, (None, 0, 0))(learner, keys, next_maps)
    values = jnp.clip(values, *learner.bounds)
    reward = renewed_reward(learner, state.target, batch, next_maps)
    y = losses.td_target(reward, cfg.target.gamma, batch.terminated, values)
    obs, critic = heightmap.unpack(batch.obs), state.online.critic

    def loss(learned: Any) -> tuple[jax.Array, tuple[jax.Array, Any]]:
        q, statistics = _value(learner, {**critic, **learned}, obs, batch.action)  # [M, B]
        each = jnp.sum(losses.td_loss(cfg.learn, y[None] - q), axis=0)
        return jnp.mean(weights * each), (jnp.mean(q, axis=0), statistics)

    before = networks.learned(critic)
    (critic_loss, (q, statistics)), gradient = jax.value_and_grad(loss, has_aux=True)(before)
    step, optimiser = learner.critic_optimiser.update(gradient, state.critic_optimiser)
    online = state.online.replace(critic={**optax.apply_updates(before, step), **statistics})
    updates = state.updates + 1
    target = losses.update_target(cfg.learn, online, state.target)
    state = state.replace(online=online, target=target, critic_optimiser=optimiser, updates=updates)
    return state, UpdateInfo(critic_loss, jnp.mean(q), y - q)


def update_actor(
    learner: ActorCritic, state: LearnerState, obs: Observation
) -> tuple[LearnerState, jax.Array]:
    """One step of theta^mu up the critic, Algorithm 1 lines 22-23, and the loss [].

    grad J = mean grad_a Q(s, a)|_{a = mu(s)} grad mu(s), through the interpolated map, for each
    primitive that the policy takes; the loss is -J. Without an actor nothing changes and it is 0.
    """
    if not learner.cfg.learn.actor:
        return state, jnp.zeros(())
    frames, chosen = learner.frames, maps.allowed_primitives(learner.cfg.policy)
    q, features = jax.lax.stop_gradient(_critic_maps(learner, state.online.critic, obs))

    def value(_: jax.Array, one: DenseMaps) -> jax.Array:
        return maps.read_q(frames, one, jnp.int32(0), actor.pose(frames, one, 0))

    def loss(learned: Any) -> tuple[jax.Array, Any]:
        variables = {**state.online.actor, **learned}
        correction, statistics = networks.train(frames.networks.head, variables, features)
        batch_maps = _dense_maps(learner, obs, q, correction)
        of_each = functools.partial(maps.of_each_primitive, value, chosen=chosen)
        return -jnp.mean(jax.vmap(of_each)(batch_maps)), statistics

    before = networks.learned(state.online.actor)
    (actor_loss, statistics), gradient = jax.value_and_grad(loss, has_aux=True)(before)
    step, optimiser = learner.actor_optimiser.update(gradient, state.actor_optimiser)
    online = state.online.replace(actor={**optax.apply_updates(before, step), **statistics})
    return state.replace(online=online, actor_optimiser=optimiser), actor_loss
