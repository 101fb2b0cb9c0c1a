"""Updates of critic and actor, by what they report and change."""

import dataclasses

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
from csac_jax.sim.primitives import Action
from csac_jax.vision import heightmap
from tests.agent.reference import exact_softmax
from tests.sections import with_constants

pytestmark = pytest.mark.optax
B = 6


@pytest.fixture(scope="module")
def state(learner, randomised) -> LearnerState:
    """Random online networks, and others as targets."""
    with jax.numpy_dtype_promotion("standard"):
        return randomised(jax.jit(lambda key: actor_critic.init(key, learner))(jax.random.key(0)))


@pytest.fixture(scope="module")
def batch(observations) -> Transition:
    """B transitions: actions of both primitives anywhere in the workspace and at yaws all round;
    none terminated."""
    rng = np.random.default_rng(5)
    pose = np.concatenate(
        [rng.uniform(-0.2, 0.2, (B, 2)), rng.uniform(0.0, 2.0 * np.pi, (B, 1))], axis=1
    )
    return Transition(
        obs=heightmap.pack(observations(B, 1)),
        action=Action(
            primitive=jnp.arange(B, dtype=jnp.int32) % 2, pose=jnp.asarray(pose, jnp.float32)
        ),
        reward=jnp.asarray(rng.uniform(-1.0, 2.0, B), jnp.float32),
        next_obs=heightmap.pack(observations(B, 2)),
        terminated=jnp.zeros(B, bool),
    )


@pytest.fixture(scope="module")
def update(learner):
    """(state, batch, weights, all 1 if not given) -> state, info of one update of the critic."""

    @jax.jit
    def one(state, batch, weights):
        return critic.update(jax.random.key(3), learner, state, batch, weights)

    return lambda state, batch, weights=None: one(
        state, batch, jnp.ones(B) if weights is None else weights
    )


def _ended(batch: Transition) -> Transition:
    return batch.replace(terminated=jnp.ones_like(batch.terminated))


def _constant(params: Params, value: float) -> Params:
    """The same networks, whose every map is `value`: all is 0 but the bias of the outputs."""
    zero = jax.tree.map(jnp.zeros_like, params.critic)
    is_bias = lambda leaf: leaf.shape[1:] == (dense.OUTPUTS,)  # noqa: E731  (axis 0 is the critics')
    constant = jax.tree.map(
        lambda leaf: jnp.full_like(leaf, value) if is_bias(leaf) else leaf, zero
    )
    return params.replace(critic=constant)


@pytest.mark.slow
def test_value_in_the_loss_is_that_of_the_maps(learner, state, batch, update):
    """Claim: Q(s, a) of the loss, from two passes, is the dense maps of the same parameters read at
    the action.

    Where everything ends the target is the reward, so that the error tells Q. Both primitives,
    poses all over.
    """
    look = jax.jit(lambda params, obs: values.dense_maps(learner, params, heightmap.unpack(obs)).q)
    read = jax.jit(jax.vmap(lambda q, p, pose: maps.read(learner.frames, q, p, pose)))
    q = look(state.online, batch.obs)
    rng = np.random.default_rng(0)
    for trial in range(12):
        pose = np.concatenate(
            [rng.uniform(-0.224, 0.224, (B, 2)), rng.uniform(0.0, 2.0 * np.pi, (B, 1))], axis=1
        )
        action = Action(
            primitive=(batch.action.primitive + trial) % 2, pose=jnp.asarray(pose, jnp.float32)
        )
        tried = _ended(batch).replace(action=action)
        got = tried.reward - update(state, tried)[1].error
        assert_allclose(got, read(q, action.primitive, action.pose), atol=2e-5)
    assert np.std(q) > 0.05


def test_update_reports_its_loss(learner, state, batch, update):
    """Claim: the loss is the mean Huber loss of the errors, `q` the mean value; an update is
    counted."""
    after, info = update(state, batch)
    width = learner.cfg.learn.huber
    assert_allclose(info.critic_loss, np.mean(optax.huber_loss(info.error, delta=width)), rtol=1e-5)
    ended = update(state, _ended(batch))[1]
    assert_allclose(ended.q, np.mean(batch.reward - ended.error), atol=1e-6)
    assert after.updates == state.updates + 1


def test_losses_are_weighted(learner, state, batch, update):
    """Claim: the loss is mean(weight * Huber loss), and a transition of weight 0 changes no
    network; errors and q are those of the transitions, whatever their weights."""
    weights = jnp.array([0.0, 0.25, 1.0, 0.5, 0.0, 1.0])
    after, info = update(state, batch, weights)
    loss = optax.huber_loss(info.error, delta=learner.cfg.learn.huber)
    assert_allclose(info.critic_loss, np.mean(np.asarray(weights) * np.asarray(loss)), rtol=1e-5)
    _, plain = update(state, batch)
    assert_array_equal(info.error, plain.error)
    assert_array_equal(info.q, plain.q)
    other, _ = update(
        state, batch.replace(reward=batch.reward.at[jnp.array([0, 4])].add(3.0)), weights
    )
    jax.tree.map(assert_array_equal, after.online, other.online)


@pytest.mark.slow
def test_target_carries_no_gradient(learner, state, batch):
    """Claim: the critic's loss has exactly no gradient in the target networks and the reward, but
    one in its own."""

    def loss(online, target, reward):
        before = state.replace(online=online, target=target)
        seen = batch.replace(reward=reward)
        return critic.update(jax.random.key(3), learner, before, seen, jnp.ones(B))[1].critic_loss

    gradient = jax.jit(jax.grad(loss, argnums=(0, 1, 2)))(state.online, state.target, batch.reward)
    online, target, reward = gradient
    for leaf in jax.tree.leaves((target, reward, online.actor)):
        assert_array_equal(leaf, 0.0)
    assert all(np.any(np.asarray(leaf) != 0.0) for leaf in jax.tree.leaves(online.critic))


def test_critic_gradient_is_that_of_its_loss(learner, state, batch):
    """Claim: along the gradient, the reported loss changes as fast as finite differences say."""
    plain = dataclasses.replace(learner, critic_optimiser=optax.sgd(1.0))
    weights = jnp.linspace(0.2, 1.0, B)
    run = jax.jit(
        lambda state: critic.update(jax.random.key(3), plain, state, _ended(batch), weights)
    )
    after, _ = run(state)
    gradient = jax.tree.map(jnp.subtract, state.online.critic, after.online.critic)

    def loss(critic):
        return run(state.replace(online=state.online.replace(critic=critic)))[1].critic_loss

    _check_slope(loss, state.online.critic, gradient)


def _check_slope(loss, params, gradient, relative: float = 1e-2, step: float = 2e-3) -> None:
    """Along the gradient g, scaled to the unit vector g / |g|, the slope is |g|."""
    size = float(optax.tree.norm(gradient))
    assert size > 1e-4
    above, below = (
        loss(jax.tree.map(lambda p, g, s=sign: p + s * step / size * g, params, gradient))
        for sign in (1.0, -1.0)
    )
    assert_allclose((above - below) / (2.0 * step), size, rtol=relative)


def test_actor_gradient_is_that_of_its_loss(learner, state, observations):
    """Claim: the policy gradient through the interpolated map is that of finite differences, to 1
    in 1000.

    The scenes are some in which no highest cell gives way to another within the step: there the
    pose jumps. The step is so long that float32's rounding of the loss, 1e-8, is 1e-5 of the slope.
    """
    plain = dataclasses.replace(learner, actor_optimiser=optax.sgd(1.0))
    run = jax.jit(lambda state: actor.update(plain, state, observations(B, 4)))
    after, _ = run(state)
    gradient = jax.tree.map(jnp.subtract, state.online.actor, after.online.actor)
    _check_slope(
        lambda actor: run(state.replace(online=state.online.replace(actor=actor)))[1],
        state.online.actor,
        gradient,
        relative=1e-3,
        step=1.6e-2,
    )


def test_actor_climbs_the_critic(learner, state, batch):
    """Claim: updates of the actor raise Q(s, mu(s)) and leave the critic and both targets as they
    are."""
    run = jax.jit(lambda state: actor.update(learner, state, heightmap.unpack(batch.obs)))

    @jax.jit
    def value(online: Params) -> jax.Array:
        """Mean of Q(s, mu(s)) over states and primitives."""
        seen = values.dense_maps(learner, online, heightmap.unpack(batch.obs))
        poses = [
            jax.vmap(lambda one, p=p: actor.pose(learner.frames, one, p))(seen) for p in Primitive
        ]
        read = jax.vmap(maps.read, (None, 0, None, 0))
        return jnp.mean(
            jnp.stack([read(learner.frames, seen.q, jnp.int32(p), poses[p]) for p in Primitive])
        )

    current, first = run(state)
    for _ in range(60):
        current, _ = run(current)
    assert_allclose(first, -value(state.online), atol=1e-6)
    assert value(current.online) > value(state.online) + 0.004
    for name in ("critic_optimiser", "target", "updates"):
        jax.tree.map(assert_array_equal, getattr(current, name), getattr(state, name))
    jax.tree.map(assert_array_equal, current.online.critic, state.online.critic)


def test_updates_lower_the_loss(state, batch, update):
    """Claim: on one batch with fixed targets, 120 updates of the critic take away half of the
    squared error."""
    current = state
    losses = []
    for _ in range(120):
        current, info = update(current, _ended(batch))
        losses.append(float(jnp.mean(info.error**2)))
    assert losses[-1] < 0.5 * losses[0]
    jax.tree.map(assert_array_equal, current.online.actor, state.online.actor)


def test_target_moves_by_tau(learner, state, batch, update):
    """Claim: theta' = tau theta + (1 - tau) theta' with the networks after the step, of critic and
    actor."""
    after, _ = update(state, batch)
    tau = learner.cfg.learn.tau
    wanted = jax.tree.map(
        lambda new, old: tau * new + (1.0 - tau) * old, after.online, state.target
    )
    jax.tree.map(lambda got, want: assert_allclose(got, want, atol=1e-7), after.target, wanted)
    moved = jax.tree.map(
        lambda new, old: float(np.abs(new - old).max()), after.online.critic, state.online.critic
    )
    assert all(change > 0.0 for change in jax.tree.leaves(moved))


@pytest.mark.parametrize("value", [1.5, 100.0, -100.0])
def test_bootstrap(learner, state, batch, update, value):
    """Claim: y = r + gamma V(s') by the target critic, V kept within the possible returns; y = r
    after a true end."""
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
    q = jnp.asarray(
        np.stack([push, np.cos(7.0 * x) * np.sin(8.0 * y - 1.0) - 0.2 * np.sin(yaw)]), jnp.float32
    )
    return DenseMaps(q=q, logits=10.0 * q, valid=jnp.ones(q.shape, bool))


def _changed(learner: ActorCritic, **sections) -> ActorCritic:
    """The same learner with other sections."""
    return dataclasses.replace(learner, cfg=learner.cfg.change(**sections))


@pytest.mark.slow
def test_next_value_lies_within_the_map(learner):
    """Claim: the softmax value is never outside of the map's values, grows with the inverse
    temperature, and comes near the largest value."""
    state = _smooth(learner.frames)
    low, high = float(state.q.min()), float(state.q.max())
    means = []
    for beta in (0.0, 1e5):
        target = with_constants(TargetConfig(), samples=256, inverse_temperature=beta)
        own = _changed(learner, target=target)
        run = jax.jit(jax.vmap(lambda key, own=own: critic.next_value(own, key, state)))
        values = np.asarray(run(jax.random.split(jax.random.key(1), 16)))
        assert np.all((values >= low) & (values <= high))
        means.append(values.mean())
    assert means[0] < means[1] - 0.2
    assert high - means[1] < 0.05 * (high - low)


@pytest.mark.slow
def test_inverse_temperature_follows_the_range_of_q(learner):
    """Claim: ten times the rewards at ten times the range give ten times the softmax value, and
    twice the inverse temperature at twice the range gives the same."""
    state = _smooth(learner.frames)
    cfg = learner.cfg.target

    def value(q_scale: float, beta_scale: float, bounds: tuple[float, float]) -> float:
        beta = beta_scale * cfg.inverse_temperature
        own = _changed(learner, target=with_constants(cfg, inverse_temperature=beta))
        own = dataclasses.replace(own, bounds=bounds)
        scaled = state.replace(q=q_scale * state.q)
        run = jax.jit(lambda key: critic.next_value(own, key, scaled))
        return float(run(jax.random.key(1)))

    plain = value(1.0, 1.0, (-2.0, 4.0))
    assert abs(plain) > 0.1
    assert_allclose(value(10.0, 1.0, (-20.0, 40.0)), 10.0 * plain, rtol=1e-5)
    assert_allclose(value(1.0, 2.0, (-4.0, 8.0)), plain, rtol=1e-6)


def test_next_value_ignores_what_is_bare(learner):
    """Claim: a primitive with nothing to act on does not count, whatever its map; if neither has,
    both do."""
    q = jnp.stack([jnp.full((8, 18, 18), 3.0), jnp.full((8, 18, 18), 1.0)])
    assert q.shape[1:] == learner.frames.xy.shape[:3]
    value = jax.jit(
        lambda valid: critic.next_value(learner, jax.random.key(0), DenseMaps(q, q, valid))
    )
    grasps = jnp.zeros(q.shape, bool).at[Primitive.GRASP].set(True)
    assert_allclose(value(grasps), 1.0, rtol=1e-5)
    assert_allclose(value(~grasps), 3.0, rtol=1e-5)
    assert 1.0 < value(jnp.zeros(q.shape, bool)) <= 3.0


def test_best_grasp():
    """Claim: the largest value over valid grasps, never a push's nor an invalid one's; 0 if nothing
    can be grasped."""
    q = np.random.default_rng(0).normal(size=(2, 4, 6, 6)).astype(np.float32) - 3.0
    valid = np.random.default_rng(1).uniform(size=q.shape) < 0.2
    q[Primitive.PUSH] += 9.0
    best = max(q[Primitive.GRASP][valid[Primitive.GRASP]])
    state = DenseMaps(jnp.asarray(q), jnp.asarray(q), jnp.asarray(valid))
    assert values.best_grasp(state) == best < 0.0
    assert values.best_grasp(state.replace(valid=jnp.zeros(q.shape, bool))) == 0.0


def _run(learner: ActorCritic):
    return jax.jit(
        lambda state, batch: critic.update(jax.random.key(3), learner, state, batch, jnp.ones(B))
    )


def _random_maps(shape, seed: int = 0) -> DenseMaps:
    """Random maps of which a tenth is valid; what is not is worth more."""
    rng = np.random.default_rng(seed)
    valid = rng.uniform(size=shape) < 0.1
    q = np.where(valid, rng.normal(size=shape), 5.0).astype(np.float32)
    return DenseMaps(jnp.asarray(q), jnp.asarray(10.0 * q), jnp.asarray(valid))


def test_max_target_is_the_best_valid_cell(learner):
    """Claim: V(s') by `max` is NumPy's maximum over the valid cells of both primitives, the limit
    of the softmax over the map; without a valid cell, over all."""
    own, state = _changed(learner, target=TargetConfig(value="max")), _random_maps((2, 4, 6, 6))
    best = np.asarray(state.q)[np.asarray(state.valid)].max()
    assert critic.next_value(own, jax.random.key(0), state) == best
    assert_allclose(exact_softmax(state.q, 1e6, state.valid), best, rtol=1e-6)
    assert (
        critic.next_value(
            own, jax.random.key(0), state.replace(valid=jnp.zeros(state.q.shape, bool))
        )
        == 5.0
    )


@pytest.mark.parametrize("value", ["max", "softmax"])
def test_a_policy_that_never_pushes_expects_nothing_of_pushes(learner, value):
    """Claim: with `policy.primitive` grasp, V(s') does not change with the map of pushes."""
    own = _changed(
        learner,
        target=TargetConfig(value=value),
        explore={"push_fraction": 0.0},
        policy={"primitive": "grasp"},
    )
    state = _smooth(learner.frames)
    high = state.replace(q=state.q.at[Primitive.PUSH].add(3.0))
    run = jax.jit(lambda s: critic.next_value(own, jax.random.key(0), s))
    assert run(state) == run(high) <= float(state.q[Primitive.GRASP].max())


def test_max_target_reaches_the_update(learner, state, batch, update):
    """Claim: y = r + gamma max Q'(s', .), by NumPy from the target critic's maps."""
    own = _changed(learner, target=TargetConfig(value="max", gamma=0.5))
    seen = jax.jit(lambda params, obs: values.dense_maps(learner, params, heightmap.unpack(obs)))(
        state.target, batch.next_obs
    )
    best = np.where(seen.valid, seen.q, -np.inf).reshape(B, -1).max(axis=1)
    going, ended = _run(own)(state, batch)[1].error, update(state, _ended(batch))[1].error
    assert_allclose(going - ended, 0.5 * np.clip(best, *learner.bounds), atol=1e-5)


@pytest.mark.slow
def test_squared_loss_reaches_the_update(learner, state, batch):
    """Claim: with `squared` the loss is the mean of the squared errors, line 21."""
    info = _run(_changed(learner, learn={"loss": "squared"}))(state, batch)[1]
    assert_allclose(info.critic_loss, np.mean(np.asarray(info.error) ** 2), rtol=1e-5)


def _one(params: Params, m: int) -> Params:
    """The networks with critic `m` alone."""
    return params.replace(critic=jax.tree.map(lambda leaf: leaf[m : m + 1], params.critic))


def test_decisions_see_the_mean_of_the_critics(learner, observations, randomised):
    """Claim: with `policy.augment` Q is the mean of what each critic says alone, not the lower; its
    maps are where and what `dense_maps` are besides. Without, they are `dense_maps`."""
    twin = _changed(learner, policy={"augment": True}, learn={"critics": 2})
    with jax.numpy_dtype_promotion("standard"):
        params = randomised(actor_critic.init(jax.random.key(0), twin)).online
    obs = observations(2, 4)
    look = jax.jit(lambda params: values.decision_maps(twin, params, obs))
    both, single = look(params), [look(_one(params, m)) for m in (0, 1)]
    assert_allclose(both.q, 0.5 * (single[0].q + single[1].q), atol=1e-5)
    plain = jax.jit(lambda params: values.dense_maps(twin, params, obs))(params)
    assert_array_equal(both.valid, plain.valid)
    assert np.abs(np.asarray(both.q - plain.q)).max() > 0.05
    off = _changed(twin, policy={"augment": False})
    same = jax.jit(lambda params: values.decision_maps(off, params, obs))(params)
    jax.tree.map(assert_array_equal, same, plain)


@pytest.mark.parametrize("kind", ["small", "offset"])
def test_height_bonus_adds_to_q(learner, observations, randomised, kind):
    """Claim: `policy.height_bonus` adds itself to Q for each metre of the surface under a cell, in
    decisions and in exploration, between cells too, and changes nothing besides."""
    cfg = learner.cfg.change(policy={"height_bonus": 3.0}, net={"kind": kind})
    high = actor_critic.make(cfg)
    with jax.numpy_dtype_promotion("standard"):
        params = randomised(actor_critic.init(jax.random.key(0), high)).online
    frames = high.frames
    size = round(frames.extent / frames.tables.cell)
    step = np.where(np.arange(size) < size // 2, 0.02, 0.08).astype(np.float32)  # along x
    obs = observations(1, 4).replace(height=jnp.broadcast_to(step, (1, size, size)))
    looks = values.dense_maps, values.decision_maps, values.exploration_maps
    plain, *raised = (jax.jit(lambda p, o, f=f: f(high, p, o))(params, obs) for f in looks)
    x, outermost = frames.xy[..., 0], np.abs(frames.xy).max(axis=-1)
    sure = (outermost < 0.5 * frames.extent - frames.cell) & (np.abs(x) > frames.cell)
    expected = 3.0 * np.where(x > 0.0, 0.08, 0.02)[sure]
    assert 0.2 < sure.mean() < 0.9
    pose = jnp.array([0.3 * frames.extent, 0.013, 0.4])
    for state in raised:
        got = np.asarray(state.q - plain.q)[0][:, sure]
        assert_allclose(got, np.broadcast_to(expected, got.shape), atol=1e-5)
        assert_array_equal(state.logits, plain.logits)
        assert_array_equal(state.valid, plain.valid)
        between = [
            maps.read_q(frames, jax.tree.map(lambda leaf: leaf[0], one), jnp.int32(1), pose)
            for one in (state, plain)
        ]
        assert_allclose(between[0] - between[1], 3.0 * 0.08, atol=1e-5)


@pytest.mark.slow
def test_twin_critics(learner, batch, randomised):
    """Claim: of two critics the maps are the lower value in each cell; each is trained on its own
    loss, towards one target from the lower maps, and they differ from the start."""
    twin = _changed(learner, target=TargetConfig(value="max"), learn={"critics": 2})
    begun = jax.jit(lambda key: actor_critic.init(key, twin))(jax.random.key(0))
    assert all(
        np.any(leaf[0] != leaf[1]) for leaf in jax.tree.leaves(begun.online.critic) if leaf.ndim > 3
    )
    with jax.numpy_dtype_promotion("standard"):
        state = randomised(begun)
    look = jax.jit(
        lambda params: values.dense_maps(learner, params, heightmap.unpack(batch.next_obs))
    )
    both, single = look(state.target), [look(_one(state.target, m)) for m in (0, 1)]
    assert_allclose(both.q, np.minimum(single[0].q, single[1].q), atol=1e-5)
    assert 0.1 < np.mean(single[0].q < single[1].q) < 0.9

    run, alone = _run(twin), _run(learner)
    ended = run(state, _ended(batch))[1]
    infos = [alone(_alone(learner, state, m), _ended(batch))[1] for m in (0, 1)]
    assert_allclose(ended.critic_loss, sum(info.critic_loss for info in infos), rtol=1e-5)
    assert_allclose(ended.error, np.mean([info.error for info in infos], axis=0), atol=1e-5)
    best = np.where(both.valid, both.q, -np.inf).reshape(B, -1).max(axis=1)
    going = run(state, batch)[1].error - ended.error
    assert_allclose(going, twin.cfg.target.gamma * np.clip(best, *learner.bounds), atol=1e-5)


def _alone(learner: ActorCritic, state: LearnerState, m: int) -> LearnerState:
    """The state of a learner with critic `m` alone; its optimiser is fresh."""
    online, target = _one(state.online, m), _one(state.target, m)
    return state.replace(
        online=online, target=target, critic_optimiser=learner.critic_optimiser.init(online.critic)
    )


def test_without_an_actor(learner, state, observations):
    """Claim: without an actor the logits are the critic's map, ten to one, and an update of the
    actor is none."""
    own = _changed(learner, learn={"actor": False})
    seen = jax.jit(lambda obs: values.dense_maps(own, state.online, obs))(observations(2, 4))
    assert_allclose(seen.logits, 10.0 * seen.q, rtol=1e-6)
    after, loss = actor.update(own, state, observations(2, 4))
    jax.tree.map(assert_array_equal, after, state)
    assert loss == 0.0
