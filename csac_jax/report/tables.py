"""The tables of a report. Every number comes from a file that says where it was measured."""

import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from csac_jax.constants import GRASP_WINDOW
from csac_jax.evaluation.statistics import Band
from csac_jax.report import comparison, results as recorded
from csac_jax.report.comparison import (
    METRICS,
    Curve,
    EvaluatedPart,
    Report,
    Score,
    gaps,
    label,
    lead,
)
from csac_jax.report.results import Evaluation, RecordedRun, Variant

PAPER_TRAINING = {"grasp_only": 0.50, "vpg": 0.75, "csac_per": 0.80, "csac_beta": 0.90}
"""Grasp success over the last 200 grasps of 2,500 actions, from the text to figures 6 and 7 (CSAC
sec. 4.3)."""
PAPER_ACTIONS = 2500
PAPER_CASES = {
    "completion": {"vpg": 0.60, "csac_beta": 0.90},
    "action_efficiency": {"vpg": 0.70, "csac_beta": 0.80},
}
"""Means of the four cases, figure 9 (sec. 4.4 and 5). The text gives no other numbers."""
GOOD = 0.9  # grasp success whose time is reported

Table = list[dict[str, str]]  # rows; column -> cell


def _seeds(runs: Sequence[RecordedRun | Evaluation]) -> list[int]:
    return sorted(one.config.get("seed", 0) for one in runs)


def _time_to_good(run: RecordedRun) -> float | None:
    """Training seconds after which the success of a full window first reached GOOD."""
    there = np.flatnonzero((run.success >= GOOD) & (run.grasps >= GRASP_WINDOW))
    return float(run.seconds[there[0]]) if there.size else None


def as_json(report: Report) -> dict[str, Any]:
    """The report's numbers, plain values only."""
    return {
        "curves": [_curve_json(report, curve) for curve in report.curves],
        "scores": [_score_json(score) for score in report.scores],
        "differences": [
            {"ours": _named(gap.ours), "theirs": _named(gap.theirs)}
            | {"suite": gap.suite, "parts": gap.parts, "world": gap.world}
            | {"metrics": _plain(gap.bands)}
            for gap in gaps(report)
        ],
        "provenance": provenance(report),
        "notes": report.notes,
    }


def _curve_json(report: Report, curve: Curve) -> recorded.Json:
    actions, success = curve.points()
    ends = {"final": curve.final, "ahead": lead(report, curve)}
    return _named(curve.variant) | {
        "seeds": _seeds(curve.runs),
        "seconds_to_90": [_time_to_good(run) for run in curve.runs],
        "seconds": [float(run.seconds[-1]) for run in curve.runs],
        "actions": actions.tolist(),
        "success": [band._asdict() for band in success],
        **_plain(ends),
    }


def _score_json(score: Score) -> recorded.Json:
    place = score.place._asdict()
    metrics = _plain({name: score.band(name) for name in METRICS})
    numbers = {"seeds": _seeds(score.evaluations), "metrics": metrics}
    return _named(place.pop("variant")) | place | numbers


def _named(variant: Variant) -> recorded.Json:
    return variant._asdict() | {"changed": dict(variant.changed)}


def _plain(bands: Mapping[str, Band | None]) -> recorded.Json:
    return {name: band and band._asdict() for name, band in bands.items()}


def tables(report: Report) -> dict[str, Table]:
    """By title; those without a row are left out."""
    every = {
        "Summary": summary(report),
        "Training": training(report),
        "Evaluation": evaluation(report),
        "Differences": differences(report),
        "Failures": failures(report),
        "Provenance": provenance(report),
    }
    return {title: table for title, table in every.items() if table}


def summary(report: Report) -> Table:
    """The methods as their presets have them."""
    return [
        {name: row[name] for name in ("method", "runs", LAST, "paper", "training time")}
        for curve, row in zip(report.curves, training(report), strict=True)
        if curve.variant.unchanged
    ]


LAST = f"success, last {GRASP_WINDOW} grasps"


def training(report: Report) -> Table:
    """How training went, a row per variant."""
    rows = []
    for curve in report.curves:
        mark = PAPER_TRAINING.get(curve.variant.algo) if curve.variant.unchanged else None
        ends = curve.ends if len(curve.ends) == 1 else [curve.ends[0], curve.ends[-1]]
        rows.append(
            {
                "method": label(curve.variant),
                "runs": str(len(curve.runs)),
                "seeds": ", ".join(map(str, sorted(set(_seeds(curve.runs))))),
                "actions": " to ".join(f"{end:,}" for end in ends),
                LAST: percent(curve.final),
                "CSAC-beta ahead by": percent(lead(report, curve), "+"),
                "paper": "-" if mark is None else f"{100 * mark:.0f} %",
                "time to 90 %": _range([_time_to_good(run) for run in curve.runs]),
                "training time": _range([float(run.seconds[-1]) for run in curve.runs]),
            }
        )
    return rows


def evaluation(report: Report) -> Table:
    """What policies reached: a row per part of a suite, and their mean."""
    rows = []
    for place, scores in comparison.together(report.scores):
        rows += [_evaluation_row(score.place, [score], score.band) for score in scores]
        if len(scores) > 1:
            whole = place._replace(part=f"mean of {len(scores)} parts")
            rows.append(_evaluation_row(whole, scores, partial(comparison.mean, scores)))
    return rows


def _evaluation_row(
    place: EvaluatedPart, scores: Sequence[Score], band: Callable[[str], Band | None]
) -> dict[str, str]:
    runs = max(len(score.evaluations) for score in scores)
    episodes = sum(score.place.episodes * len(score.evaluations) for score in scores)
    counts = {"runs": str(runs), "episodes": str(episodes)}
    cells = {title: percent(band(metric)) for metric, title in METRICS.items()}
    return _first_cells(place) | counts | cells


def differences(report: Report) -> Table:
    """By how many points CSAC-beta is ahead, a row per other variant and part."""
    rows = []
    for gap in gaps(report):
        part = gap.parts[0] if len(gap.parts) == 1 else f"mean of {len(gap.parts)} parts"
        rows.append(
            {
                "ahead": label(gap.ours),
                "of": label(gap.theirs),
                "part": _part(gap.suite, part),
                "physics, robot, seed": gap.world,
            }
            | {title: percent(gap.bands.get(metric), "+") for metric, title in METRICS.items()}
        )
    return rows


def failures(report: Report) -> Table:
    """Causes of failure, all runs summed: how many, and of how many."""
    told = {
        score.place: [one.metrics["failures"] for one in score.evaluations]
        for score in report.scores
        if all("failures" in one.metrics for one in score.evaluations)
    }
    causes = dict.fromkeys(cause for runs in told.values() for run in runs for cause in run)
    return [
        _first_cells(place) | {cause.replace("_", " "): _sum(runs, cause) for cause in causes}
        for place, runs in told.items()
    ]


def _sum(runs: Sequence[recorded.Json], cause: str) -> str:
    """The cases of a cause in several runs, and what they are cases of."""
    shares = [run[cause] for run in runs if cause in run]
    n = sum(share["n"] for share in shares)
    cases = sum(round(share["n"] * (share["value"] or 0.0)) for share in shares)
    return f"{cases} / {n}" if n else "-"


def _first_cells(its: EvaluatedPart) -> dict[str, str]:
    name = its.policy if its.policy != "learned" else label(its.variant)
    part = _part(its.suite, its.part)
    return {"policy": name, "part": part, "physics, robot, seed": its.world}


def _part(suite: str, part: str) -> str:
    return part if part == suite else f"{suite}: {part}"


def provenance(report: Report) -> Table:
    """Where every number comes from, a row per file."""
    every: list[RecordedRun | Evaluation] = [*report.results.runs, *report.results.evaluations]
    by_path = {one.path: one for one in every}
    root = os.path.commonpath([path.parent for path in by_path]) if by_path else ""
    return [
        {
            "file": os.path.relpath(path, root),
            "settings as a command": recorded.command(one),
            "device": one.record.get("device") or "-",
            "versions": _versions(one) or "-",
            "commit": str(one.record.get("commit") or "-")[:10],
            "wall time": _wall_time(one),
        }
        for path, one in by_path.items()
    ]


def _versions(one: RecordedRun | Evaluation) -> str:
    versions = one.record.get("versions") or {}
    names = [name for name in ("python", "jax", "mujoco") if name in versions]
    return ", ".join(f"{name} {versions[name]}" for name in names)


def _wall_time(one: RecordedRun | Evaluation) -> str:
    if isinstance(one, RecordedRun):
        seconds = one.record.get("wall_seconds", float(one.seconds[-1]))
    else:
        seconds = one.record.get("seconds")
    whole = ", whole sweep" if "settings" in one.record else ""
    return "-" if seconds is None else f"{seconds:.0f} s{whole}"


def percent(band: Band | None, sign: str = "") -> str:
    """A share with its band; with a sign, a difference in points of per cent."""
    if band is None:
        return "-"
    value, *ends = (f"{100 * x:{sign}.1f}" for x in band[:3] if x is not None)
    interval = f" ({' to '.join(ends)})" if ends else ""
    return f"{value}{'' if sign else ' %'}{interval}"


def _range(values: Sequence[float | None]) -> str:
    """Least and most of some times; not every run need have one."""
    there = sorted(value for value in values if value is not None)
    ends = dict.fromkeys(f"{value:.0f}" for value in (*there[:1], *there[1:][-1:]))
    some = f" ({len(there)} of {len(values)} runs)" if len(there) < len(values) else ""
    return f"{' to '.join(ends)} s{some}" if there else "-"


EXPLAINED = (
    "Several runs: the interquartile mean, and in brackets its 95 % band (bootstrap over seeds). "
    "One run: its value; where it was evaluated, the 95 % interval of its episodes. "
    "Differences: of interquartile means, in points of per cent. "
    "`csac_jax/evaluation/metrics.py` defines the metrics. "
    "Paper: numbers of CSAC's text (sec. 4.3, 4.4 and 5), for one scene and 2,500 actions. "
    "Only the preset `paper` keeps to that protocol."
)


def markdown(report: Report) -> str:
    """All tables and notes."""
    parts = [f"## {title}\n\n{table_text(table)}" for title, table in tables(report).items()]
    notes = "\n".join(f"- {note}" for note in report.notes)
    return "\n\n".join([EXPLAINED, *parts, *([f"## Notes\n\n{notes}"] if notes else [])]) + "\n"


def table_text(table: Table) -> str:
    """A table in Markdown."""
    rows = [list(table[0]), *(list(row.values()) for row in table)]
    lines = ["| " + " | ".join(cell.replace("|", "/") for cell in row) + " |" for row in rows]
    lines.insert(1, "|" + "---|" * len(table[0]))
    return "\n".join(lines)
