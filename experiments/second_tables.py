"""Tables of the second study from its archives: `python -m experiments.second_study report`.

docs/study-protocol.md defines the rows, the averages and the verdicts.
"""

import functools
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from csac_jax.evaluation import statistics
from csac_jax.evaluation.statistics import Band
from csac_jax.report import comparison, result_tables, results
from csac_jax.report.results import Evaluation, RecordedRun

MARGIN = 0.05  # of completion, within which arms are equal
ALPHA = 0.05
PERMUTATIONS = 100_000  # most, drawn at random where there are more
COMPLETION = "completion"
LIFTS, EARLY = "action_efficiency_grasps", 500  # of the paper's claims: a metric, actions
BESIDE = ("action_efficiency", "pushes_per_episode")  # other metrics of an arm
SAMPLERS = ("prioritised", "beta", "geometric", "reaper")  # that H3 compares with uniform replay
CONTROLLED = ("H3", "H6", "H7")  # in which no row counts if the control differs
VOID = "; the control differs, so no row leads or lags"
AVERAGES = {
    "mean": functools.partial(np.mean, axis=-1),
    "interquartile mean": statistics.interquartile_mean,
    "worst quartile": statistics.worst_quartile,
}


class Row(NamedTuple):
    """A comparison: ours less theirs, arms by their places, in parts of a suite."""

    name: str
    ours: tuple[str, ...]
    theirs: tuple[str, ...]
    suite: str = "enclosed"
    parts: tuple[str, ...] = ()  # all if empty


class Difference(NamedTuple):
    """A row's difference of interquartile means."""

    band: Band
    p: float
    verdict: str


def hypotheses() -> dict[str, list[Row]]:
    """Returns the rows of each hypothesis of the protocol, the control first."""
    pair = lambda where: ((f"pushes/{where}-pushes",), (f"pushes/{where}-none",))  # noqa: E731
    harmless = ("ridge", "row", "random10")
    uniform = "replay/uniform-16"
    steps = itertools.pairwise(("grasp_only", "vpg", "csac_per", "csac_beta"))
    rule = (("methods/csac_rule",), ("methods/csac",))
    share, bonus, gamma = "settings/exploration", "settings/bonus", "settings/discount"
    return {
        "Control": [Row("uniform less the control", (uniform,), ("control/uniform-16",))],
        "H1": [
            Row("enclosed", *pair("enclosed")),
            *(Row(suite, *pair("blocked"), suite) for suite in ("blocked", "tray")),
        ],
        "H2": [
            *(Row(part, *pair("enclosed"), "target", (part,)) for part in harmless),
            Row("random10, cleared", *pair("blocked"), "random10"),
        ],
        "H3": [
            Row(f"{name}, volume {v}", (f"replay/{name}-{v}",), (f"replay/uniform-{v}",))
            for v in (16, 2)
            for name in SAMPLERS
        ],
        "H4": [
            Row(f"{high} less {low}", (f"methods/{high}",), (f"methods/{low}",), "target")
            for low, high in steps
        ],
        "H5": [Row(suite, *rule, suite) for suite in ("target", "enclosed")],
        "H6": [
            Row("grasps only, 100 N less 20 N", ("contact/100N-none",), ("contact/20N-none",)),
            Row("pushes less none, 20 N", (uniform,), ("contact/20N-none",)),
            Row("pushes less none, 100 N", ("contact/100N-pushes",), ("contact/100N-none",)),
        ],
        "H7": [
            Row("half of random primitives push, less a quarter", (uniform, share), (bonus, gamma)),
            Row("no success bonus less one", (share, gamma), (uniform, bonus)),
            Row("discount 0.5 less 0.2", (uniform, gamma), (share, bonus)),
        ],
    }


@functools.cache
def read(archives: Path, part: str) -> results.Results:
    """Reads a part's archive; nothing where there is none."""
    path = archives / f"second-{part}{results.ARCHIVE}"
    return results.read([path] if path.exists() else [])


def values(
    archives: Path,
    places: Sequence[str],
    suite: str,
    parts: Sequence[str] = (),
    metric: str = COMPLETION,
) -> np.ndarray:
    """Returns a metric of each run [S] of arms, its mean over the parts of a suite; none if one of
    the arms is not there."""
    found: dict[tuple[str, str], list[float]] = {}
    for place in places:
        part, _, name = place.partition("/")
        for one in read(archives, part).evaluations:
            arm, _, seed = one.path.parts[-4:-1]
            if (arm, one.suite) == (name, suite) and (not parts or one.part in parts):
                found.setdefault((place, seed), []).append(one.metrics[metric]["value"])
    there = {place for place, _ in found} == set(places)
    return np.array([np.mean(column) for column in found.values()] if there else [])


def difference(ours: np.ndarray, theirs: np.ndarray) -> tuple[Band, float]:
    """Returns the difference of interquartile means and p of a permutation of seeds."""
    gap = lambda x, y, axis: _middle(x, axis) - _middle(y, axis)  # noqa: E731
    test = stats.permutation_test(
        (ours, theirs), gap, vectorized=True, n_resamples=PERMUTATIONS, random_state=0
    )
    return statistics.difference([ours], [theirs]), float(test.pvalue)


def _middle(x: np.ndarray, axis: int) -> np.ndarray:
    return statistics.interquartile_mean(np.moveaxis(x, axis, -1))


def verdict(band: Band, survives: bool) -> str:
    """Judges a difference: leads, lags, equal or open; the protocol's decisions."""
    low, high = band.low or 0.0, band.high or 0.0
    if survives and not low <= 0.0 <= high:
        return "leads" if low > 0.0 else "lags"
    return "equal" if max(-low, high) <= MARGIN else "open"


def judge(archives: Path, rows: Sequence[Row]) -> dict[str, Difference]:
    """Judges the rows of a hypothesis that are there, with Holm's correction over all of them."""
    pairs = {
        row.name: [values(archives, arms, row.suite, row.parts) for arms in (row.ours, row.theirs)]
        for row in rows
    }
    there = {name: difference(*pair) for name, pair in pairs.items() if min(map(len, pair)) > 1}
    missing = [1.0] * (len(rows) - len(there))  # rows to come count
    survive = statistics.holm([p for _, p in there.values()] + missing, ALPHA)
    return {
        name: Difference(band, p, verdict(band, kept))
        for (name, (band, p)), kept in zip(there.items(), survive, strict=False)
    }


def report(archives: Path, places: Sequence[str]) -> str:
    """Returns a table of each hypothesis, then one of the arms in these places."""
    found = {name: judge(archives, rows) for name, rows in hypotheses().items()}
    differs = any(one.p < ALPHA for one in found["Control"].values())
    sections = [
        f"**{name}** (completion, points{VOID if differs and name in CONTROLLED else ''})\n\n"
        + result_tables.table_text([_row(*item) for item in rows.items()])
        for name, rows in found.items()
        if rows
    ]
    shown = [place for place in places if not place.startswith("search/")]
    tables = list(searched(archives)), list(claims(archives)), list(_arm_rows(archives, shown))
    return "\n".join([*sections, *(result_tables.table_text(rows) for rows in tables if rows)])


def searched(archives: Path) -> Iterator[dict[str, str]]:
    """Yields a row per method: the searched setting with most completion, and that with most blocks
    per action; of equal ones the first by name."""
    evaluations = read(archives, "search").evaluations
    for method, found in comparison.grouped(evaluations, _arm_of).items():
        settings = comparison.grouped(found, lambda one: one.path.parts[-3])
        best = {results.METRICS[name]: _best(settings, name) for name in (COMPLETION, BESIDE[0])}
        yield {"searched": method, **best}


def _best(settings: dict[str, list[Evaluation]], metric: str) -> str:
    means = {
        name: np.mean([one.metrics[metric]["value"] for one in group])
        for name, group in settings.items()
    }
    name = max(means, key=lambda name: means[name])
    return f"{name}: {means[name]:.3f}"


def claims(archives: Path) -> Iterator[dict[str, str]]:
    """Yields a row per method of what the paper claims of it; interquartile means over seeds."""
    for name, runs in comparison.grouped(read(archives, "methods").runs, _arm_of).items():
        suite = functools.partial(values, archives, [f"methods/{name}"], "target")
        columns = {
            "completion": (COMPLETION, suite()),
            "lifts / grasp": (LIFTS, suite(metric=LIFTS)),
            "training success": (COMPLETION, [run.success[-1] for run in runs]),
            f"area, {EARLY} actions": (COMPLETION, list(map(_early, runs))),
        }
        cells = {
            title: result_tables.shown(statistics.band([column]), "", metric)
            for title, (metric, column) in columns.items()
        }
        yield {"method": name, **cells, "seconds": f"{np.mean([r.seconds[-1] for r in runs]):.0f}"}


def _arm_of(run: RecordedRun | Evaluation) -> str:
    return run.path.parts[-4]


def _early(run: RecordedRun) -> float:
    return statistics.area(run.actions, run.success, EARLY)


def _row(name: str, found: Difference) -> dict[str, str]:
    gap = result_tables.shown(found.band, "+", COMPLETION)
    return {"": name, "difference": gap, "p": f"{found.p:.4f}", "verdict": found.verdict}


def _arm_rows(archives: Path, places: Sequence[str]) -> Iterator[dict[str, str]]:
    """Yields a row per arm, suite and part: three averages over seeds, and what pushes cost."""
    for place in places:
        part, _, name = place.partition("/")
        found = [one for one in read(archives, part).evaluations if one.path.parts[-4] == name]
        for suite, scene in dict.fromkeys((one.suite, one.part) for one in found):
            column = functools.partial(values, archives, [place], suite, [scene])
            yield {"arm": place, "suite": suite, "part": scene, **_cells(column)}


def _cells(column: Any) -> dict[str, str]:
    bands = {
        name: (COMPLETION, statistics.band([column()], average=average))
        for name, average in AVERAGES.items()
    } | {results.METRICS[name]: (name, statistics.band([column(metric=name)])) for name in BESIDE}
    return {title: result_tables.shown(band, "", name) for title, (name, band) in bands.items()}
