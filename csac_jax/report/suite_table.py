"""A table of evaluations, suite by suite."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from csac_jax.evaluation.statistics import Band
from csac_jax.io import seal
from csac_jax.report import cells, variants
from csac_jax.report.cells import ResultTable

METRICS = {
    "grasp_success": "grasp success",
    "completion": "completion",
    "declutter_rate": "objects taken",
    "action_efficiency": "objects per action",
}
HEAD = ("suite", "policy", "episodes", *METRICS.values())
DIFFERS = "differs in"
RECORD = "record"  # of a benchmark, the name under which it stands
_ASIDE = {"suite", "part", "policy", "name", "episodes", "seed", "seconds", "device", "commit"}
_ASIDE |= {"about", "which", "policy_sha256", "scenes_sha256", seal.SHA256}
Row = tuple[str, ...]
Json = dict[str, Any]


def rows(results: Iterable[Json]) -> list[Row]:
    """Builds a row for each part of each result of `csac-jax eval`: suite, policy, episodes and
    METRICS."""
    return [_row(result, *part) for result in results for part in parts(result)]


def merged(results: Iterable[Json]) -> ResultTable:
    """Merges results of several policies suite by suite, what completes most first. A result that
    is given twice counts once. A column has the settings in which those of a suite differ."""
    each = {one.get(seal.SHA256, id(one)): one for one in results}.values()
    entries = [(result, *part) for result in each for part in parts(result)]
    entries.sort(key=lambda entry: (entry[1], -_completion(entry[2])))
    table = [
        dict(zip(HEAD, _row(*entry), strict=True))
        | {"seed": str(entry[0].get("seed", "-")), "sha256": entry[0].get(seal.SHA256, "-")[:12]}
        for entry in entries
    ]
    differing = _differing(entries)
    if any(differing):
        table = [row | {DIFFERS: text} for row, text in zip(table, differing, strict=True)]
    return table


def _differing(entries: list[tuple[Json, str, Json]]) -> list[str]:
    """Returns of each entry the settings that others of its suite's part have differently."""
    settings = [_settings(result) for result, *_ in entries]
    values: dict[tuple[str, str], set[str]] = {}
    for (_, part, _), own in zip(entries, settings, strict=True):
        for name, value in {RECORD: "", **own}.items():
            values.setdefault((part, name), set()).add(value)
    return [
        ", ".join(f"{name} {value}" for name, value in own.items() if len(values[part, name]) > 1)
        for (_, part, _), own in zip(entries, settings, strict=True)
    ]


def _settings(result: Json) -> dict[str, str]:
    """Returns the settings that a result was measured with; of a benchmark's those in its row."""
    if "config" in result:
        return variants.world_settings(result["config"])
    given = {name: value for name, value in result.items() if name not in _ASIDE}
    return {name: str(value) for name, value in given.items() if not isinstance(value, dict)}


def parts(result: Json) -> Iterator[tuple[str, Json]]:
    """Yields the name of each part, with that of its suite, and its metrics."""
    suite = Path(str(result["suite"])).stem
    for part, summary in result.get("parts", {suite: result}).items():
        yield part if part == suite else f"{suite}, {part}", summary


def _completion(summary: Json) -> float:
    return (summary.get("completion") or {}).get("value") or 0.0


def _row(result: Json, name: str, summary: Json) -> Row:
    policy = " ".join(str(result.get("name", result["policy"])).split())
    return name, policy, str(result["episodes"]), *shown(_band(summary.get(one)) for one in METRICS)


def _band(share: Json | None) -> Band | None:
    known = share is not None and share["n"] and share["value"] is not None
    return Band(*(share[key] for key in Band._fields)) if share and known else None


def shown(bands: Iterable[Band | None]) -> list[str]:
    """Formats a band of each of METRICS; a dash where there is none."""
    return [cells.shown(band, metric=name) for band, name in zip(bands, METRICS, strict=True)]


def markdown(table: Iterable[Row]) -> str:
    """Writes rows as a Markdown table."""
    named = [dict(zip(HEAD, row, strict=True)) for row in table]
    return f"{cells.table_text(named)}\n\nIn brackets: 95 % intervals.\n"
