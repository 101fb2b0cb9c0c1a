"""A hundred lives of runs, sweeps and policies; `make lives` lives more."""

import pytest

from tests.faults import lives


@pytest.mark.parametrize("part", range(4))
@pytest.mark.mjx
def test_a_life_loses_nothing(part: int):
    """Claim: whatever comes in a life, no saved state is lost, no damage is taken for good data, no
    answer is a traceback and no step hangs."""
    tallies = [lives.live(number) for number in range(25 * part, 25 * part + 25)]
    assert sum(tally.tries for tally in tallies) > 100
    assert not [remark for tally in tallies for remark in tally.remarks]


@pytest.mark.mjx
def test_a_seed_replays_a_life(monkeypatch: pytest.MonkeyPatch):
    """Claim: the same numbers give the same steps; others give others."""
    lived, make = [], lives.Life
    monkeypatch.setattr(lives, "Life", lambda *of: lived.append(make(*of)) or lived[-1])
    for number in (3, 3, 5):
        lives.live(number, seed=1)
    first, again, other = (life.past for life in lived)
    assert first == again != other
    assert len(first) > 3
