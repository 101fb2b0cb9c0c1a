"""Writes the tables of the study into docs/study.md, from archives in experiments/results/study.

An archive PART-TASK.tar.xz holds sweeps of one task. `csac-jax report` reads it too.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from csac_jax.evaluation import statistics
from csac_jax.evaluation.suites import IN_DISTRIBUTION
from csac_jax.report import comparison, results, tables
from csac_jax.report.comparison import NAMES, Report, Score
from csac_jax.report.tables import Table

ROOT = Path(__file__).resolve().parents[1]
ARCHIVES = ROOT / "experiments" / "results" / "study"
PAGE = ROOT / "docs" / "study.md"
BEGIN = "<!-- The rest is written by `python -m experiments.study`. -->\n"
PARTS = {
    "1-target": "Part 1, the target task",
    "1-clear": "Part 1, the table cleared",
    "1-packed": "Part 1, packed scenes cleared",
}
"""Name of an archive -> its title."""
METRICS = ("completion", "grasp_success", "action_efficiency", "pushes_per_episode")
SUITES = {IN_DISTRIBUTION: "scenes like the training's, 500 episodes", "target": "suite `target`"}
PAIRS = (
    ("csac", "grasp_only"),
    ("csac_per", "grasp_only"),
    ("csac_beta", "grasp_only"),
    ("reactive", "grasp_only"),
    ("vpg", "grasp_only"),
    ("csac_per", "csac"),
    ("csac_beta", "csac"),
    ("csac_beta", "vpg"),
)
"""Methods that are compared: pushes against none, samplers against uniform replay."""
POINT = 0.01  # within which methods are equivalent


def archives() -> dict[str, Path]:
    """The archives that there are, by name."""
    paths = {name: ARCHIVES / f"{name}{results.ARCHIVE}" for name in PARTS}
    return {name: path for name, path in paths.items() if path.exists()}


def page() -> str:
    """docs/study.md with the tables of today's archives."""
    protocol, _, _ = PAGE.read_text().partition(BEGIN)
    return protocol + BEGIN + "".join(_part(*one) for one in archives().items())


def _part(name: str, path: Path) -> str:
    report = comparison.build(results.read([path]))
    suites = [suite for suite in SUITES if _scores(report, suite)]
    titled = {"Training": _training(report)}
    titled |= {f"Greedy: {SUITES[suite]}": _greedy(report, suite) for suite in suites}
    titled["Differences"] = list(_differences(report, suites))
    text = "".join(f"\n**{title}**\n\n{tables.table_text(one)}\n" for title, one in titled.items())
    return f"\n### {PARTS[name]}\n{text}"


def _training(report: Report) -> Table:
    return [
        {
            "method": NAMES[curve.variant.algo],
            "seeds": str(len(curve.final)),
            "last 200 grasps": tables.shown(statistics.band([curve.final])),
            "area under the curve": tables.shown(statistics.band([curve.area])),
        }
        for curve in _methods(report.curves).values()
    ]


def _greedy(report: Report, suite: str) -> Table:
    return [
        {"method": NAMES[score.variant.algo], "seeds": str(score.seeds)}
        | {results.METRICS[name]: tables.shown(score.band(name), metric=name) for name in METRICS}
        for score in _methods(_scores(report, suite)).values()
    ]


def _scores(report: Report, suite: str) -> list[Score]:
    return [score for score in report.scores if score.suite == suite]


def _methods(found: Sequence[Any]) -> dict[str, Any]:
    """What was found by algorithm, in the order of NAMES."""
    by_algo = {one.variant.algo: one for one in found}
    return {algo: by_algo[algo] for algo in NAMES if algo in by_algo}


def _differences(report: Report, suites: Sequence[str]) -> Iterator[dict[str, str]]:
    curves = _methods(report.curves)
    scores = {suite: _methods(_scores(report, suite)) for suite in suites}
    for a, b in PAIRS:
        if all({a, b} <= known.keys() for known in (curves, *scores.values())):
            row = {"method": NAMES[a], "less": NAMES[b]}
            row["area"] = _verdict([curves[a].area], [curves[b].area])
            for suite, known in scores.items():
                where = "" if suite == IN_DISTRIBUTION else f", suite `{suite}`"
                completions = (known[one].strata("completion") for one in (a, b))
                row[f"completion{where}"] = _verdict(*completions)
            yield row


def _verdict(ours: Any, theirs: Any) -> str:
    """A difference of strata, and what the protocol makes of it; where they differ with the
    probability of improvement, that a seed of ours is above one of theirs."""
    gap = statistics.difference(ours, theirs)
    assert gap.low is not None
    assert gap.high is not None
    small, differ = max(-gap.low, gap.high) <= POINT, not gap.low <= 0.0 <= gap.high
    if differ:
        told = "differ, by less than a point" if small else "differ"
        told += f", P {100 * statistics.improvement(ours, theirs).value:.0f} %"
    else:
        told = "equivalent" if small else "not told"
    return f"{tables.shown(gap, sign='+')}: {told}"


if __name__ == "__main__":
    PAGE.write_text(page())
