"""Evaluations during training: the current policy, in scenes that training never saw.

RUN/evaluations.jsonl   a line per evaluation, its whole table in it
RUN/best/checkpoints/   the state that did best so far; RUN/best is a run's folder like any other

Evaluations have their own keys and programs: they do not change what is trained.
"""

import json
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from csac_jax.config import Config
from csac_jax.constants import EVAL_EPISODES, EVAL_SUITE
from csac_jax.errors import DataWarning, SettingsError
from csac_jax.evaluation import rollout, suites
from csac_jax.evaluation.policies import Policy
from csac_jax.io import checkpoint, files
from csac_jax.section import require
from csac_jax.training import loop
from csac_jax.training.callbacks import Callback, Record, RunInfo

PLAN = "evaluation.json"  # in a run's folder, for a resumed run
SEED = 1_000_000  # of the evaluations: all meet the same scenes, `eval` others by default
JUDGED = ("completion", "grasp_success")  # what makes a policy best: the first, then the next
Score = tuple[float, ...]  # of JUDGED


class EvalPlan(NamedTuple):
    """A plan of evaluations during a run."""

    every: int  # actions between evaluations; the last chunk has one in any case
    suite: str = EVAL_SUITE
    episodes: int = EVAL_EPISODES  # of every part of the suite

    def check(self) -> None:
        """Raises SettingsError for numbers that cannot be, and for an unknown suite."""
        for name, value in (("eval_every", self.every), ("eval_episodes", self.episodes)):
            require(value >= 1, f"{name}: must be at least 1, not {value}")
        suites.check(self.suite)


class Monitor(Callback):
    """Evaluates a run's policy, keeps the log of it and the best state."""

    def __init__(
        self,
        cfg: Config,
        plan: EvalPlan,
        make_policy: Callable[[Any], Policy],
        callbacks: Sequence[Callback],
        log: Callable[[str], None],
    ) -> None:
        """Settles the scenes. Raises SettingsError for a suite that does not fit the policy.

        Args: make_policy, of a learner's state; callbacks, whose `evaluated` is called; log, takes
        a line about each evaluation.
        """
        world = suites.standard(cfg, plan.suite)
        self._suite = suites.prepare(world, plan.suite, plan.episodes, SEED, robot=cfg.sim.robot)
        self._cfg, self._plan, self._policy = cfg, plan, make_policy
        self._callbacks, self._log = callbacks, log
        self._best: Score = ()
        self._done = 0  # actions before the chunk that comes next

    def begin(self, run: RunInfo) -> None:
        """Restores the log and the best state of a run that is resumed."""
        self._done = run.step * self._cfg.train.scenes
        self._log_path = files.inside(run.run_dir, files.EVALUATIONS)
        self._best_dir = files.inside(run.run_dir, files.BEST)
        files.write_json(run.run_dir / PLAN, self._plan._asdict())
        files.truncate_log(self._log_path, run.step)
        self._best = _best_score(self._best_dir, run.step)

    def chunk(self, record: Record, state: Any) -> None:
        """Evaluates after every so many actions, and after the last chunk."""
        before, self._done = self._done // self._plan.every, record.actions
        last = record.step >= loop.total_steps(self._cfg)
        if record.actions // self._plan.every > before or last:
            self._evaluate(record, state)

    def _evaluate(self, record: Record, state: Any) -> None:
        begun = time.time()
        table = rollout.evaluate(self._policy(state.learner), self._suite)
        score = score_of(table)
        if best := score > self._best:
            self._best = score
            extra = {"seconds": record.seconds, "grasps": [], "score": score}
            checkpoint.save(self._best_dir, record.step, state, self._cfg, extra)
        self._write(record, round(time.time() - begun, 3), score, best, table)
        values = [f"{name} {value:.1%}" for name, value in zip(JUDGED, score, strict=True)]
        line = f"evaluated on {self._plan.suite} at {record.actions} actions: {', '.join(values)}"
        self._log(line.replace("_", " ") + ", the best so far" * best)
        for callback in self._callbacks:
            callback.evaluated(record, table)

    def _write(
        self, record: Record, seconds: float, score: Score, best: bool, table: dict[str, Any]
    ) -> None:
        """Adds a line to the log, with all that `files.read_log` requires."""
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
        files.append(self._log_path, json.dumps(line))


def _best_score(folder: Path, step: int) -> Score:
    """Reads the score of the best state up to a step; sets later and damaged ones aside."""
    checkpoint.set_aside_after(folder, step)
    if checkpoint.latest_step(folder) is None:
        return ()
    try:
        return tuple(checkpoint.load_extra(folder)["score"])
    except checkpoint.CheckpointError as error:
        warnings.warn(f"{error}; the next evaluation is the best", DataWarning, stacklevel=2)
    checkpoint.set_aside_after(folder, -1)
    return ()


def score_of(table: dict[str, Any]) -> Score:
    """Returns what policies are ranked by: means over the parts of the suite, without cases 0."""
    parts = _parts(table)
    return tuple(sum(part[name]["value"] or 0.0 for part in parts) / len(parts) for name in JUDGED)


def _parts(table: dict[str, Any]) -> list[dict[str, Any]]:
    return list(table.get("parts", {"": table}).values())


def read_plan(run_dir: Path) -> EvalPlan | None:
    """Reads a run's plan; None if it has none. Raises SettingsError."""
    if not (path := run_dir / PLAN).exists():
        return None
    try:
        plan = EvalPlan(**files.read_object(path))
        plan.check()
    except (TypeError, ValueError) as error:
        fault = files.first_line(error)
        raise SettingsError(f"{path} is damaged ({fault}); remove it, or give eval_every") from None
    return plan
