"""The page of `csac-jax report --out`. Needs the extra `report`."""

from pathlib import Path

import jinja2

from csac_jax.report import charts, tables
from csac_jax.report.comparison import Report

TEMPLATE = Path(__file__).with_name("page.html")


def write(report: Report, folder: Path) -> list[Path]:
    """Writes a page that needs no other file, its figures and its tables; returns the files."""
    folder.mkdir(parents=True, exist_ok=True)
    drawn = [(chart, charts.svg(chart.figure)) for chart in charts.draw(report)]
    template = jinja2.Template(
        TEMPLATE.read_text(), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    page = template.render(
        explained=tables.EXPLAINED,
        figures={chart.title: svg for chart, svg in drawn},
        tables=tables.tables(report),
        notes=report.notes,
    )
    files = {f"{chart.name}.svg": svg for chart, svg in drawn}
    files |= {"index.html": page, "results.md": tables.markdown(report)}
    for name, text in files.items():
        (folder / name).write_text(text)
    return [folder / name for name in files]
