"""The page of `csac-jax report --out`: one file with tables, figures and episodes inside.

The page loads nothing from elsewhere. Needs the extra `report`.
"""

import base64
import itertools
import mimetypes
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import csac_jax
from csac_jax.io import files
from csac_jax.report import figures, result_tables, results
from csac_jax.report.comparison import ResultReport

FOLDED = ("Differences in training", "Differences", "Provenance")
MEDIA = {".png": "image", ".gif": "image", ".webp": "image", ".jpg": "image", ".mp4": "video"}
LARGEST = 8 * 2**20  # bytes of a picture or video that the page takes up
MOST_MEDIA = 12


def write(report: ResultReport, paths: Sequence[Path], folder: Path) -> list[Path]:
    """Writes index.html, which needs no other file, and results.md. Pictures and videos that lie in
    `paths`, as `play` writes them, are in the page."""
    pages = {"index.html": render(report, paths), "results.md": result_tables.markdown(report)}
    for name, text in pages.items():
        files.replace(folder / name, text)
    return [folder / name for name in pages]


def render(report: ResultReport, paths: Sequence[Path]) -> str:
    """Returns the page as HTML."""
    import jinja2

    source = Path(__file__).with_name("page.html").read_text()
    template = jinja2.Template(source, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    drawn = [
        (chart.title, _url("image/svg+xml", figures.svg(chart.figure)))
        for chart in figures.draw(report)
    ]
    return template.render(
        version=csac_jax.__version__,
        explained=result_tables.EXPLAINED,
        figures=drawn,
        tables=result_tables.tables(report),
        folded=FOLDED,
        media=list(media(paths)),
        notes=report.notes,
    )


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
