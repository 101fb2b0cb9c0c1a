"""A twentieth of the fault-injection suite; `make test-faults` injects all of it."""

import zlib
from pathlib import Path

import numpy as np
import pytest

from tests.faults import harness

FAULTS = harness.load()


def test_the_page_is_short_and_its_table_whole():
    """Claim: docs/reliability.md has at most 1,200 words besides its whole table."""
    page = (harness.ROOT / "docs/reliability.md").read_text()
    rows = [line for line in page.splitlines() if line.startswith("|")]
    assert [row.split(" | ")[0].strip("| ") for row in rows[2:]] == list(FAULTS)
    assert len(page.split()) - sum(len(row.split()) for row in rows) <= 1200


def test_a_seed_draws_other_faults(tmp_path: Path):
    """Claim: without a seed the faults are those of every other call; a seed draws others, which it
    draws again."""

    def drawn(seed: int | None = None) -> list[float]:
        numbers: list[float] = []
        one = harness.Fault("a", 1, lambda _, rng, *__: numbers.extend(rng.random(3)))
        harness.run(one, 1, tmp_path, seed)
        return numbers

    assert drawn() == drawn() == np.random.default_rng(zlib.crc32(b"a")).random(3).tolist()
    assert drawn(1) == drawn(1) != drawn()
    assert drawn(2) != drawn(1)


@pytest.mark.parametrize("name", [name for name, one in FAULTS.items() if not one.slow])
@pytest.mark.mjx
def test_nothing_is_lost(name: str, tmp_path: Path):
    """Claim: no fault loses data, is taken for good data, ends in a traceback or hangs."""
    one = FAULTS[name]
    try:
        tally = harness.run(one, max(1, one.tries // harness.SHARE), tmp_path)
    except harness.MissingToolError as error:
        pytest.skip(str(error))
    assert tally.tries
    assert not tally.bad, tally.remarks
