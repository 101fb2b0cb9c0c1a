"""`csac-jax report`: recorded runs and evaluations, together. Needs no JAX."""

import dataclasses
from pathlib import Path

import tyro

from csac_jax.cli import guards, parsing
from csac_jax.cli.errors import BadArgumentsError, FailedError, as_bad_arguments
from csac_jax.io import files


@dataclasses.dataclass(frozen=True)
class ReportOptions:
    """Brings recorded runs and evaluations together, over their seeds; reads only, needs no JAX."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of runs, or of folders of runs, and files that `eval --json` wrote."""
    out: Path | None = None
    """Folder to write a page with figures to, index.html; needs the extra `bench`."""
    json: Path | None = None
    """File to write the numbers to, as JSON."""


def run(arguments: list[str]) -> int:
    """Prints the tables, writes the page; returns the exit code."""
    options = parsing.parse(ReportOptions, arguments, "report")
    if not options.runs:
        raise BadArgumentsError(
            "report: give at least one folder of a run, or a file of `eval --json`"
        )
    if options.out is not None:
        guards.check_extra("--out", "matplotlib", "bench")
    from csac_jax.report import report as reporting, results

    with as_bad_arguments(ValueError):
        found = reporting.build(results.read(options.runs))
    if not (found.curves or found.scores):
        raise FailedError("; ".join(found.notes))
    print(reporting.markdown(found), end="")
    if options.out is not None:
        from csac_jax.report import page

        print(*page.write(found, options.out), sep="\n")
    if options.json is not None:
        files.write_json(options.json, reporting.as_json(found))
    return 0
