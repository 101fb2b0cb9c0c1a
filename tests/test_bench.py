"""The benchmarks' own arithmetic."""

import contextlib
import json
import subprocess
import sys

import pytest

from csac_jax.errors import FailedError, SettingsError
from experiments import index
from experiments.bench import __main__ as page, serve, step_kernels


def test_time_in_which_kernels_run():
    """Claim: the step lasts from the first kernel's start to the last one's end; names tell what a
    kernel does; a trace without a GPU is refused."""
    matrix, sums = "sm80_xmma_fprop_implicit_gemm_bf16", "input_reduce_select_fusion_4"
    table = step_kernels.table([(matrix, 1.0, 3.0), (sums, 4.0, 5.0), (matrix, 8.0, 11.0)])
    assert (table["step_ms"], table["busy"]) == (10.0, 0.6)
    assert table["kinds"]["products"] == {"ms": 5.0, "launches": 2}
    assert table["kinds"]["reductions"] == {"ms": 1.0, "launches": 1}
    with pytest.raises(SettingsError, match="no GPU ran a kernel"):
        step_kernels.table([])


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
