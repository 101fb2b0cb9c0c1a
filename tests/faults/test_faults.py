"""A tenth of the fault-injection suite; `make test-faults` injects all of it."""

from pathlib import Path

import pytest

from tests.faults import harness

FAULTS = harness.load()


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
