"""The page of `csac-jax report --out`: figures and tables in one HTML file. Needs matplotlib."""

import html
from pathlib import Path

from csac_jax.report import charts, report as reporting
from csac_jax.report.report import Report

STYLE = """body { font: 15px/1.45 sans-serif; max-width: 76rem; margin: 2rem auto; padding: 0 1rem; color: #222 }
table { border-collapse: collapse; font-size: 13px; margin: 0.5rem 0 1.5rem }
th, td { border-bottom: 1px solid #ddd; padding: 0.25rem 0.6rem; text-align: left; vertical-align: top }
svg { max-width: 100%; height: auto }"""


def page(report: Report, figures: dict[str, str]) -> str:
    """One HTML page that needs no other file; figures by title, each an SVG."""
    body = ["<h1>csac_jax: results</h1>", f"<p>{html.escape(reporting.EXPLAINED)}</p>"]
    body += [f"<h2>{html.escape(title)}</h2>\n{svg}" for title, svg in figures.items()]
    for title, table in reporting.tables(report).items():
        body.append(
            f"<h2>{html.escape(title)}</h2>\n<table>{''.join(_row(row, i == 0) for i, row in enumerate(table))}</table>"
        )
    if report.notes:
        body.append(
            "<h2>Notes</h2>\n<ul>"
            + "".join(f"<li>{html.escape(note)}</li>" for note in report.notes)
            + "</ul>"
        )
    head = f'<meta charset="utf-8"><title>csac_jax: results</title><style>{STYLE}</style>'
    return (
        f"<!doctype html>\n<html lang='en'><head>{head}</head>\n<body>\n"
        + "\n".join(body)
        + "\n</body></html>\n"
    )


def _row(cells: list[str], head: bool) -> str:
    tag = "th" if head else "td"
    return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>\n"


def write(report: Report, folder: Path) -> list[Path]:
    """Writes the page, its figures and its tables; returns the files."""
    folder.mkdir(parents=True, exist_ok=True)
    drawn = charts.draw(report)
    figures = {chart.title: chart.svg for chart in drawn}
    files = {"index.html": page(report, figures), "results.md": reporting.markdown(report)}
    files |= {f"{chart.name}.svg": chart.svg for chart in drawn}
    for name, text in files.items():
        (folder / name).write_text(text)
    return [folder / name for name in files]
