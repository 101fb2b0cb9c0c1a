"""Evaluations on the way: the policy of now, in scenes that training never saw.

RUN/evaluations.jsonl   a line per evaluation, its whole table in it
RUN/best/checkpoints/   the state that did best so far; RUN/best is a run's folder like any other

They draw from keys of their own and call programs of their own: what is trained stays the same.
"""

import json
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from csac_jax.agent.learner import Learner
from csac_jax.config import Config
from csac_jax.constants import EVAL_EPISODES, EVAL_SUITE
from csac_jax.errors import DataWarning, SettingsError
from csac_jax.evaluation import policies, rollout, suites
from csac_jax.io import checkpoint, files
from csac_jax.io.checkpoint import CheckpointError
from csac_jax.training import loop
from csac_jax.training.callbacks import Callback, Record, RunInfo

PLAN = "evaluation.json"  # in a run's folder: what a resumed run goes on with
SEED = 1_000_000  # of the evaluations: all meet the same scenes, `eval` others by default
JUDGED = ("completion", "grasp_success")  # what makes a policy best: the first, then the next
Score = tuple[float, ...]  # of JUDGED


class EvalPlan(NamedTuple):
    """When and where the policy of a run is evaluated."""

    every: int  # actions between evaluations; the last chunk has one in any case
    suite: str = EVAL_SUITE
    episodes: int = EVAL_EPISODES  # of every part of the suite

    def check(self) -> None:
        """Raises ValueError for numbers that cannot be, and for an unknown suite."""
        for name, value in (("eval_every", self.every), ("eval_episodes", self.episodes)):
            if value < 1:
                raise ValueError(f"{name}: must be at least 1, not {value}")
        suites.check(self.suite)


class Monitor(Callback):
    """Evaluates a run's policy, keeps the log of it and the best state."""

    def __init__(
        self,
        cfg: Config,
        plan: EvalPlan,
        told: Callback,
        say: Callable[[str], None],
        network: Any = None,
        learner: Learner | None = None,
    ) -> None:
        """Settles the scenes. Args: told, whose `evaluated` is called; say, takes a line about each
        evaluation; network and learner of one's own. Raises ValueError for a suite that does not
        fit the policy."""
        world = rollout.configured(cfg, "auto", cfg.sim.robot)
        self._parts = suites.environments(world, plan.suite, plan.episodes, SEED)
        self._cfg, self._plan, self._told, self._say = cfg, plan, told, say
        self._network, self._learner = network, learner
        self._best: Score = ()
        self._done = 0  # actions before the chunk that comes next

    def begin(self, run: RunInfo) -> None:
        """Goes on with the log and the best state of a run that is resumed."""
        self._run_dir, self._done = run.run_dir, run.step * self._cfg.train.scenes
        files.write_json(run.run_dir / PLAN, self._plan._asdict())
        files.truncate_log(run.run_dir / files.EVALUATIONS, run.step)
        self._best = _best_score(run.run_dir / files.BEST, run.step)

    def chunk(self, record: Record, state: Any) -> None:
        """Evaluates after every so many actions, and after the last chunk."""
        before, self._done = self._done // self._plan.every, record.actions
        last = record.step >= loop.total_steps(self._cfg)
        if record.actions // self._plan.every > before or last:
            self._evaluate(record, state)

    def _evaluate(self, record: Record, state: Any) -> None:
        begun, plan = time.time(), self._plan
        policy = policies.of_state(self._cfg, state.learner, self._network, self._learner)
        table = rollout.measure(policy, self._parts, plan.episodes, SEED, None)
        score = score_of(table)
        if best := score > self._best:
            self._best, place = score, self._run_dir / files.BEST
            kept = {"seconds": record.seconds, "grasps": [], "score": score}
            checkpoint.save(place, record.step, state, self._cfg, kept)
        self._log(record, round(time.time() - begun, 3), score, best, table)
        values = [f"{name} {value:.1%}" for name, value in zip(JUDGED, score, strict=True)]
        said = f"evaluated on {plan.suite} at {record.actions} actions: {', '.join(values)}"
        self._say(said.replace("_", " ") + ", the best so far" * best)
        self._told.evaluated(record, table)

    def _log(
        self, record: Record, seconds: float, score: Score, best: bool, table: dict[str, Any]
    ) -> None:
        """Adds a line to the log; it has what `files.read_log` asks of every line."""
        line = {
            "step": record.step,
            "actions": record.actions,
            "seconds": seconds,
            "grasps_counted": sum(part["counts"]["grasps"] for part in _parts(table)),
            **dict(zip(JUDGED, score, strict=True)),
            "best": best,
            "suite": self._plan.suite,
            "table": table,
        }
        with (self._run_dir / files.EVALUATIONS).open("a") as log:
            log.write(json.dumps(line) + "\n")


def _best_score(folder: Path, step: int) -> Score:
    """The score of the best state up to a step; later ones are set aside, and damaged ones."""
    checkpoint.set_aside_after(folder, step)
    if checkpoint.latest_step(folder) is None:
        return ()
    try:
        return tuple(checkpoint.load_extra(folder)["score"])
    except CheckpointError as error:
        warnings.warn(f"{error}; the next evaluation is the best", DataWarning, stacklevel=2)
    checkpoint.set_aside_after(folder, -1)
    return ()


def score_of(table: dict[str, Any]) -> Score:
    """What policies are ranked by: means over the parts of the suite, without cases 0."""
    parts = _parts(table)
    return tuple(sum(part[name]["value"] or 0.0 for part in parts) / len(parts) for name in JUDGED)


def read_plan(run_dir: Path) -> EvalPlan | None:
    """How a run was evaluated on its way; None if it was not. Raises SettingsError."""
    path = run_dir / PLAN
    if not path.exists():
        return None
    try:
        plan = EvalPlan(**files.read_object(path))
        plan.check()
    except (TypeError, ValueError) as error:
        fault = files.first_line(error)
        raise SettingsError(
            f"{path} is damaged ({fault}); remove it, or give --eval-every"
        ) from None
    return plan


def _parts(table: dict[str, Any]) -> list[dict[str, Any]]:
    return list(table["parts"].values()) if "parts" in table else [table]
