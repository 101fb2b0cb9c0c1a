"""Where a result comes from."""

import re
import subprocess
from pathlib import Path

import pytest

from csac_jax.runtime import provenance

ROOT = Path(provenance.__file__).parents[2]


def test_commit_is_the_checkout_s(monkeypatch: pytest.MonkeyPatch):
    """Claim: a result names the commit of the checkout, marked where files differ from it."""
    monkeypatch.delenv("CSAC_JAX_COMMIT", raising=False)
    done = subprocess.run(
        ["git", "-C", str(ROOT), "rev-parse", "HEAD"], capture_output=True, text=True
    )
    if done.returncode != 0:
        pytest.skip("not a checkout")
    assert re.fullmatch(re.escape(done.stdout.strip()) + "(-dirty)?", provenance.commit() or "")


def test_named_commit_goes_before(monkeypatch: pytest.MonkeyPatch):
    """Claim: CSAC_JAX_COMMIT names the commit where the sources come without their history."""
    monkeypatch.setenv("CSAC_JAX_COMMIT", "abc123")
    assert provenance.commit() == "abc123"
