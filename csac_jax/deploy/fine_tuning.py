"""A policy learns from a record of its own actions, see `record`; no scene is simulated.

    policy, summary = fine_tuning.run(CameraPolicy.load("shipped"), Path("record"))

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
from csac_jax.deploy import CameraPolicy, experience, record
from csac_jax.errors import FailedError
from csac_jax.runtime import cache
from csac_jax.runtime.signals import Stop
from csac_jax.training import offline
from csac_jax.training.offline import OfflineState

UPDATES = 10  # of the critic in a step, after which the actor has one (ours)


class Settings(NamedTuple):
    """Settings of the learning."""

    updates: int = 150  # of the critic, rounded up to whole steps
    learning_rate: float = 3e-4  # Adam's step size, critic; the actor's is a third
    batch: int = 16
    seed: int = 0


class FineTuningProgress(NamedTuple):
    """The state of the learning after a step."""

    updates: int
    total: int
    td_error: float  # mean of abs(y - Q) in the step
    seconds: float  # since the first step began


class FineTuningSummary(NamedTuple):
    """The result of the learning."""

    actions: int  # transitions learned from
    lifted: int  # grasps among them that lifted something
    updates: int
    td_error: tuple[float, float]  # of the first step and of the last
    seconds: float
    stopped_by: int | None  # number of the signal; None if all is done


def configure(cfg: Config, settings: Settings, num: int) -> Config:
    """Returns the config of a fine-tuning on `num` transitions.

    They are drawn uniformly: ranks by error would repeat the few whose outcome was luck.
    """
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
    policy: CameraPolicy,
    folder: Path,
    settings: Settings = Settings(),  # noqa: B008, it is immutable
    on_progress: Callable[[FineTuningProgress], None] = lambda _: None,
    stop: Stop | None = None,
) -> tuple[CameraPolicy, FineTuningSummary]:
    """Returns the policy after learning from the record in `folder`, or until `stop`.

    Its config stays. Raises SettingsError for a record that nothing can be learned from,
    FailedError if a loss is not finite.
    """
    cache.enable()
    recorded = experience.load(policy, record.read(folder))
    program = offline.make(configure(policy.cfg, settings, len(recorded.outcome)))
    key, learner = jax.random.key(settings.seed), offline.init(program, policy.params)
    rewarded = experience.transitions(policy, program.learner, learner, recorded)
    state = OfflineState(key, jnp.int32(0), learner, offline.fill(program, rewarded))
    state, errors, seconds = _learn(program, state, on_progress, stop or Stop())
    ends = (errors[0], errors[-1]) if errors else (0.0, 0.0)
    signal = None if stop is None else stop.signal
    lifted = int((recorded.outcome == Outcome.LIFTED).sum())
    done = FineTuningSummary(
        len(recorded.outcome), lifted, len(errors) * UPDATES, ends, seconds, signal
    )
    return dataclasses.replace(policy, params=state.learner.online), done


def _learn(
    program: offline.Program,
    state: OfflineState,
    on_progress: Callable[[FineTuningProgress], None],
    stop: Stop,
) -> tuple[OfflineState, list[float], float]:
    """Runs all steps; returns the state, the TD error of each step, and the seconds."""
    total = program.cfg.train.steps
    errors: list[float] = []
    step = offline.compile_step(program)
    begun = time.perf_counter()
    while len(errors) < total and stop.signal is None:
        state, losses = step(state)
        errors.append(float(losses["td_error"]))
        if not jnp.isfinite(losses["critic_loss"] + losses["actor_loss"]):
            raise FailedError(
                f"the loss is not finite after {len(errors) * UPDATES} updates; lower learning_rate"
            )
        seconds = time.perf_counter() - begun
        on_progress(FineTuningProgress(len(errors) * UPDATES, total * UPDATES, errors[-1], seconds))
    return jax.block_until_ready(state), errors, time.perf_counter() - begun
