"""The page of `csac-jax report --out`. Needs the extra `report`."""

from pathlib import Path

import jinja2

from csac_jax.report import charts, tables
from csac_jax.report.comparison import Report

TEMPLATE = Path(__file__).with_name("page.html")


def page(report: Report, figures: dict[str, str]) -> str:
    """One HTML page that needs no other file; figures by title, each an SVG."""
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(TEMPLATE.read_text()).render(
        explained=tables.EXPLAINED,
        figures=figures,
        tables=tables.tables(report),
        notes=report.notes,
    )


def write(report: Report, folder: Path) -> list[Path]:
    """Writes the page, its figures and its tables; returns the files."""
    folder.mkdir(parents=True, exist_ok=True)
    drawn = [(chart, charts.svg(chart.figure)) for chart in charts.draw(report)]
    files = {f"{chart.name}.svg": svg for chart, svg in drawn}
    files["index.html"] = page(report, {chart.title: svg for chart, svg in drawn})
    files["results.md"] = tables.markdown(report)
    for name, text in files.items():
        (folder / name).write_text(text)
    return [folder / name for name in files]
