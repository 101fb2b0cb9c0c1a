"""Recorded results as numbers and tables; every number comes from a file that names its
provenance."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from csac_jax.constants import GRASP_WINDOW
from csac_jax.evaluation import statistics
from csac_jax.evaluation.statistics import Band
from csac_jax.report import results as recorded
from csac_jax.report.results import METRIC_NAMES, Evaluation, Results, Run, Variant

NAMES = {
    "grasp_only": "Grasping-only",
    "reactive": "P+G reactive",
    "vpg": "VPG",
    "csac": "CSAC",
    "csac_per": "CSAC-PER",
    "csac_beta": "CSAC-beta",
}
PAPER_TRAINING = {"grasp_only": 0.50, "vpg": 0.75, "csac_per": 0.80, "csac_beta": 0.90}
"""Grasp success over the last 200 grasps of 2,500 actions, read off the text to figures 6 and 7
(CSAC sec. 4.3)."""
PAPER_ACTIONS = 2500
PAPER_CASES = {
    "completion": {"vpg": 0.60, "csac_beta": 0.90},
    "action_efficiency": {"vpg": 0.70, "csac_beta": 0.80},
}
"""Means of the four cases, figure 9 (sec. 4.4 and 5); the text gives no numbers for the others."""
GOOD = 0.9  # grasp success whose time is reported

TITLES = (
    "grasp success",
    "completion",
    "over reachable",
    "blocks / actions",
    "the same, completed episodes",
)
"""Of METRIC_NAMES, in tables."""

Table = list[list[str]]  # rows, the header first


class Curve(NamedTuple):
    """The runs of a variant together."""

    variant: Variant
    runs: list[Run]
    actions: np.ndarray  # [m] up to where the shortest run ends
    success: list[Band]  # [m]
    final: Band  # over the last grasps of each run, wherever it ends


class Score(NamedTuple):
    """The evaluations of a variant in one part of a suite together."""

    evaluations: list[Evaluation]
    variant: Variant
    policy: str
    suite: str
    part: str
    physics: str
    robot: str
    seed: int  # of the evaluation
    episodes: (
        int  # of each evaluation, which decide what scenes it begins with; 0 where it does not tell
    )

    @property
    def world(self) -> str:
        """Physics, robot and seed of the evaluation."""
        return f"{self.physics}, {self.robot}, {self.seed}"

    def band(self, metric: str) -> Band | None:
        """IQM of the runs' values with its band; of a single run, the interval of its own episodes.
        None: no cases."""
        entries = self._entries(metric)
        if not entries:
            return None
        if len(entries) == 1:
            return Band(entries[0]["value"], entries[0]["low"], entries[0]["high"], 1)
        return statistics.band([self.values(metric)])

    def values(self, metric: str) -> np.ndarray:
        """The runs' values, of those that have any."""
        return np.array([entry["value"] for entry in self._entries(metric)])

    def _entries(self, metric: str) -> list[recorded.Json]:
        return [
            one.metrics[metric] for one in self.evaluations if one.metrics.get(metric, {}).get("n")
        ]


class Gap(NamedTuple):
    """How far one variant is from another, of several seeds each, in the parts of a suite taken
    together."""

    ours: Variant  # CSAC-beta with the fewest settings changed
    theirs: Variant
    suite: str
    parts: tuple[str, ...]
    world: str  # physics, robot, seed
    bands: dict[str, Band]  # metric -> ours less theirs


class Report(NamedTuple):
    """Everything that tables and figures are made of."""

    curves: list[Curve]
    scores: list[Score]
    results: Results
    notes: list[str]


def build(results: Results) -> Report:
    """Runs and evaluations brought together over their seeds."""
    notes = list(results.notes)
    grouped = _grouped(results.runs, lambda run: recorded.variant(run.config))
    made = [_curve(variant, runs, notes) for variant, runs in grouped.items()]
    parts = _grouped(results.evaluations, _place)
    scores = [Score(evaluations, *place) for place, evaluations in parts.items()]
    return Report(made, scores, results, notes)


def _grouped(items: Iterable[Any], key: Callable[[Any], Any]) -> dict[Any, list[Any]]:
    found: dict[Any, list[Any]] = {}
    for item in items:
        found.setdefault(key(item), []).append(item)
    return found


def _place(one: Evaluation) -> tuple[Variant, str, str, str, str, str, int, int]:
    sim, episodes = one.config["sim"], one.metrics.get("counts", {}).get("episodes", 0)
    variant = recorded.variant(one.config)
    if one.policy != "learned":  # what its run was trained with does not matter
        variant = Variant(variant.preset, one.policy, ())
    world = sim.get("physics", "mjx"), sim.get("robot", "hand")
    return (variant, one.policy, one.suite, one.part, *world, one.seed, episodes)


def _curve(variant: Variant, runs: list[Run], notes: list[str]) -> Curve:
    ends = sorted({int(run.actions[-1]) for run in runs})
    if len(ends) > 1:
        several = ", ".join(f"{end:,}" for end in ends)
        notes.append(
            f"{label(variant)}: runs end at {several} actions; their curve is drawn up to {ends[0]:,}"
        )
    if len(runs) < 2:
        notes.append(f"{label(variant)}: one run only, so its curve has no band")
    actions, success = statistics.curves([(run.actions, run.success) for run in runs])
    return Curve(
        variant,
        runs,
        actions,
        success,
        statistics.band([np.array([run.success[-1] for run in runs])]),
    )


def label(variant: Variant, preset: bool = True, most: int | None = None) -> str:
    """Name of a variant in figures and tables, with at most so many of the settings that it
    changes."""
    name = NAMES.get(variant.algo, variant.algo)
    changed = [f"{setting} {value}" for setting, value in variant.changed]
    if most is not None and len(changed) > most:
        changed[most:] = [f"others ({len(changed) - most})"]
    return ", ".join([f"{name} ({variant.preset})" if preset else name, *changed])


# Numbers.


def gaps(report: Report) -> list[Gap]:
    """CSAC-beta less every other variant that was measured in the same scenes, several seeds of
    both: part by part, then over the parts of the suite."""
    found: list[Gap] = []
    several = [one for one in report.scores if one.policy == "learned" and len(one.evaluations) > 1]
    for (_, suite, world, _), scores in _grouped(several, _scenes).items():
        by_variant: dict[Variant, list[Score]] = _grouped(scores, lambda score: score.variant)
        first = min(
            by_variant, key=lambda variant: (variant.algo != "csac_beta", len(variant.changed))
        )
        for other, theirs in by_variant.items():
            of = {score.part: score for score in theirs}
            pairs = [(score, of[score.part]) for score in by_variant[first] if score.part in of]
            if other == first or first.algo != "csac_beta" or not pairs:
                continue
            for shared in [[pair] for pair in pairs] + ([pairs] if len(pairs) > 1 else []):
                parts = tuple(score.part for score, _ in shared)
                found.append(Gap(first, other, suite, parts, world, _bands(shared)))
    return found


def lead(report: Report, curve: Curve) -> Band | None:
    """By how much CSAC-beta with the fewest settings changed ends ahead of another variant that was
    trained as long in the same scenes and task, several seeds of both; None where there is no such
    pair."""
    alike = [
        one
        for one in report.curves
        if _trained(one) == _trained(curve) and one.variant.algo == "csac_beta"
    ]
    first = min(alike, key=lambda one: len(one.variant.changed), default=curve)
    if first is curve or min(len(first.runs), len(curve.runs)) < 2:
        return None
    ours, theirs = ([np.array([run.success[-1] for run in one.runs])] for one in (first, curve))
    return statistics.difference(ours, theirs)


def _trained(curve: Curve) -> tuple[Any, ...]:
    """What curves must share to be compared."""
    world = [
        change
        for change in curve.variant.changed
        if change[0].startswith(("task.", "scene.", recorded.SHAPE))
    ]
    return curve.variant.preset, int(curve.actions[-1]), *world


def _scenes(score: Score) -> tuple[str, str, str, int]:
    return score.variant.preset, score.suite, score.world, score.episodes


def _bands(pairs: Sequence[tuple[Score, Score]]) -> dict[str, Band]:
    """The difference in every metric that all evaluations have."""
    bands = {}
    for metric in METRIC_NAMES:
        ours, theirs = ([one.values(metric) for one in side] for side in zip(*pairs, strict=True))
        if min(len(values) for values in (*ours, *theirs)) > 1:
            bands[metric] = statistics.difference(ours, theirs)
    return bands


def _seeds(runs: Sequence[Run | Evaluation]) -> str:
    return ", ".join(str(seed) for seed in sorted(one.config.get("seed", 0) for one in runs))


def _time_to(run: Run) -> float | None:
    """Training seconds after which the success of a full window first reached GOOD."""
    there = np.flatnonzero((run.success >= GOOD) & (run.grasps >= GRASP_WINDOW))
    return float(run.seconds[there[0]]) if there.size else None


def as_json(report: Report) -> dict[str, Any]:
    """The report's numbers, plain values only."""
    return {
        "curves": [
            {
                "preset": curve.variant.preset,
                "algo": curve.variant.algo,
                "changed": dict(curve.variant.changed),
                "seeds": [run.config.get("seed", 0) for run in curve.runs],
                "final": curve.final._asdict(),
                "ahead": None if (ahead := lead(report, curve)) is None else ahead._asdict(),
                "seconds_to_90": [_time_to(run) for run in curve.runs],
                "seconds": [float(run.seconds[-1]) for run in curve.runs],
                "actions": curve.actions.tolist(),
                "success": [band._asdict() for band in curve.success],
            }
            for curve in report.curves
        ],
        "scores": [
            {
                **{
                    name: getattr(score, name)
                    for name in Score._fields
                    if name not in ("variant", "evaluations")
                },
                "preset": score.variant.preset,
                "algo": score.variant.algo,
                "changed": dict(score.variant.changed),
                "seeds": [one.config.get("seed", 0) for one in score.evaluations],
                "metrics": {
                    name: found._asdict()
                    for name in METRIC_NAMES
                    if (found := score.band(name)) is not None
                },
            }
            for score in report.scores
        ],
        "differences": [
            {
                "ours": {"algo": gap.ours.algo, "changed": dict(gap.ours.changed)},
                "theirs": {"algo": gap.theirs.algo, "changed": dict(gap.theirs.changed)},
                **{name: getattr(gap, name) for name in ("suite", "parts", "world")},
                "metrics": {name: band._asdict() for name, band in gap.bands.items()},
            }
            for gap in gaps(report)
        ],
        "provenance": [
            dict(zip(provenance(report)[0], row, strict=True)) for row in provenance(report)[1:]
        ],
        "notes": report.notes,
    }


# Tables.


def shown(band: Band | None) -> str:
    """A share in per cent with its band."""
    if band is None:
        return "-"
    if band.low is None or band.high is None:
        return f"{100 * band.value:.1f} %"
    return f"{100 * band.value:.1f} % ({100 * band.low:.1f} to {100 * band.high:.1f})"


def _range(values: Sequence[float | None]) -> str:
    """Least and most of some times."""
    there = [value for value in values if value is not None]
    if not there:
        return "-"
    text = f"{min(there):.0f} s" if len(there) == 1 else f"{min(there):.0f} to {max(there):.0f} s"
    return text if len(there) == len(values) else f"{text} ({len(there)} of {len(values)} runs)"


def training(report: Report) -> Table:
    """How training went, a row per variant."""
    last = f"success, last {GRASP_WINDOW} grasps"
    rows = [
        [
            "method",
            "seeds",
            "actions",
            last,
            "CSAC-beta ahead by",
            "paper",
            "time to 90 %",
            "training time",
        ]
    ]
    for curve in report.curves:
        mark = PAPER_TRAINING.get(curve.variant.algo) if curve.variant.method else None
        ends = sorted({int(run.actions[-1]) for run in curve.runs})
        rows.append(
            [
                label(curve.variant),
                _seeds(curve.runs),
                " to ".join(f"{end:,}" for end in ([ends[0], ends[-1]] if len(ends) > 1 else ends)),
                shown(curve.final),
                _points(lead(report, curve)),
                "-" if mark is None else f"{100 * mark:.0f} %",
                _range([_time_to(run) for run in curve.runs]),
                _range([float(run.seconds[-1]) for run in curve.runs]),
            ]
        )
    return rows


def evaluation(report: Report) -> Table:
    """What policies reached, a row per part of a suite."""
    rows = [["policy", "part", "physics, robot, seed", "runs", "episodes", *TITLES]]
    for score in report.scores:
        episodes = score.episodes * len(score.evaluations)
        bands = [shown(score.band(metric)) for metric in METRIC_NAMES]
        rows.append([*_named(score), str(len(score.evaluations)), str(episodes), *bands])
    return rows


def differences(report: Report) -> Table:
    """By how many points CSAC-beta is ahead, a row for each other variant and part, and for all
    parts together."""
    rows = [["ahead", "of", "part", "physics, robot, seed", *TITLES]]
    for gap in gaps(report):
        part = gap.parts[0] if len(gap.parts) == 1 else f"mean of {len(gap.parts)} parts"
        where = part if part == gap.suite else f"{gap.suite}: {part}"
        cells = [_points(gap.bands.get(metric)) for metric in METRIC_NAMES]
        rows.append([label(gap.ours), label(gap.theirs), where, gap.world, *cells])
    return rows


def _points(band: Band | None) -> str:
    """A difference in points of per cent with its band."""
    if band is None or band.low is None or band.high is None:
        return "-"
    return f"{100 * band.value:+.1f} ({100 * band.low:+.1f} to {100 * band.high:+.1f})"


def failures(report: Report) -> Table:
    """What went wrong in evaluations that tell causes apart, as counts and what they are counts of,
    all runs summed."""
    scores = [
        score
        for score in report.scores
        if all("failures" in one.metrics for one in score.evaluations)
    ]
    if not scores:
        return [[]]
    causes = list(scores[0].evaluations[0].metrics["failures"])
    rows = [
        ["policy", "part", "physics, robot, seed", *(cause.replace("_", " ") for cause in causes)]
    ]
    for score in scores:
        found = [[one.metrics["failures"][cause] for one in score.evaluations] for cause in causes]
        sums = [
            (sum(round(e["n"] * (e["value"] or 0.0)) for e in each), sum(e["n"] for e in each))
            for each in found
        ]
        rows.append([*_named(score), *(f"{count} / {n}" if n else "-" for count, n in sums)])
    return rows


def _named(score: Score) -> list[str]:
    """The first cells of a row about a score."""
    name = score.policy if score.policy != "learned" else label(score.variant)
    part = score.part if score.part == score.suite else f"{score.suite}: {score.part}"
    return [name, part, score.world]


def provenance(report: Report) -> Table:
    """Where every number comes from, a row per file."""
    rows = [
        [
            "file",
            "settings as a command",
            "preset",
            "seed",
            "device",
            "versions",
            "commit",
            "wall time",
        ]
    ]
    every: list[Run | Evaluation] = [*report.results.runs, *report.results.evaluations]
    files = {one.path: one for one in every}
    for path, one in files.items():
        versions = one.record.get("versions") or {}
        names = [
            f"{name} {versions[name]}" for name in ("python", "jax", "mujoco") if name in versions
        ]
        seconds = one.record.get("wall_seconds" if isinstance(one, Run) else "seconds")
        if seconds is None and isinstance(one, Run):
            seconds = float(one.seconds[-1])
        rows.append(
            [
                path.name if path.name != files.METRICS else f"{path.parent.name}/{path.name}",
                recorded.command(one),
                one.config.get("preset", "-"),
                str(one.config.get("seed", "-")),
                one.record.get("device") or "-",
                ", ".join(names) or "-",
                str(one.record.get("commit") or "-")[:10],
                "-"
                if seconds is None
                else f"{seconds:.0f} s" + (", whole sweep" if "settings" in one.record else ""),
            ]
        )
    return rows


def tables(report: Report) -> dict[str, Table]:
    """By title; those without a row are left out."""
    every = {
        "Training": training(report),
        "Evaluation": evaluation(report),
        "Differences": differences(report),
        "Failures": failures(report),
        "Provenance": provenance(report),
    }
    return {title: table for title, table in every.items() if len(table) > 1}


EXPLAINED = (
    "Several runs: interquartile mean and, in brackets, its 95 % band (bootstrap over seeds). One run: its value, and "
    "the 95 % interval of its episodes where it was evaluated. Differences: of the interquartile means, points of per "
    "cent, bootstrap over the seeds of both. Metrics are defined in csac_jax/evaluation/metrics.py. "
    "Paper: numbers of CSAC's text, sec. 4.3, 4.4 and 5, of one scene and 2,500 actions; of the presets only `paper` "
    "keeps to that."
)


def markdown(report: Report) -> str:
    """All tables and notes."""
    parts = []
    for title, table in tables(report).items():
        head, *rows = [
            "| " + " | ".join(cell.replace("|", "/") for cell in row) + " |" for row in table
        ]
        parts.append("\n".join([f"## {title}", "", head, "|" + "---|" * len(table[0]), *rows]))
    notes = "\n".join(f"- {note}" for note in report.notes)
    return "\n\n".join([*parts, EXPLAINED, *([notes] if notes else [])]) + "\n"
