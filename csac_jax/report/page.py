"""The page of `csac-jax report --out`: one file with tables, figures and episodes inside.

The page loads nothing from elsewhere. Needs the extra `report`.
"""

import base64
import itertools
import mimetypes
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import csac_jax
from csac_jax.report import figures, result_tables, results
from csac_jax.report.comparison import ResultReport, grouped
from csac_jax.report.result_tables import ResultTable
from csac_jax.report.variants import label

BETTER = {result_tables.LAST, result_tables.AREA, "blocks / action", "lifted / grasp"}
BETTER |= {results.METRICS[name] for name in result_tables.IMPROVED}
"""Columns in which more is better: the best of alike rows is bold."""
FOLDED = ("Differences in training", "Differences", "Failures", "Provenance")
MEDIA = {".png": "image", ".gif": "image", ".webp": "image", ".jpg": "image", ".mp4": "video"}
LARGEST = 8 * 2**20  # bytes of a picture or video that the page takes up
MOST_MEDIA = 12


def write(report: ResultReport, paths: Sequence[Path], folder: Path) -> list[Path]:
    """Writes index.html, which needs no other file, and results.md. Pictures and videos that lie in
    `paths`, as `play` writes them, are in the page."""
    folder.mkdir(parents=True, exist_ok=True)
    pages = {"index.html": render(report, paths), "results.md": result_tables.markdown(report)}
    for name, text in pages.items():
        (folder / name).write_text(text)
    return [folder / name for name in pages]


def render(report: ResultReport, paths: Sequence[Path]) -> str:
    """Returns the page as HTML."""
    import jinja2

    source = Path(__file__).with_name("page.html").read_text()
    template = jinja2.Template(source, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    tables = {title: _cells(report, one) for title, one in result_tables.tables(report).items()}
    drawn = [
        (chart.title, _url("image/svg+xml", figures.svg(chart.figure)))
        for chart in figures.draw(report)
    ]
    return template.render(
        version=csac_jax.__version__,
        explained=result_tables.EXPLAINED,
        figures=drawn,
        tables=tables,
        folded=FOLDED,
        media=list(media(paths)),
        notes=report.notes,
    )


def _cells(report: ResultReport, table: ResultTable) -> list[list[tuple[str, bool]]]:
    """Returns the rows of a table as (text, is best); the first row is its head."""
    variants = (one.variant for one in (*report.curves, *report.scores))
    best = _best(table, {label(one): one.preset for one in variants})
    rows = ([(row[name], (i, name) in best) for name in row] for i, row in enumerate(table))
    return [[(name, False) for name in table[0]], *rows]


def _best(table: ResultTable, presets: dict[str, str]) -> set[tuple[int, str]]:
    """Finds row and column of the largest values among methods of the same preset and scenes."""

    def alike(i: int) -> tuple[Any, ...] | None:
        name, *_ = table[i].values()
        place = presets.get(name), table[i].get("part"), table[i].get("physics, robot, seed")
        return place if name in presets else None

    best = set()
    for place, rows in grouped(range(len(table)), alike).items():
        for column in BETTER & set(table[0]) if place else ():
            values = {i: _number(table[i][column]) for i in rows if table[i][column] != "-"}
            if len(values) > 1:
                best |= {(i, column) for i in values if values[i] == max(values.values())}
    return best


def _number(text: str) -> float:
    return float(text.split()[0].replace(",", ""))


def media(paths: Iterable[Path]) -> Iterator[tuple[str, str, str]]:
    """Yields kind (image or video), name and data, as a URL, of the first few pictures and videos
    in these folders and the folders in them."""
    folders = [path for path in paths if path.is_dir()]
    below = (sorted(filter(_is_medium, folder.rglob("*"))) for folder in folders)
    for path in itertools.islice(itertools.chain.from_iterable(below), MOST_MEDIA):
        kind = mimetypes.guess_type(path.name)[0] or "image/webp"
        yield MEDIA[path.suffix], str(path), _url(kind, path.read_bytes())


def _is_medium(path: Path) -> bool:
    skipped = set(results.SKIPPED) & set(path.parts)
    fits = path.suffix in MEDIA and not skipped and path.is_file()
    return fits and path.stat().st_size <= LARGEST


def _url(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
