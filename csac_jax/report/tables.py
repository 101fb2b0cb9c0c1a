"""The tables of a report. Every number comes from a file that says where it was measured."""

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from csac_jax.constants import GRASP_WINDOW
from csac_jax.evaluation import statistics
from csac_jax.evaluation.metrics import PER_ACTION, PER_EPISODE
from csac_jax.evaluation.statistics import Band
from csac_jax.report import results as recorded
from csac_jax.report.comparison import (
    Curve,
    Lead,
    Report,
    Score,
    compared,
    label,
    leads,
    pairs,
    seeds_of,
)
from csac_jax.report.results import Evaluation, RecordedRun, Variant

PAPER_TRAINING = {"grasp_only": 0.50, "vpg": 0.75, "csac_per": 0.80, "csac_beta": 0.90}
"""Success over the last 200 grasps of 2,500 actions, text to figures 6 and 7 (CSAC sec. 4.3)."""
PAPER_ACTIONS = 2500
PAPER_CASES = {
    "completion": {"vpg": 0.60, "csac_beta": 0.90},
    "action_efficiency": {"vpg": 0.70, "csac_beta": 0.80},
}
"""Means of the four cases, figure 9 (sec. 4.4 and 5). The text gives no other numbers."""
GOOD = 0.9  # grasp success whose time is reported
LAST = "final success"
AREA = "area under the curve"
SUMMARY = ("method", "runs", LAST, "paper", AREA, "training time")  # of the training table
RATES = {
    "blocks / action": (("cleared",), ("pushes", "grasps"), "action_efficiency"),
    "lifted / grasp": (("lifted",), ("grasps",), "grasp_success"),
    "actions / episode": (("pushes", "grasps"), ("terminated", "truncated"), "actions_per_episode"),
    "pushes / episode": (("pushes",), ("terminated", "truncated"), "pushes_per_episode"),
}
"""Column of the training table -> totals above and below, and the metric with its unit."""
IMPROVED = tuple(name for name in recorded.METRICS if name not in PER_EPISODE)  # more is better

Table = list[dict[str, str]]  # rows; column -> cell


def first_good(run: RecordedRun) -> int | None:
    """Line of a log at which the success of a full window first is GOOD."""
    there = np.flatnonzero((run.success >= GOOD) & (run.grasps >= GRASP_WINDOW))
    return int(there[0]) if there.size else None


def _time_to_good(run: RecordedRun) -> float | None:
    """Training seconds until then."""
    line = first_good(run)
    return None if line is None else float(run.seconds[line])


def as_json(report: Report) -> dict[str, Any]:
    """The report's numbers, plain values only."""
    ahead = leads(report)
    return {
        "curves": [_curve_json(curve, ahead.get(curve.variant)) for curve in report.curves],
        "scores": [_score_json(score, part) for score in report.scores for part in score.parts],
        "differences": [
            {"ours": _named(ours.variant), "theirs": _named(theirs.variant)}
            | {"suite": ours.suite, "parts": list(ours.parts), "world": ours.world}
            | {"metrics": _plain(compared(ours, theirs, statistics.difference, recorded.METRICS))}
            | {"improvement": _plain(compared(ours, theirs, statistics.improvement, IMPROVED))}
            for ours, theirs in pairs(report)
        ],
        "provenance": provenance(report),
        "notes": report.notes,
    }


def _curve_json(curve: Curve, ahead: Lead | None) -> recorded.Json:
    actions, success = curve.points()
    return _named(curve.variant) | {
        "seeds": sorted(curve.seeds),
        "seconds_to_90": [_time_to_good(run) for run in curve.runs],
        "seconds": [float(run.seconds[-1]) for run in curve.runs],
        "actions": actions.tolist(),
        "success": [band._asdict() for band in success],
        **_plain({"final": statistics.band([curve.final]), "area": statistics.band([curve.area])}),
        "ahead": ahead and _plain(ahead._asdict()),
        "rates": _plain({name: curve.rate(*of) for name, (*of, _) in RATES.items()}),
    }


def _score_json(score: Score, part: str) -> recorded.Json:
    fields = score._asdict() | {"part": part, "seeds": sorted(seeds_of(score.parts[part]))}
    del fields["parts"]
    metrics = _plain({name: score.only(part).band(name) for name in recorded.METRICS})
    return _named(fields.pop("variant")) | fields | {"metrics": metrics}


def _named(variant: Variant) -> recorded.Json:
    named = {"preset": variant.preset, "algo": variant.algo}
    return named | {"changed": dict(variant.changed)}


def _plain(bands: Mapping[str, Band | None]) -> recorded.Json:
    return {name: band and band._asdict() for name, band in bands.items()}


def tables(report: Report) -> dict[str, Table]:
    """By title; those without a row are left out."""
    trained = training(report)
    kept = [row for one, row in zip(report.curves, trained, strict=True) if one.variant.unchanged]
    every = {
        "Summary": [{name: row[name] for name in SUMMARY} for row in kept],
        "Training": trained,
        "Evaluation": evaluation(report),
        "Differences": differences(report),
        "Probability of improvement": improvements(report),
        "Failures": failures(report),
        "Provenance": provenance(report),
    }
    return {title: table for title, table in every.items() if table}


def training(report: Report) -> Table:
    """How training went, a row per variant."""
    rows, ahead = [], leads(report)
    for curve in report.curves:
        mark = PAPER_TRAINING.get(curve.variant.algo) if curve.variant.unchanged else None
        lead = ahead.get(curve.variant)
        rows.append(
            {
                "method": label(curve.variant),
                "runs": str(len(curve.runs)),
                "seeds": ", ".join(map(str, sorted(set(curve.seeds)))),
                "actions": _range(curve.ends, ","),
                LAST: shown(statistics.band([curve.final])),
                "CSAC-beta ahead by": shown(lead and lead.final, "+"),
                "P(CSAC-beta ahead)": shown(lead and lead.improvement),
                AREA: shown(statistics.band([curve.area])),
                "CSAC-beta's area ahead by": shown(lead and lead.area, "+"),
                **{
                    name: shown(curve.rate(*sums), metric=metric)
                    for name, (*sums, metric) in RATES.items()
                },
                "paper": "-" if mark is None else f"{100 * mark:.0f} %",
                "time to 90 %": _times([_time_to_good(run) for run in curve.runs]),
                "training time": _times([float(run.seconds[-1]) for run in curve.runs]),
            }
        )
    return rows


def _times(seconds: Sequence[float | None]) -> str:
    """Least and most of some times; not every run need have one."""
    there = [time for time in seconds if time is not None]
    some = f" ({len(there)} of {len(seconds)} runs)" if len(there) < len(seconds) else ""
    return f"{_range(there, '.0f')} s{some}" if there else "-"


def _range(values: Sequence[float], spec: str) -> str:
    return " to ".join(dict.fromkeys(format(end, spec) for end in (min(values), max(values))))


def evaluation(report: Report) -> Table:
    """What policies reached: a row per part of a suite, and their mean."""
    return [_evaluation_row(one) for score in report.scores for one in score.split()]


def _evaluation_row(score: Score) -> dict[str, str]:
    runs = sum(map(len, score.parts.values()))
    counts = {"runs": str(score.most_runs), "episodes": str(score.episodes * runs)}
    return _first_cells(score) | counts | _metric_cells(score.band)


def _metric_cells(band: Callable[[str], Band | None], sign: str = "") -> dict[str, str]:
    titles = recorded.METRICS.items()
    return {title: shown(band(metric), sign, metric) for metric, title in titles}


def differences(report: Report) -> Table:
    """By how many points CSAC-beta is ahead, a row per other variant and part."""
    return [
        _pair_cells(ours, theirs)
        | _metric_cells(compared(ours, theirs, statistics.difference, recorded.METRICS).get, "+")
        for ours, theirs in pairs(report)
    ]


def improvements(report: Report) -> Table:
    """How probably a seed of CSAC-beta is ahead of one of another variant, row by row as in
    `differences`."""
    rows = []
    for ours, theirs in pairs(report):
        bands = compared(ours, theirs, statistics.improvement, IMPROVED)
        cells = {recorded.METRICS[name]: shown(bands.get(name)) for name in IMPROVED}
        rows.append(_pair_cells(ours, theirs) | cells)
    return rows


def _pair_cells(ours: Score, theirs: Score) -> dict[str, str]:
    names = {"ahead": label(ours.variant), "of": label(theirs.variant)}
    return names | _place_cells(ours)


def failures(report: Report) -> Table:
    """Causes of failure, all runs summed: how many, and of how many."""
    told = [
        (score.only(part), [one.metrics["failures"] for one in runs])
        for score in report.scores
        for part, runs in score.parts.items()
        if all("failures" in one.metrics for one in runs)
    ]
    causes = dict.fromkeys(cause for _, runs in told for run in runs for cause in run)
    return [
        _first_cells(score) | {cause.replace("_", " "): _sum(runs, cause) for cause in causes}
        for score, runs in told
    ]


def _sum(runs: Sequence[recorded.Json], cause: str) -> str:
    """The cases of a cause in several runs, and what they are cases of."""
    shares = [run[cause] for run in runs if cause in run]
    n = sum(share["n"] for share in shares)
    cases = sum(round(share["n"] * (share["value"] or 0.0)) for share in shares)
    return f"{cases} / {n}" if n else "-"


def _first_cells(score: Score) -> dict[str, str]:
    name = label(score.variant) if score.policy == "learned" else score.policy
    return {"policy": name, **_place_cells(score)}


def _place_cells(score: Score) -> dict[str, str]:
    part, *others = score.parts
    part = f"mean of {len(score.parts)} parts" if others else part
    part = part if part == score.suite else f"{score.suite}: {part}"
    return {"part": part, "physics, robot, seed": score.world}


def provenance(report: Report) -> Table:
    """Where every number comes from, a row per file."""
    every: list[RecordedRun | Evaluation] = [*report.results.runs, *report.results.evaluations]
    by_path = {one.path: one for one in every}
    trained = {run.path.parent: run.config for run in report.results.runs}
    root = os.path.commonpath([path.parent for path in by_path]) if by_path else ""
    return [
        {
            "file": os.path.relpath(path, root),
            "settings as a command": recorded.command(one, trained.get(path.parent)),
            "device": one.record.get("device") or "-",
            "versions": _versions(one.record) or "-",
            "commit": str(one.record.get("commit") or "-")[:10],
            "wall time": _wall_time(one.record),
        }
        for path, one in by_path.items()
    ]


def _versions(record: recorded.Json) -> str:
    found = (record.get("versions") or {}).items()
    return ", ".join(f"{name} {n}" for name, n in found if name in ("python", "jax", "mujoco"))


def _wall_time(record: recorded.Json) -> str:
    seconds, whole = record["wall_seconds"], ", whole sweep" * ("settings" in record)
    return "-" if seconds is None else f"{seconds:.0f} s{whole}"


def shown(band: Band | None, sign: str = "", metric: str = "") -> str:
    """A band as blocks per action, counts per episode or in per cent; with a sign, as a difference
    in points."""
    if band is None:
        return "-"
    if metric in (*PER_ACTION, *PER_EPISODE):
        scale, digits, unit = 1, 3 if metric in PER_ACTION else 2, ""
    else:
        scale, digits, unit = 100, 1, "" if sign else " %"
    value, *ends = (f"{scale * x:{sign}.{digits}f}" for x in band[:3] if x is not None)
    return f"{value}{unit} ({' to '.join(ends)})" if ends else f"{value}{unit}"


EXPLAINED = (
    "Several runs: the interquartile mean, and in brackets its 95 % band. The bootstrap is "
    "hierarchical: it draws seeds, then the hosts that a drawn seed ran on. "
    "A method that changes many settings has the name of its folder, an evaluation of it also that "
    "of its file; their commands stand under provenance. "
    "One run: its value; where it was evaluated, the 95 % interval of its episodes. "
    f"Final success: over the last {GRASP_WINDOW} grasps. "
    "Area under the curve: of that success over all actions, divided by their number. "
    "Rates in the training table are over all of training. "
    "Differences: of interquartile means, in points of per cent. "
    "Probability of improvement: that a seed of one method is above one of the other. "
    "Lifted / grasps, mean of episodes, is the paper's action efficiency; it charges nothing for "
    "pushes. "
    "`csac_jax/evaluation/metrics.py` defines the metrics. "
    "Paper: numbers of CSAC's text (sec. 4.3, 4.4 and 5), for one scene and 2,500 actions. "
    "Only the preset `paper` keeps to that protocol."
)


def markdown(report: Report) -> str:
    """All tables and notes."""
    sections = {title: table_text(table) for title, table in tables(report).items()}
    if report.notes:
        sections["Notes"] = "\n".join(f"- {note}" for note in report.notes)
    return "\n\n".join([EXPLAINED, *(f"## {t}\n\n{text}" for t, text in sections.items())]) + "\n"


def table_text(table: Table) -> str:
    """A table in Markdown."""
    rows = [list(table[0]), *(list(row.values()) for row in table)]
    lines = ["| " + " | ".join(cell.replace("|", "/") for cell in row) + " |" for row in rows]
    lines.insert(1, "|" + "---|" * len(table[0]))
    return "\n".join(lines)
