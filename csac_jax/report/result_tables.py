"""The tables of a report. Every number comes from a file that says where it was measured."""

import os
from collections.abc import Mapping, Sequence

import numpy as np

from csac_jax.constants import GRASP_WINDOW
from csac_jax.evaluation import statistics
from csac_jax.evaluation.metrics import PER_EPISODE
from csac_jax.evaluation.statistics import Band
from csac_jax.report import comparison, suite_table
from csac_jax.report.cells import ResultTable, shown, table_text
from csac_jax.report.comparison import Curve, ResultReport, Score, compared
from csac_jax.report.results import METRICS, RecordedRun
from csac_jax.report.variants import Json, Variant, label, train_command

GOOD = 0.9  # grasp success whose time is reported
LAST = "final success"
AREA = "area under the curve"
SUMMARY = ("method", "runs", LAST, AREA, "training time")  # of the training table
RATES = {
    "blocks / action": (("cleared",), ("pushes", "grasps"), "action_efficiency"),
    "lifted / grasp": (("lifted",), ("grasps",), "grasp_success"),
    "actions / episode": (("pushes", "grasps"), ("terminated", "truncated"), "actions_per_episode"),
    "pushes / episode": (("pushes",), ("terminated", "truncated"), "pushes_per_episode"),
}
"""Column of the training table -> totals above and below, and the metric with its unit."""
IMPROVED = tuple(name for name in METRICS if name not in PER_EPISODE)  # more is better
EXPLAINED = (
    "Several runs: the interquartile mean and, in brackets, its 95 % interval. The bootstrap draws "
    "seeds, then the hosts that a seed ran on. "
    "One run: its value; of an evaluation with the 95 % interval of its episodes. "
    f"Final success is over the last {GRASP_WINDOW} grasps. "
    "The area under the curve is the mean of that success over all actions. "
    "Rates in the training table are over all of training. "
    "Differences are of interquartile means, in points of per cent. "
    "P is the probability of improvement: that a seed of one method is above one of the other. "
    "Lifted / grasps, mean of episodes, is the paper's action efficiency; pushes cost nothing in "
    "it. `csac_jax/evaluation/metrics.py` defines the metrics. "
    "A method with many changed settings has the name of its folder; its command stands under "
    "provenance."
)


def first_good(run: RecordedRun, column: np.ndarray) -> float | None:
    """Returns the value of a column of a log where the success of a full window first is GOOD."""
    good = column[(run.success >= GOOD) & (run.grasps >= GRASP_WINDOW)]
    return float(good[0]) if good.size else None


def as_json(report: ResultReport) -> Json:
    """Returns the report's numbers as plain values."""
    return {
        "reference": report.reference,
        "curves": [_curve_json(curve) for curve in report.curves],
        "scores": [_score_json(score, part) for score in report.scores for part in score.parts],
        "training_differences": [
            _both(*pair) | _plain(_training_gaps(*pair)) for pair in comparison.curve_pairs(report)
        ],
        "differences": [_difference_json(*pair) for pair in comparison.pairs(report)],
        "provenance": provenance(report),
        "notes": report.notes,
    }


def _curve_json(curve: Curve) -> Json:
    actions, success = curve.points()
    return _named(curve.variant) | {
        "seeds": sorted(curve.seeds),
        "seconds_to_90": [first_good(run, run.seconds) for run in curve.runs],
        "seconds": [float(run.seconds[-1]) for run in curve.runs],
        "actions": actions.tolist(),
        "success": [band._asdict() for band in success],
        **_plain({"final": statistics.band([curve.final]), "area": statistics.band([curve.area])}),
        "rates": _plain({name: curve.rate(*of) for name, (*of, _) in RATES.items()}),
    }


def _score_json(score: Score, part: str) -> Json:
    fields = score._asdict() | {
        "part": part,
        "seeds": sorted(comparison.seeds_of(score.parts[part])),
    }
    del fields["parts"]
    metrics = _plain({name: score.only(part).band(name) for name in METRICS})
    return _named(fields.pop("variant")) | fields | {"metrics": metrics}


def _difference_json(ours: Score, theirs: Score) -> Json:
    return _both(ours, theirs) | {
        "suite": ours.suite,
        "parts": list(ours.parts),
        "world": ours.world,
        "metrics": _plain(compared(ours, theirs, statistics.difference, METRICS)),
        "improvement": _plain(compared(ours, theirs, statistics.improvement, IMPROVED)),
    }


def _both(ours: Curve | Score, theirs: Curve | Score) -> Json:
    return {"ours": _named(ours.variant), "theirs": _named(theirs.variant)}


def _named(variant: Variant) -> Json:
    return {"preset": variant.preset, "algo": variant.algo, "changed": dict(variant.changed)}


def _plain(bands: Mapping[str, Band | None]) -> Json:
    return {name: band and band._asdict() for name, band in bands.items()}


def tables(report: ResultReport) -> dict[str, ResultTable]:
    """Builds all tables by title, without those that have no row."""
    trained = training(report)
    plain = [row for one, row in zip(report.curves, trained, strict=True) if one.variant.unchanged]
    titled = {
        "Summary": [{name: row[name] for name in SUMMARY} for row in plain],
        "Training": trained,
        "Suites": suite_table.merged(report.results.suites),
        "Evaluation": evaluation(report),
        "Differences in training": training_differences(report),
        "Differences": differences(report),
        "Provenance": provenance(report),
    }
    return {title: table for title, table in titled.items() if table}


def training(report: ResultReport) -> ResultTable:
    """Builds the table of training, a row per variant."""
    return [_training_row(curve) for curve in report.curves]


def _training_row(curve: Curve) -> dict[str, str]:
    rates = {name: (curve.rate(*sums), metric) for name, (*sums, metric) in RATES.items()}
    return {
        "method": label(curve.variant),
        "runs": str(len(curve.runs)),
        "seeds": ", ".join(map(str, sorted(set(curve.seeds)))),
        "actions": _range(curve.ends, ","),
        LAST: shown(statistics.band([curve.final])),
        AREA: shown(statistics.band([curve.area])),
        **{name: shown(band, metric=metric) for name, (band, metric) in rates.items()},
        "time to 90 %": _times([first_good(run, run.seconds) for run in curve.runs]),
        "training time": _times([float(run.seconds[-1]) for run in curve.runs]),
    }


def training_differences(report: ResultReport) -> ResultTable:
    """Builds the table of how far the reference is ahead in training, a row per other variant."""
    rows = []
    for ours, theirs in comparison.curve_pairs(report):
        final, area, chance = _training_gaps(ours, theirs).values()
        names = {"ahead": label(ours.variant), "of": label(theirs.variant)}
        rows.append(names | {LAST: _difference(final, chance), AREA: shown(area, "+")})
    return rows


def _training_gaps(ours: Curve, theirs: Curve) -> dict[str, Band]:
    final = [ours.final], [theirs.final]
    return {
        "final": statistics.difference(*final),
        "area": statistics.difference([ours.area], [theirs.area]),
        "improvement": statistics.improvement(*final),
    }


def _difference(gap: Band | None, chance: Band | None, metric: str = "") -> str:
    p = "" if chance is None else f", P {100 * chance.value:.0f} %"
    return shown(gap, "+", metric) + p


def _times(seconds: Sequence[float | None]) -> str:
    """Formats the least and the most of some times; not every run need have one."""
    known = [time for time in seconds if time is not None]
    some = f" ({len(known)} of {len(seconds)} runs)" if len(known) < len(seconds) else ""
    return f"{_range(known, '.0f')} s{some}" if known else "-"


def _range(values: Sequence[float], spec: str) -> str:
    return " to ".join(dict.fromkeys(format(end, spec) for end in (min(values), max(values))))


def evaluation(report: ResultReport) -> ResultTable:
    """Builds the table of evaluations: a row per part of a suite, and their mean."""
    return [
        {
            "policy": score.name,
            **_place_cells(score),
            "runs": str(score.most_runs),
            "episodes": str(score.episodes * sum(map(len, score.parts.values()))),
            **{title: shown(score.band(key), metric=key) for key, title in METRICS.items()},
        }
        for whole in report.scores
        for score in whole.split()
    ]


def differences(report: ResultReport) -> ResultTable:
    """Builds the table of how far the reference is ahead, a row per other variant and part."""
    rows = []
    for ours, theirs in comparison.pairs(report):
        gaps = compared(ours, theirs, statistics.difference, METRICS)
        chances = compared(ours, theirs, statistics.improvement, IMPROVED)
        row = {"ahead": label(ours.variant), "of": label(theirs.variant)} | _place_cells(ours)
        for key, title in METRICS.items():
            row[title] = _difference(gaps.get(key), chances.get(key), key)
        rows.append(row)
    return rows


def _place_cells(score: Score) -> dict[str, str]:
    part, *others = score.parts
    part = f"mean of {len(score.parts)} parts" if others else part
    part = part if part == score.suite else f"{score.suite}: {part}"
    return {"part": part, "physics, robot, seed": score.world}


def provenance(report: ResultReport) -> ResultTable:
    """Builds the table of where numbers come from, a row per file."""
    trained = {run.path.parent: run.config for run in report.results.runs}
    files = {run.path: (train_command(run.config), run.record) for run in report.results.runs}
    for one in report.results.evaluations:
        files[one.path] = one.command(trained.get(one.path.parent)), one.record
    folders = [path.parent.absolute() for path in files]  # one form: some are given relative
    root = os.path.commonpath(folders) if files else ""
    return [
        {
            "file": os.path.relpath(path.absolute(), root),
            "settings as a command": command + _imports(record),
            "device": record.get("device") or "-",
            "versions": _versions(record) or "-",
            "commit": str(record.get("commit") or "-")[:10],
            "wall time": _wall_time(record),
        }
        for path, (command, record) in files.items()
    ]


def _imports(record: Json) -> str:
    return "".join(f" --import {module}" for module in record.get("modules") or {})


def _versions(record: Json) -> str:
    versions = (record.get("versions") or {}).items()
    return ", ".join(f"{name} {n}" for name, n in versions if name in ("python", "jax", "mujoco"))


def _wall_time(record: Json) -> str:
    seconds, whole = record["wall_seconds"], ", whole sweep" * ("settings" in record)
    return "-" if seconds is None else f"{seconds:.0f} s{whole}"


def markdown(report: ResultReport) -> str:
    """Writes all tables and notes as Markdown."""
    sections = {title: table_text(table) for title, table in tables(report).items()}
    if report.notes:
        sections["Notes"] = "\n".join(f"- {note}" for note in report.notes)
    sections["How to read the tables"] = EXPLAINED
    return "\n\n".join(f"## {title}\n\n{text}" for title, text in sections.items()) + "\n"
