"""A table of evaluations, suite by suite."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from csac_jax.evaluation.statistics import Band
from csac_jax.report import result_tables

METRICS = {
    "grasp_success": "grasp success",
    "completion": "completion",
    "declutter_rate": "objects taken",
    "action_efficiency": "objects per action",
}
Row = tuple[str, ...]


def rows(results: Iterable[dict[str, Any]]) -> list[Row]:
    """Builds a row for each part of each result of `csac-jax eval`: suite, policy, episodes and
    METRICS."""
    table = []
    for result in results:
        suite = Path(result["suite"]).stem
        for part, summary in result.get("parts", {suite: result}).items():
            bands = [Band(**entry) if entry["n"] else None for entry in map(summary.get, METRICS)]
            name = part if part == suite else f"{suite}, {part}"
            table.append((name, result["policy"], str(result["episodes"]), *shown(bands)))
    return table


def shown(bands: Iterable[Band | None]) -> list[str]:
    """Formats a band of each of METRICS; a dash where there is none."""
    return [
        result_tables.shown(band, metric=name) for band, name in zip(bands, METRICS, strict=True)
    ]


def markdown(table: Iterable[Row]) -> str:
    """Writes rows as a Markdown table."""
    head = ("suite", "policy", "episodes", *METRICS.values())
    named = [dict(zip(head, row, strict=True)) for row in table]
    return f"{result_tables.table_text(named)}\n\nIn brackets: 95 % intervals.\n"
