"""Tables of text, and how their cells show a number."""

from collections.abc import Mapping, Sequence

from csac_jax.evaluation.metrics import PER_ACTION, PER_EPISODE
from csac_jax.evaluation.statistics import Band

ResultTable = list[dict[str, str]]  # rows; column -> cell


def shown(band: Band | None, sign: str = "", metric: str = "") -> str:
    """Formats a band as blocks per action, counts per episode or per cent; with a sign as a
    difference, in points."""
    if band is None:
        return "-"
    if metric in (*PER_ACTION, *PER_EPISODE):
        scale, digits, unit = 1, 3 if metric in PER_ACTION else 2, ""
    else:
        scale, digits, unit = 100, 1, "" if sign else " %"
    value, *ends = (f"{scale * x:{sign}.{digits}f}" for x in band[:3] if x is not None)
    return f"{value}{unit} ({' to '.join(ends)})" if ends else f"{value}{unit}"


def table_text(table: Sequence[Mapping[str, str]]) -> str:
    """Writes a table as Markdown."""
    rows = [list(table[0]), *(list(row.values()) for row in table)]
    lines = ["| " + " | ".join(cell.replace("|", "/") for cell in row) + " |" for row in rows]
    lines.insert(1, "|" + "---|" * len(table[0]))
    return "\n".join(lines)
