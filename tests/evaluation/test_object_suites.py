"""Suites of objects: the library, the end after failures, and the fingerprint in the result."""

import numpy as np
import pytest

from csac_jax import presets
from csac_jax.constants import Outcome
from csac_jax.evaluation import metrics, policies, rollout, suites
from csac_jax.scenes import pool

pytestmark = pytest.mark.mjx  # ranks are promoted in `physics.healthy`
SMOKE = presets.smoke()


@pytest.mark.slow
def test_a_pile_ends_after_two_failures(monkeypatch: pytest.MonkeyPatch, tmp_path):
    """Claim: episodes of a pile end empty or after two failures in a row; the result has the
    fingerprint of its scenes."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    prepared = suites.prepare(SMOKE, "pile", 3, 0, "c", objects="procedural:0:42", split="all")
    env = prepared.parts["pile"]
    assert env.scenes.position.shape == (3, 5, 3)
    episodes = rollout.rollout(env, policies.RandomPolicy(env.cfg), 3, seed=0)
    for row in range(3):
        valid = episodes.valid[row]
        failed = episodes.outcome[row][valid] != Outcome.LIFTED
        given_up = metrics.ENDINGS[episodes.ending[row]] == "failed_grasps"
        assert given_up == bool(failed[-2:].all() and len(failed) > 1)
        assert given_up != bool(episodes.completed[row])
        assert not np.any(failed[:-1] & failed[1:]) or given_up
    found = rollout.evaluate(policies.RandomPolicy(env.cfg), prepared)
    assert found["scenes_sha256"] == rollout.object_slots.fingerprint(env.cfg.scene, env.scenes)
    assert found["declutter_rate"]["n"] == 15
    counts, rows = found["counts"], found["objects"].values()
    assert sum(row["episodes"] for row in rows) == counts["blocks"] == 15
    assert sum(row["gone"] for row in rows) == counts["taken"] + counts["blocks_lost"]
    names = {member.name for member in rollout.object_slots.library(env.cfg.scene).objects}
    assert found["objects"].keys() <= names
    again = pool.settled(env.cfg, 1, 3, poured=True)
    assert rollout.object_slots.fingerprint(env.cfg.scene, again) == found["scenes_sha256"]
