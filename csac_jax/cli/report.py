"""`csac-jax report`: recorded runs and evaluations, together. Needs no JAX."""

import dataclasses
from pathlib import Path

import tyro

from csac_jax.cli import parsing
from csac_jax.cli.failures import check_extra
from csac_jax.cli.parsing import PROGRAM
from csac_jax.errors import FailedError, SettingsError
from csac_jax.io import files
from csac_jax.section import require


@dataclasses.dataclass(frozen=True)
class ReportOptions:
    """Tables of recorded runs and evaluations over their seeds; needs no JAX."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of runs, archives of them (.tar.xz), folders of these, and files of `eval`."""
    out: Path | None = None
    """Page to write, a name in .html, with curves, pictures and videos, or a folder for the page
    and its tables as Markdown; needs the extra `report`."""
    markdown: Path | None = None
    """File to write the tables to, as a page of documentation."""
    json: Path | None = None
    """File to write the numbers to, as JSON."""
    reference: str | None = None
    """Algorithm that the others are compared with; by default csac_beta, where it was run."""


def run(arguments: list[str]) -> int:
    """Prints the tables and writes the files that were asked for; returns the exit code."""
    options = parsing.parse(ReportOptions, arguments, "report")
    if not options.runs:
        raise SettingsError("report: give at least one folder of a run or file of `eval --json`")
    if options.out is not None:
        check_extra("--out", "jinja2", "report")
        is_page, exists = options.out.suffix == ".html", options.out.exists()
        fits = not exists or options.out.is_dir() != is_page
        require(fits, f"--out: {options.out} is a {'folder' if is_page else 'file'}; name another")
    from csac_jax.report import comparison, result_tables, results

    recorded = results.read(options.runs)
    if not (recorded.runs or recorded.evaluations or recorded.suites):
        raise FailedError("; ".join(recorded.notes))
    report = comparison.build(recorded, options.reference)
    text = result_tables.markdown(report)
    print(text, end="")
    if options.markdown is not None:
        runs = " ".join(map(str, options.runs))
        command = f"{PROGRAM} report {runs} --markdown {options.markdown}"
        files.replace(options.markdown, f"# Results\n\nWritten by `{command}`.\n\n{text}")
    if options.out is not None:
        from csac_jax.report import page

        print(*page.write(report, options.runs, options.out), sep="\n")
    if options.json is not None:
        files.write_json(options.json, result_tables.as_json(report))
    return 0
