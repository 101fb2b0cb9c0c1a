"""Writes the tables of docs/results.md from the recorded results: `python -m experiments.summary`.

The page built by `make docs` from `csac-jax report experiments/results` has all the others.
"""

import fnmatch
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path

from csac_jax.evaluation import statistics
from csac_jax.evaluation.suites import IN_DISTRIBUTION
from csac_jax.report import comparison, result_tables, results
from csac_jax.report.result_tables import ResultTable, shown
from csac_jax.report.results import METRICS
from csac_jax.report.variants import NAMES
from experiments.index import RESULTS, STUDY

PAGE = Path(__file__).resolve().parents[1] / "docs" / "results.md"
BEGIN = "<!-- The rest is written by `python -m experiments.summary`. -->\n"
FAMILIES = ("fast", "general", "objects", "paper", "quick")
POLICIES = {
    "shipped": (
        "general/fit/seed-1",
        (
            *("random10", "random30", "packed", "cases", "pile", "objects_packed", "objects10"),
            *("target", "target_objects", "blocked", "enclosed", "tray", "hidden"),
        ),
    ),
    "shipped_clutter": (
        "fast/clutter/seed-1",
        ("random10-high", "random30-high", "packed-high", "cases-high"),
    ),
}
"""Policy -> folder of its run, and its evaluations."""
TRAINED = {
    "quick/csac_beta": "`quick`, two CPU cores",
    "paper/*": "`paper`, one H200",
    "fast/csac_beta": "`fast`, one GPU",
    "fast/target": "`fast` in the target task, one GPU",
    "fast/target_grasp_only": "the same, grasping only",
    "objects/csac_beta": "`objects`, two CPU cores",
}
"""Pattern of folders of runs -> what was trained."""
SHOWN = ("completion", "grasp_success", "action_efficiency")


def page() -> str:
    """Returns docs/results.md with the tables of today's records."""
    head, _, _ = PAGE.read_text().partition(BEGIN)
    paths = [RESULTS / f"{name}{results.ARCHIVE}" for name in FAMILIES]
    recorded = results.read(paths)
    titled = {
        "Policies that ship": list(_policies(recorded.evaluations)),
        "Training": list(_trained(recorded.runs)),
        "Methods in the study": list(_methods()),
    }
    sections = (f"\n## {t}\n\n{result_tables.table_text(rows)}\n" for t, rows in titled.items())
    return head + BEGIN + "".join(sections)


def _policies(evaluations: Sequence[results.Evaluation]) -> Iterator[dict[str, str]]:
    for policy, (folder, names) in POLICIES.items():
        for name in names:
            path = f"{folder}/eval-{name}.json"
            parts = [one for one in evaluations if one.path.as_posix().endswith(f"/{path}")]
            (score,) = comparison.build(results.Results([], parts, [])).scores
            place = score.suite if len(parts) == 1 else f"{score.suite}, mean of {len(parts)}"
            yield {"policy": f"`{policy}`", "suite": place} | {
                "episodes": str(score.episodes * len(parts)),
                **{METRICS[key]: shown(score.band(key), metric=key) for key in SHOWN},
                "record": f"`{path}`",
            }


def _trained(runs: Sequence[results.RecordedRun]) -> Iterator[dict[str, str]]:
    for folder, title in TRAINED.items():
        own = [run for run in runs if fnmatch.fnmatch("/".join(run.path.parts[-4:-2]), folder)]
        report = comparison.build(results.Results(own, [], []))
        (row,) = result_tables.training(report)
        columns = ("runs", "actions", *result_tables.SUMMARY[2:4], "time to 90 %", "training time")
        yield {"preset": title} | {column: row[column] for column in columns}


def _methods() -> ResultTable:
    """Builds the greedy policies of part 1 by task and method."""
    rows = []
    for task in ("target", "clear", "packed"):
        for algo in NAMES:
            folder = f"1-{task}-{algo}-*"
            area, names = _area(folder), (*SHOWN, "pushes_per_episode")
            bands = {key: statistics.band([_evaluated(folder, key)]) for key in names}
            rows.append(
                {"task": task, "method": NAMES[algo], "seeds": str(len(area))}
                | {METRICS[key]: shown(band, metric=key) for key, band in bands.items()}
                | {result_tables.AREA: shown(statistics.band([area]))}
            )
    return rows


@functools.cache
def methods() -> results.Results:
    """Reads part 1 of the study."""
    return results.read([STUDY / f"1-methods{results.ARCHIVE}"])


def _area(folder: str) -> statistics.Stratum:
    """Returns the mean success over all actions of each seed of part 1 in such folders."""
    runs = [run for run in methods().runs if fnmatch.fnmatch(run.path.parts[-4], folder)]
    areas = [statistics.area(run.actions, run.success, float(run.actions[-1])) for run in runs]
    return _by_seed(runs, areas)


def _evaluated(folder: str, metric: str) -> statistics.Stratum:
    found = [
        one
        for one in methods().evaluations
        if fnmatch.fnmatch(one.path.parts[-4], folder) and one.suite == IN_DISTRIBUTION
    ]
    return _by_seed(found, [one.metrics[metric]["value"] for one in found])


def _by_seed(
    every: Sequence[results.RecordedRun | results.Evaluation], values: Sequence[float]
) -> statistics.Stratum:
    return statistics.by_seed([one.config["seed"] for one in every], values)


if __name__ == "__main__":
    PAGE.write_text(page())
