"""Memory of a run: exact bytes of its state, and what is refused."""

import re

import jax
import jax.numpy as jnp
import pytest

from csac_jax import presets
from csac_jax.errors import SettingsError
from csac_jax.replay import ring
from csac_jax.training import memory, programs

SMOKE = presets.smoke()


def test_state_is_exact():
    """Claim: ring and networks are known to the byte."""
    quick = presets.quick()
    known = memory.state_bytes(quick)
    small = ring.init(jnp.zeros(64), programs.example(quick))
    stored = sum(leaf.nbytes for leaf in jax.tree.leaves(small))
    # head and size are no slots
    assert known["replay"] == (stored - 8) * quick.replay.capacity // 64 + 8
    parameters = 50_316 + 5_628  # of critic and actor
    counters = 5  # two in each optimiser, one of updates
    # online, target and Adam's two moments
    assert known["networks"] == 4 * (4 * parameters + counters)


@pytest.mark.parametrize("runs", [1, 3])
def test_too_large_is_refused(monkeypatch: pytest.MonkeyPatch, runs: int):
    """Claim: rings larger than memory are refused; the capacity named fits, the next one does not;
    where none fits, the message says so."""
    monkeypatch.setattr(memory, "limit", lambda: 100 * 2**20)
    with pytest.raises(SettingsError, match=r"^replay\.capacity: the replay takes") as caught:
        memory.check(SMOKE.change(replay={"capacity": 100_000}), runs)
    named = re.search(r"lower replay.capacity from 100000 to (\d+) at most", str(caught.value))
    assert named
    assert ("lower seeds" in str(caught.value)) == (runs > 1)
    memory.check(SMOKE.change(replay={"capacity": int(named[1])}), runs)
    with pytest.raises(SettingsError):
        memory.check(SMOKE.change(replay={"capacity": int(named[1]) + 1}), runs)
    monkeypatch.setattr(memory, "limit", lambda: 2**16)
    with pytest.raises(SettingsError, match=r"lower heightmap\.size"):
        memory.check(SMOKE, runs)


def test_presets_fit(monkeypatch: pytest.MonkeyPatch):
    """Claim: no preset is refused on a device with 16 GB."""
    monkeypatch.setattr(memory, "limit", lambda: 16 * 10**9)
    for name in presets.PRESETS:
        memory.check(presets.get(name))
