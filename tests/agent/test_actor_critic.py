"""Updates of critic and actor, by what they report and change."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from csac_jax.agent import actor, actor_critic, critic, maps, values
from csac_jax.agent.actor_critic import ActorCritic, LearnerState, Params
from csac_jax.agent.learner import Transition
from csac_jax.agent.maps import DenseMaps
from csac_jax.config import TargetConfig
from csac_jax.constants import Primitive
from csac_jax.nets import dense
from csac_jax.robot.primitives import Action
from csac_jax.vision import heightmap

pytestmark = pytest.mark.optax
B = 6
KEY = jax.random.key(3)


def _actions(rng: np.random.Generator, half: float) -> Action:
    """B random actions of both primitives within `half` m, at all yaws."""
    pose = np.column_stack([rng.uniform(-half, half, (B, 2)), rng.uniform(0.0, 2.0 * np.pi, B)])
    return Action(jnp.arange(B, dtype=jnp.int32) % 2, jnp.asarray(pose, jnp.float32))


@pytest.fixture(scope="module")
def state(learner, randomised) -> LearnerState:
    """Random online networks, and others as targets."""
    with jax.numpy_dtype_promotion("standard"):
        return randomised(jax.jit(lambda key: actor_critic.init(key, learner))(jax.random.key(0)))


@pytest.fixture(scope="module")
def batch(observations) -> Transition:
    """B transitions, none terminated."""
    rng = np.random.default_rng(5)
    return Transition(
        obs=heightmap.pack(observations(B, 1)),
        action=_actions(rng, 0.2),
        reward=jnp.asarray(rng.uniform(-1.0, 2.0, B), jnp.float32),
        next_obs=heightmap.pack(observations(B, 2)),
        terminated=jnp.zeros(B, bool),
    )


def _update(learner: ActorCritic):
    """Compiles (state, batch, weights) -> state, info of one update of the critic."""
    run = jax.jit(lambda *args: critic.update(KEY, learner, *args))
    return lambda state, batch, weights=jnp.ones(B): run(state, batch, weights)  # noqa: B008


@pytest.fixture(scope="module")
def update(learner):
    return _update(learner)


def _look(learner: ActorCritic):
    """Compiles (params, obs, packed or not) -> dense maps."""
    return jax.jit(lambda params, obs: values.dense_maps(learner, params, heightmap.unpack(obs)))


def _ended(batch: Transition) -> Transition:
    return batch.replace(terminated=jnp.ones_like(batch.terminated))


def _constant(params: Params, value: float) -> Params:
    """Sets every map to `value`: all is 0 but the bias of the outputs (axis 0 is the critics')."""
    is_bias = lambda leaf: leaf.shape[1:] == (dense.OUTPUTS,)  # noqa: E731
    fill = lambda leaf: jnp.full_like(leaf, value if is_bias(leaf) else 0.0)  # noqa: E731
    return params.replace(critic=jax.tree.map(fill, params.critic))


def _changed(learner: ActorCritic, **sections) -> ActorCritic:
    return dataclasses.replace(learner, cfg=learner.cfg.change(**sections))


def _same(first, other) -> None:
    jax.tree.map(assert_array_equal, first, other)


@pytest.mark.slow
def test_value_in_the_loss_is_that_of_the_maps(learner, state, batch, update):
    """Claim: Q(s, a) of the loss, from two passes, is the dense maps read at the action.

    Where everything ends the target is the reward, so that the error tells Q.
    """
    read = jax.jit(jax.vmap(lambda q, p, pose: maps.read(learner.frames, q, p, pose)))
    q, rng = _look(learner)(state.online, batch.obs).q, np.random.default_rng(0)
    for trial in range(12):
        action = _actions(rng, 0.224)
        action = action.replace(primitive=(action.primitive + trial) % 2)
        got = batch.reward - update(state, _ended(batch).replace(action=action))[1].error
        assert_allclose(got, read(q, action.primitive, action.pose), atol=2e-5)
    assert np.std(q) > 0.05


def test_losses_are_weighted(learner, state, batch, update):
    """Claim: the loss is mean(weight * Huber loss), and a transition of weight 0 changes no
    network; errors and the mean value `q` do not depend on weights; an update is counted."""
    weights = jnp.array([0.0, 0.25, 1.0, 0.5, 0.0, 1.0])
    (after, info), (_, plain) = update(state, batch, weights), update(state, batch)
    for each, weight in ((info, weights), (plain, 1.0)):
        loss = weight * optax.huber_loss(each.error, delta=learner.cfg.learn.huber)
        assert_allclose(each.critic_loss, np.mean(loss), rtol=1e-5)
    _same((info.error, info.q), (plain.error, plain.q))
    ended = update(state, _ended(batch))[1]
    assert_allclose(ended.q, np.mean(batch.reward - ended.error), atol=1e-6)
    higher = batch.replace(reward=batch.reward.at[jnp.array([0, 4])].add(3.0))
    _same(after.online, update(state, higher, weights)[0].online)
    assert after.updates == state.updates + 1


@pytest.mark.slow
def test_target_carries_no_gradient(learner, state, batch):
    """Claim: the critic's loss has no gradient in target networks and reward, but in its own."""

    def loss(online, target, reward):
        before = state.replace(online=online, target=target)
        rewarded = batch.replace(reward=reward)
        return critic.update(KEY, learner, before, rewarded, jnp.ones(B))[1].critic_loss

    gradient = jax.jit(jax.grad(loss, argnums=(0, 1, 2)))(state.online, state.target, batch.reward)
    online, *others = gradient
    for leaf in jax.tree.leaves((others, online.actor)):
        assert_array_equal(leaf, 0.0)
    assert all(np.any(np.asarray(leaf) != 0.0) for leaf in jax.tree.leaves(online.critic))


def _check_slope(run, state, name: str, relative: float = 1e-2, step: float = 2e-3) -> None:
    """Compares the step of plain gradient descent on network `name` with finite differences.

    `run` maps a state to one updated by the gradient g, and its loss. Along g / |g| the slope is
    |g|.
    """
    params = getattr(state.online, name)
    gradient = jax.tree.map(jnp.subtract, params, getattr(run(state)[0].online, name))
    size = float(optax.tree.norm(gradient))
    assert size > 1e-4

    def loss(sign: float) -> jax.Array:
        moved = jax.tree.map(lambda p, g: p + sign * step / size * g, params, gradient)
        return run(state.replace(online=state.online.replace(**{name: moved})))[1]

    assert_allclose((loss(1.0) - loss(-1.0)) / (2.0 * step), size, rtol=relative)


def test_critic_gradient_is_that_of_its_loss(learner, state, batch):
    """Claim: along the gradient, the reported loss changes as fast as finite differences say."""
    run = _update(dataclasses.replace(learner, critic_optimiser=optax.sgd(1.0)))

    def loss(state):
        after, info = run(state, _ended(batch), jnp.linspace(0.2, 1.0, B))
        return after, info.critic_loss

    _check_slope(loss, state, "critic")


def test_actor_gradient_is_that_of_its_loss(learner, state, observations):
    """Claim: the policy gradient through the interpolated map is that of finite differences; the
    loss is the mean of -Q(s, mu(s)), and an update changes neither critic nor targets.

    In these scenes no highest cell gives way to another within the step: there the pose jumps. The
    step is so long that float32's rounding of the loss, 1e-8, is 1e-5 of the slope.
    """
    plain = dataclasses.replace(learner, actor_optimiser=optax.sgd(1.0))
    run = jax.jit(lambda state: actor.update(plain, state, observations(B, 4)))
    _check_slope(run, state, "actor", relative=1e-3, step=1.6e-2)
    after, loss = run(state)
    look = jax.jit(lambda params: values.dense_maps(learner, params, observations(B, 4)))
    dense_maps = look(state.online)
    best = lambda state, p: maps.read(  # noqa: E731
        learner.frames, state.q, jnp.int32(p), actor.pose(learner.frames, state, p)
    )
    worth = jnp.stack([jax.vmap(best, (0, None))(dense_maps, p) for p in Primitive])
    assert_allclose(loss, -jnp.mean(worth), atol=1e-6)
    for name in ("critic_optimiser", "target", "updates"):
        _same(getattr(after, name), getattr(state, name))
    _same(after.online.critic, state.online.critic)


def test_target_moves_by_tau(learner, state, batch, update):
    """Claim: theta' = tau theta + (1 - tau) theta' with the updated networks, critic and actor."""
    after, _ = update(state, batch)
    tau = learner.cfg.learn.tau
    for new, old, got in zip(
        *map(jax.tree.leaves, (after.online, state.target, after.target)), strict=True
    ):
        assert_allclose(got, tau * new + (1.0 - tau) * old, atol=1e-7)
    for new, old in zip(
        *map(jax.tree.leaves, (after.online.critic, state.online.critic)), strict=True
    ):
        assert np.any(new != old)


@pytest.mark.parametrize("value", [1.5, 100.0, -100.0])
def test_bootstrap(learner, state, batch, update, value):
    """Claim: y = r + gamma V(s') by the target critic, V within the returns; y = r after an end."""
    known = state.replace(target=_constant(state.target, value))
    half = jnp.arange(B) < B // 2
    going, ended, mixed = (
        update(known, batch.replace(terminated=t))[1].error
        for t in (half & False, half | True, half)
    )
    gain = learner.cfg.target.gamma * np.clip(value, *learner.bounds)
    assert_allclose(going - ended, gain, atol=1e-5)
    assert_allclose(mixed - ended, np.where(half, 0.0, gain), atol=1e-5)


def _smooth(frames) -> DenseMaps:
    """Smooth maps with a few peaks, all of whose cells are valid."""
    x, y, yaw = frames.xy[..., 0], frames.xy[..., 1], frames.yaws[:, None, None]
    push = np.sin(8.0 * x + 3.0) * np.cos(9.0 * y) + 0.3 * np.cos(yaw)
    grasp = np.cos(7.0 * x) * np.sin(8.0 * y - 1.0) - 0.2 * np.sin(yaw)
    q = jnp.asarray(np.stack([push, grasp]), jnp.float32)
    return DenseMaps(q=q, logits=10.0 * q, valid=jnp.ones(q.shape, bool))


def test_next_value_ignores_what_is_bare(learner):
    """Claim: a primitive without a valid cell does not count; if neither has one, both do."""
    q = jnp.stack([jnp.full((8, 18, 18), 3.0), jnp.full((8, 18, 18), 1.0)])
    assert q.shape[1:] == learner.frames.xy.shape[:3]
    value = jax.jit(lambda valid: critic.next_value(learner, KEY, DenseMaps(q, q, valid)))
    grasps = jnp.zeros(q.shape, bool).at[Primitive.GRASP].set(True)
    assert_allclose(value(grasps), 1.0, rtol=1e-5)
    assert_allclose(value(~grasps), 3.0, rtol=1e-5)
    assert 1.0 < value(jnp.zeros(q.shape, bool)) <= 3.0


def test_best_grasp():
    """Claim: the largest value over valid grasps, never a push's nor an invalid one's, else 0."""
    q = np.random.default_rng(0).normal(size=(2, 4, 6, 6)).astype(np.float32) - 3.0
    valid = np.random.default_rng(1).uniform(size=q.shape) < 0.2
    q[Primitive.PUSH] += 9.0
    best = max(q[Primitive.GRASP][valid[Primitive.GRASP]])
    state = DenseMaps(jnp.asarray(q), jnp.asarray(q), jnp.asarray(valid))
    assert values.best_grasp(state) == best < 0.0
    assert values.best_grasp(state.replace(valid=jnp.zeros(q.shape, bool))) == 0.0


def test_max_target_is_the_best_valid_cell(learner):
    """Claim: V(s') by `max` is NumPy's maximum over the valid cells of both primitives, the limit
    of the softmax over the map; without a valid cell, over all."""
    own, rng = _changed(learner, target=TargetConfig(value="max")), np.random.default_rng(0)
    valid = rng.uniform(size=(2, 4, 6, 6)) < 0.1
    q = np.where(valid, rng.normal(size=valid.shape), 5.0).astype(np.float32)
    state = DenseMaps(jnp.asarray(q), jnp.asarray(10.0 * q), jnp.asarray(valid))
    assert critic.next_value(own, KEY, state) == q[valid].max()
    assert critic.next_value(own, KEY, state.replace(valid=state.valid & False)) == 5.0


@pytest.mark.parametrize("value", ["max", "softmax"])
def test_a_policy_that_never_pushes_expects_nothing_of_pushes(learner, value):
    """Claim: with `policy.primitive` grasp, V(s') does not change with the map of pushes."""
    grasps = {"explore": {"push_fraction": 0.0}, "policy": {"primitive": "grasp"}}
    own = _changed(learner, target=TargetConfig(value=value), **grasps)
    state = _smooth(learner.frames)
    high = state.replace(q=state.q.at[Primitive.PUSH].add(3.0))
    run = jax.jit(lambda s: critic.next_value(own, KEY, s))
    assert run(state) == run(high) <= float(state.q[Primitive.GRASP].max())


def _largest(state: DenseMaps) -> np.ndarray:
    return np.where(state.valid, state.q, -np.inf).reshape(B, -1).max(axis=1)


def _alone(params: Params, m: int) -> Params:
    """Keeps critic `m` alone."""
    return params.replace(critic=jax.tree.map(lambda leaf: leaf[m : m + 1], params.critic))


def test_decisions_see_the_mean_of_the_critics(learner, observations, randomised):
    """Claim: with `policy.augment` Q is the mean of what each critic says alone, not the lower, and
    valid cells stay. Without it, decisions are by `dense_maps`."""
    twin = _changed(learner, policy={"augment": True}, learn={"critics": 2})
    with jax.numpy_dtype_promotion("standard"):
        params = randomised(actor_critic.init(jax.random.key(0), twin)).online
    obs = observations(2, 4)
    look = jax.jit(lambda params: values.decision_maps(twin, params, obs))
    both, single = look(params), [look(_alone(params, m)) for m in (0, 1)]
    assert_allclose(both.q, 0.5 * (single[0].q + single[1].q), atol=1e-5)
    plain = jax.jit(lambda params: values.dense_maps(twin, params, obs))(params)
    assert_array_equal(both.valid, plain.valid)
    assert np.abs(np.asarray(both.q - plain.q)).max() > 0.05
    off = _changed(twin, policy={"augment": False})
    _same(jax.jit(lambda params: values.decision_maps(off, params, obs))(params), plain)


def test_height_bonus_adds_to_q(learner, state, observations):
    """Claim: `policy.height_bonus` adds itself to Q for each metre of the surface under a cell, in
    decisions and in exploration, between cells too, and changes nothing else."""
    high, frames = _changed(learner, policy={"height_bonus": 3.0}), learner.frames
    size = round(frames.extent / frames.tables.cell)
    step = np.where(np.arange(size) < size // 2, 0.02, 0.08).astype(np.float32)  # along x
    obs = observations(1, 4).replace(height=jnp.broadcast_to(step, (1, size, size)))
    explores = functools.partial(values.decision_maps, explores=True)
    looks = values.dense_maps, values.decision_maps, explores
    plain, *raised = (jax.jit(lambda p, o, f=f: f(high, p, o))(state.online, obs) for f in looks)
    x, outermost = frames.xy[..., 0], np.abs(frames.xy).max(axis=-1)
    sure = (outermost < 0.5 * frames.extent - frames.cell) & (np.abs(x) > frames.cell)
    assert 0.2 < sure.mean() < 0.9
    expected = 3.0 * np.where(x > 0.0, 0.08, 0.02)[sure]
    pose = jnp.array([0.3 * frames.extent, 0.013, 0.4])
    for state in raised:
        got = np.asarray(state.q - plain.q)[0]
        assert_allclose(got[:, sure], np.broadcast_to(expected, (2, sure.sum())), atol=1e-5)
        _same((state.logits, state.valid), (plain.logits, plain.valid))
        between = maps.read(frames, jnp.asarray(got), jnp.int32(1), pose)
        assert_allclose(between, 3.0 * 0.08, atol=1e-5)


@pytest.mark.slow
def test_twin_critics(learner, batch, randomised):
    """Claim: of two critics the maps are the lower value in each cell; each is trained on its own
    loss, towards one target from the lower maps, and they differ from the start."""
    twin = _changed(learner, target=TargetConfig(value="max"), learn={"critics": 2})
    begun = jax.jit(lambda key: actor_critic.init(key, twin))(jax.random.key(0))
    kernels = [leaf for leaf in jax.tree.leaves(begun.online.critic) if leaf.ndim > 3]
    assert all(np.any(leaf[0] != leaf[1]) for leaf in kernels)
    with jax.numpy_dtype_promotion("standard"):
        state = randomised(begun)
    both, *single = (
        _look(learner)(params, batch.next_obs)
        for params in (state.target, *(_alone(state.target, m) for m in (0, 1)))
    )
    assert_allclose(both.q, np.minimum(single[0].q, single[1].q), atol=1e-5)
    assert 0.1 < np.mean(single[0].q < single[1].q) < 0.9

    run, infos = _update(twin), []
    ended = run(state, _ended(batch))[1]
    for m in (0, 1):
        online, target = _alone(state.online, m), _alone(state.target, m)
        fresh = learner.critic_optimiser.init(online.critic)
        one = state.replace(online=online, target=target, critic_optimiser=fresh)
        infos.append(_update(learner)(one, _ended(batch))[1])
    assert_allclose(ended.critic_loss, sum(info.critic_loss for info in infos), rtol=1e-5)
    assert_allclose(ended.error, np.mean([info.error for info in infos], axis=0), atol=1e-5)
    going = run(state, batch)[1].error - ended.error
    gain = twin.cfg.target.gamma * np.clip(_largest(both), *learner.bounds)
    assert_allclose(going, gain, atol=1e-5)


def test_without_an_actor(learner, state, observations):
    """Claim: without an actor the logits are the critic's map, ten to one, and none is updated."""
    own = _changed(learner, learn={"actor": False})
    state_maps = _look(own)(state.online, heightmap.pack(observations(2, 4)))
    assert_allclose(state_maps.logits, 10.0 * state_maps.q, rtol=1e-6)
    after, loss = actor.update(own, state, observations(2, 4))
    _same(after, state)
    assert loss == 0.0


def test_large_batches_are_seen_in_parts(learner, state, observations, monkeypatch):
    """Claim: maps of a batch in three parts of two states are those of the whole batch."""
    obs, seen = observations(B, 3), []
    frames = learner.frames
    whole = values.dense_maps(learner, state.online, obs)
    cells = 2 * (frames.yaws.size // 2) * frames.tables.canvas**2
    monkeypatch.setattr(values, "MOST_CELLS", cells)
    apply = values.networks.apply

    def counted(networks, own, maps):
        seen.append(len(maps))
        return apply(networks, own, maps)

    monkeypatch.setattr(values.networks, "apply", counted)
    parts = values.dense_maps(learner, state.online, obs)
    assert set(seen) == {2}
    jax.tree.map(functools.partial(assert_allclose, atol=1e-5), parts, whole)
