"""The benchmarks' own arithmetic."""

import contextlib
import json
import subprocess
import sys

import pytest

from csac_jax.errors import FailedError
from experiments import index
from experiments.bench import __main__ as page, serve


def test_service_that_does_not_start_says_why(monkeypatch: pytest.MonkeyPatch):
    """Claim: a service that ends before it answers is one line, with its exit code and the last
    line that it wrote to stderr."""
    text = "import sys; sys.stderr.write('a warning\\nno such extra\\n'); sys.exit(2)"
    start = subprocess.Popen
    monkeypatch.setattr(serve, "body", bytes)
    monkeypatch.setattr(
        serve.subprocess, "Popen", lambda _, **pipes: start([sys.executable, "-c", text], **pipes)
    )
    with pytest.raises(FailedError, match=r"did not start \(exit code 2\): no such extra$"):
        serve.measure(1, 9)


def test_page_reads_what_benchmarks_write():
    """Claim: the main figures of the page are those of a recorded result of each benchmark."""
    for name, places in page.FIGURES.items():
        records = json.loads((index.RESULTS / "bench" / f"{name}.json").read_text())
        shown = []
        for record in records.values():
            with contextlib.suppress(KeyError, IndexError):
                shown.append(page.rows(name, {"wall_seconds": 1, **record}))
        assert any(len(rows) == 1 + len(places) for rows in shown), name
