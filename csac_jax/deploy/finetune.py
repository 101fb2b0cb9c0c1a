"""A policy that learns from a record of its own actions, see `record`; no scene is simulated.

    policy, summary = finetune.run(Policy.load("shipped"), Path("record"))

The learner's modules need MuJoCo installed.
"""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp

from csac_jax.config import Config, UniformReplay
from csac_jax.constants import Outcome
from csac_jax.deploy import Policy, experience, record
from csac_jax.errors import FailedError
from csac_jax.runtime import cache
from csac_jax.runtime.signals import Stop
from csac_jax.training import offline
from csac_jax.training.offline import OfflineState

UPDATES = 10  # of the critic in a step, after which the actor has one (ours)


class Settings(NamedTuple):
    """How a record is learned from."""

    updates: int = 150  # of the critic, rounded up to whole steps
    learning_rate: float = 3e-4  # Adam's step size, critic; the actor's is a third
    batch: int = 16
    seed: int = 0


class Progress(NamedTuple):
    """After a step."""

    updates: int
    total: int
    td_error: float  # mean of abs(y - Q) in the step
    seconds: float  # since the first step began


class Summary(NamedTuple):
    """What was done."""

    actions: int  # transitions learned from
    lifted: int  # grasps among them that lifted something
    updates: int
    td_error: tuple[float, float]  # of the first step and of the last
    seconds: float
    stopped_by: int | None  # number of the signal; None if all is done


def configure(cfg: Config, settings: Settings, num: int) -> Config:
    """The config of a fine-tuning on `num` transitions. They are drawn uniformly: ranks by error
    would repeat the few whose outcome was luck."""
    steps = -(-settings.updates // UPDATES)
    learn = {
        "learning_rate": settings.learning_rate,
        "actor_learning_rate": settings.learning_rate / 3.0,
        "batch": settings.batch,
        "actor_batch": 0,
        "updates": UPDATES,
    }
    train = {"scenes": 1, "actions": steps, "learning_starts": settings.batch}
    small = cfg.change(learn=learn, train=train)
    return dataclasses.replace(small, replay=UniformReplay(capacity=max(num, settings.batch)))


def run(
    policy: Policy,
    folder: Path,
    settings: Settings = Settings(),  # noqa: B008, it is immutable
    progress: Callable[[Progress], None] = lambda _: None,
    stop: Stop | None = None,
) -> tuple[Policy, Summary]:
    """The policy after learning from the record in `folder`, or until `stop`; its config stays.

    Raises SettingsError for a record that nothing can be learned from, FailedError where a loss is
    not finite.
    """
    cache.enable()
    found = experience.load(policy, record.read(folder))
    program = offline.make(configure(policy.cfg, settings, len(found.outcome)))
    key, learner = jax.random.key(settings.seed), offline.init(program, policy.params)
    rewarded = experience.transitions(policy, program.learner, learner, found)
    state = OfflineState(key, jnp.int32(0), learner, offline.fill(program, rewarded))
    state, errors, seconds = _learn(program, state, progress, stop or Stop())
    ends = (errors[0], errors[-1]) if errors else (0.0, 0.0)
    signal = None if stop is None else stop.signal
    lifted = int((found.outcome == Outcome.LIFTED).sum())
    done = Summary(len(found.outcome), lifted, len(errors) * UPDATES, ends, seconds, signal)
    return dataclasses.replace(policy, params=state.learner.online), done


def _learn(
    program: offline.Program, state: OfflineState, progress: Callable[[Progress], None], stop: Stop
) -> tuple[OfflineState, list[float], float]:
    """The state after all steps, the TD error of each, and the seconds that they took."""
    total = program.cfg.train.steps
    errors: list[float] = []
    one = offline.compile_step(program)
    begun = time.perf_counter()
    while len(errors) < total and stop.signal is None:
        state, losses = one(state)
        errors.append(float(losses["td_error"]))
        if not jnp.isfinite(losses["critic_loss"] + losses["actor_loss"]):
            raise FailedError(
                f"the loss is not finite after {len(errors) * UPDATES} updates; "
                "lower --learning-rate"
            )
        seconds = time.perf_counter() - begun
        progress(Progress(len(errors) * UPDATES, total * UPDATES, errors[-1], seconds))
    return jax.block_until_ready(state), errors, time.perf_counter() - begun
