"""A small training step that compiles fast and uses every number of a config."""

from typing import Any

import jax
import jax.numpy as jnp

from csac_jax import presets
from csac_jax.agent import actor_critic, explore, losses, maps, rewards
from csac_jax.agent.csac import CSAC
from csac_jax.config import Config
from csac_jax.nets import networks
from csac_jax.replay import samplers
from csac_jax.training import sharding
from csac_jax.training.programs import Hyperparams, replace_hyperparams
from csac_jax.training.step import Program, TrainState
from csac_jax.training.transitions import StepMetrics
from tests.metrics import step_metrics

SCENES = 8
CFG = presets.smoke().change(train={"scenes": SCENES, "actions": 12 * SCENES})  # 3 chunks of 4


def program(cfg: Config = CFG, env: Any = None, *_: Any, **__: Any) -> Program:
    """Stands in for `programs.make`: without environment and networks."""
    bounds = rewards.bounds(cfg.reward, cfg.target.gamma)
    frames = maps.frames(cfg, networks.make(cfg.net))
    learner = CSAC(actor_critic.with_optimisers(cfg, frames, bounds))
    return Program(cfg, env, learner, samplers.make(cfg.replay))


def init_state(
    program: Program, key: jax.Array, hyperparams: Hyperparams | None = None
) -> TrainState:
    """Stands in for `programs.init_state`: scenes [E], networks [3], a ring [4]."""
    program = replace_hyperparams(program, hyperparams)
    params = jax.random.normal(jax.random.fold_in(key, 1), (3,))
    learner = {
        "online": params,
        "target": params,
        "optimiser": program.learner.parts.critic_optimiser.init(params),
        "actor": program.learner.parts.actor_optimiser.init(params),
    }
    scenes = jax.random.uniform(jax.random.fold_in(key, 2), (program.cfg.train.scenes,))
    return TrainState(key, jnp.int32(0), scenes, learner, jnp.zeros(4))


def train_step(program: Program, state: TrainState) -> tuple[TrainState, StepMetrics]:
    """Stands in for `step.train_step`: physics, a batch, a gradient, a branch by the step."""
    cfg, learner = program.cfg, program.learner.parts
    num = cfg.train.scenes
    key = jax.random.fold_in(state.key, state.step)
    noise = jax.random.normal(key, (num,))
    move = sharding.map_scenes(program.mesh, lambda scenes, noise: jnp.sin(scenes + noise))
    scenes = move(state.scenes, noise)
    batch = sharding.shard_batch(program.mesh, scenes)

    def loss(params: jax.Array) -> jax.Array:
        q = params[0] * batch + params[1] * batch**2 + params[2]
        target = losses.td_target(
            batch, cfg.target.gamma, batch > 0.9, jnp.clip(0.5 * q, *learner.bounds)
        )
        return jnp.mean(losses.td_loss(cfg.learn, target - q))

    critic_loss, gradient = jax.value_and_grad(loss)(state.learner["online"])
    change, optimiser = learner.critic_optimiser.update(50.0 * gradient, state.learner["optimiser"])
    slow, actor = learner.actor_optimiser.update(gradient, state.learner["actor"])
    online = state.learner["online"] + change + slow
    target = losses.update_target(cfg.learn, online, state.learner["target"])
    replay = jax.lax.cond(
        state.step < 2, lambda ring: ring, lambda ring: ring.at[0].add(1.0), state.replay
    )
    seen = numbers(program, jax.random.fold_in(key, 1), state.step)
    primitive = (noise > -1.0).astype(jnp.int32)
    outcome = jnp.clip(jnp.floor(5.0 * jnp.abs(scenes)), 0.0, 4.0).astype(jnp.int32)
    metrics = step_metrics(
        num,
        primitive=primitive,
        outcome=outcome,
        reward=scenes + jnp.mean(seen),
        learned=state.step >= 1,
        critic_loss=critic_loss,
        actor_loss=jnp.sum(target),
        td_error=jnp.sum(online),
        q_mean=seen,
        finite=jnp.isfinite(online).all(),
    )
    learner_state = {"online": online, "target": target, "optimiser": optimiser, "actor": actor}
    return TrainState(state.key, state.step + 1, scenes, learner_state, replay), metrics


def numbers(program: Program, key: jax.Array, step: jax.Array) -> jax.Array:
    """Returns numbers [n] that depend on every setting that the losses above do not use."""
    cfg, (low, high) = program.cfg, program.learner.parts.bounds
    key_noise, key_push = jax.random.split(key)
    share = step.astype(jnp.float32) / 10.0
    outcomes = jnp.arange(5, dtype=jnp.int32)

    def reward(primitive: int, outcome: Any, distance: Any, gain: float, lost: int) -> jax.Array:
        numbers = jnp.int32(outcome), jnp.float32(distance), jnp.float32(0.0), jnp.float32(gain)
        changed, lost = jnp.array(True), jnp.int32(lost)
        result = rewards.ActionResult(jnp.int32(primitive), *numbers, changed, lost)
        return rewards.reward(cfg.reward, result)

    grasps = jax.vmap(lambda outcome: reward(1, outcome, 0.4, 0.0, 1))(outcomes)
    pushes = [reward(0, 0, 0.0, gain, 0) for gain in (0.05, 0.5)]
    ex = cfg.explore
    chances = [
        explore.probability(start, end, ex.epsilon_decay, 100 * step)
        for start, end in (ex.epsilon_primitive, ex.epsilon_place)
    ]
    noisy = explore.action_noise(key_noise, ex, jnp.zeros(3))
    pushed = jax.random.bernoulli(key_push, ex.push_fraction, (32,)).astype(jnp.float32).mean()
    ranked = cfg.replay.sampler == "beta"
    a, b = samplers.beta_schedule(cfg.replay, share) if ranked else (share, share)
    scalars = [*pushes, *chances, pushed, a, b]
    scalars += [cfg.target.inverse_temperature / (high - low) * jnp.float32(1.0)]
    return jnp.concatenate([jnp.stack(scalars), grasps, noisy])
