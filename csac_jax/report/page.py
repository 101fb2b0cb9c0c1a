"""The page of `csac-jax report --out`: one file with tables, curves and episodes inside.

Curves are plotly's, whose script stands in the page once; nothing is loaded from elsewhere. Needs
the extra `report`.
"""

import base64
import itertools
import mimetypes
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import csac_jax
from csac_jax.report import comparison, plots, results, tables, wording
from csac_jax.report.comparison import NAMES, Report
from csac_jax.report.results import Variant
from csac_jax.report.tables import Table

BETTER = {tables.LAST, tables.AREA, "blocks / action", "lifted / grasp"}
BETTER |= {results.METRICS[name] for name in tables.IMPROVED}
"""Columns in which more is better: the best of alike rows is bold."""
BASELINES = ("random", "oracle")  # policies that nothing was learned for: never the best
FOLDED = ("Differences", "Probability of improvement", "Failures", "Provenance")
MEDIA = {".png": "image", ".gif": "image", ".webp": "image", ".jpg": "image", ".mp4": "video"}
LARGEST = 8 * 2**20  # bytes of a picture or video that the page takes up
MOST_MEDIA = 12


class Cell(NamedTuple):
    """A cell of a table."""

    text: str
    title: str = ""  # shown where the pointer rests
    best: bool = False


class Row(NamedTuple):
    """A row of a table, with the method that it is grouped by."""

    cells: list[Cell]
    group: str


class Shown(NamedTuple):
    """A table of the page."""

    title: str
    columns: list[str]
    rows: list[Row]
    folded: bool


class Medium(NamedTuple):
    """A picture or video."""

    kind: str  # image or video
    name: str
    data: str  # as a URL


def write(report: Report, paths: Sequence[Path], folder: Path) -> list[Path]:
    """Writes index.html, which needs no other file, and results.md. Pictures and videos that lie in
    `paths`, as `play` writes them, are in the page."""
    folder.mkdir(parents=True, exist_ok=True)
    files = {"index.html": render(report, paths), "results.md": tables.markdown(report)}
    for name, text in files.items():
        (folder / name).write_text(text)
    return [folder / name for name in files]


def render(report: Report, paths: Sequence[Path]) -> str:
    """The page."""
    import jinja2
    import plotly.offline

    shown = [_table(report, *item) for item in tables.tables(report).items()]
    source = Path(__file__).with_name("page.html").read_text()
    template = jinja2.Template(source, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    drawn = list(plots.draw(report))
    return template.render(
        version=csac_jax.__version__,
        facts=list(facts(report)),
        explained=tables.EXPLAINED,
        figures=drawn,
        script=plotly.offline.get_plotlyjs() if drawn else "",
        tables=[table for table in shown if not table.folded],
        folded=[table for table in shown if table.folded],
        media=list(media(paths)),
        notes=report.notes,
    )


def facts(report: Report) -> Iterator[tuple[str, str, str]]:
    """What a reader wants to know first, of each preset and suite: a title, the best value and what
    it is of."""
    for preset, curves in comparison.grouped(report.curves, lambda one: one.variant.preset).items():
        best = max(curves, key=lambda curve: curve.points()[1][-1].value)
        value = tables.shown(best.points()[1][-1])
        who = f"{wording.name_of(best.variant)}, best of {len(curves)}"
        yield f"{preset}: grasp success at the end of training", value, who
    learned = [score for score in report.scores if score.policy == "learned"]
    alike = comparison.grouped(learned, lambda one: (one.variant.preset, one.suite))
    for (preset, suite), scores in alike.items():
        bands = [(score.band("completion"), score) for score in scores]
        there = [(band, score) for band, score in bands if band is not None]
        if there:
            band, score = max(there, key=lambda pair: pair[0].value)
            who = f"{wording.name_of(score.variant)}, best of {len(scores)}"
            yield f"{preset}: completion in suite {suite}", tables.shown(band), who


def _table(report: Report, title: str, table: Table) -> Shown:
    """A table with names in words, grouped by method, the best in bold."""
    named = {comparison.label(one): one for one in _variants(report)}
    best = _best(table, named)
    rows = [
        Row(
            [_cell(named, text, (i, column) in best) for column, text in row.items()],
            _method(named, row),
        )
        for i, row in enumerate(table)
    ]
    order = [*NAMES.values(), *BASELINES]
    place = {name: number for number, name in enumerate(order)}
    if title != "Provenance":
        rows.sort(key=lambda row: place.get(row.group, len(order)))
    return Shown(title, list(table[0]), rows, title in FOLDED)


def _variants(report: Report) -> Iterator[Variant]:
    yield from (one.variant for one in itertools.chain(report.curves, report.scores))


def _method(named: dict[str, Variant], row: dict[str, str]) -> str:
    """What a row is grouped by: its method, whatever the settings; of a pair the other one."""
    first = row.get("of") or next(iter(row.values()))
    if (variant := named.get(first)) is None:
        return first
    return NAMES.get(variant.algo, variant.algo)


def _cell(named: dict[str, Variant], text: str, best: bool) -> Cell:
    if (variant := named.get(text)) is None:
        return Cell(text, best=best)
    flags = " ".join(f"--{name.replace('_', '-')} {value}" for name, value in variant.changed)
    title = f"{variant.preset} --algo {variant.algo} {flags}".rstrip()
    return Cell(f"{wording.name_of(variant)} ({variant.preset})", title, best)


def _best(table: Table, named: dict[str, Variant]) -> set[tuple[int, str]]:
    """Row and column of the largest values among the learned methods of one preset, measured in the
    same scenes; none where nothing is compared."""
    alike: dict[Any, list[int]] = {}
    for i, row in enumerate(table):
        first = next(iter(row.values()))
        if first in named and first not in BASELINES:
            place = (row.get("part"), row.get("physics, robot, seed"))
            alike.setdefault((named[first].preset, *place), []).append(i)
    found = set()
    for column, rows in itertools.product(BETTER & set(table[0]), alike.values()):
        values = {i: _number(table[i][column]) for i in rows}
        there = {i: value for i, value in values.items() if value is not None}
        if len(there) > 1:
            found |= {(i, column) for i, value in there.items() if value == max(there.values())}
    return found


def _number(text: str) -> float | None:
    """The number that a cell begins with."""
    try:
        return float(text.split()[0].replace(",", ""))
    except (ValueError, IndexError):
        return None


def media(paths: Iterable[Path]) -> Iterator[Medium]:
    """Pictures and videos in these folders and the folders in them, the first few."""
    folders = [path for path in paths if path.is_dir()]
    below = (sorted(one for one in folder.rglob("*") if _is_medium(one)) for folder in folders)
    for path in itertools.islice(itertools.chain.from_iterable(below), MOST_MEDIA):
        kind = mimetypes.guess_type(path.name)[0] or "image/webp"
        data = base64.b64encode(path.read_bytes()).decode()
        yield Medium(MEDIA[path.suffix], str(path), f"data:{kind};base64,{data}")


def _is_medium(path: Path) -> bool:
    skipped = set(results.SKIPPED) & set(path.parts)
    fits = path.suffix in MEDIA and not skipped and path.is_file()
    return fits and path.stat().st_size <= LARGEST
