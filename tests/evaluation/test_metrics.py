"""Metrics of an evaluation, by hand."""

import math

import numpy as np
import pytest

from csac_jax.evaluation import metrics
from csac_jax.evaluation.metrics import Episodes


def test_objects_are_counted_by_hand():
    """Claim: by object, the episodes that had it at the start, and those without it at the end."""
    names = np.array([["cup", "ball", "cup"], ["ball", "cup", "pen"]])
    in_play = np.array([[True, True, True], [True, True, False]])
    left = np.array([[False, True, True], [False, False, False]])
    counts = {"ball": {"episodes": 2, "gone": 1}, "cup": {"episodes": 3, "gone": 2}}
    assert metrics.by_object(names, in_play, left) == counts


def test_intervals_stay_within_their_bounds():
    """Claim: an interval of a share lies in 0 .. 1, exactly, and holds its value."""
    for n in range(1, 400):
        for lifted in (0, n):
            share = metrics.wilson(lifted, n)
            assert 0.0 <= share["low"] <= share["value"] <= share["high"] <= 1.0


@pytest.mark.parametrize(
    ("successes", "n"), [(0, 1), (1, 1), (0, 50), (50, 50), (1, 7), (47, 50), (1234, 4321)]
)
def test_wilson_by_its_formula(successes: int, n: int):
    """Claim: the interval of a share is Wilson's 95 % interval (Wilson 1927)."""
    share, z = successes / n, 1.959963984540054
    centre = (share + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z * math.sqrt(share * (1 - share) / n + z**2 / (4 * n * n)) / (1 + z**2 / n)
    got = metrics.wilson(successes, n)
    low, high = max(centre - half, 0.0), min(centre + half, 1.0)
    np.testing.assert_allclose([got["low"], got["high"]], [low, high], atol=1e-15)
    assert got["value"] == share
    assert got["n"] == n
    assert got["low"] <= share <= got["high"]


def test_no_cases_no_value():
    """Claim: where there are no cases, n is 0 and there is no value."""
    assert metrics.wilson(0, 0) == {"value": None, "low": None, "high": None, "n": 0}
    none, three = np.zeros(0), np.zeros(3)
    assert metrics.bootstrap_ratio(none, none, 0) == metrics.clustered(three, three)
    assert metrics.clustered(three, three) == metrics.wilson(0, 0)


def test_bootstrap_covers_the_truth():
    """Claim: in about 95 of 100 repetitions the interval holds the true ratio."""
    drawn = np.random.default_rng(0)
    covered = 0
    for seed in range(200):
        actions = drawn.integers(3, 12, 60)
        got = metrics.bootstrap_ratio(drawn.binomial(actions, 0.6), actions, 60, seed)
        covered += got["low"] <= 0.6 <= got["high"]
    assert 180 <= covered <= 198  # 190 +- 3 deviations of a binomial


def test_grasps_of_one_episode_are_alike():
    """Claim: where episodes differ, the interval of their grasps' share holds the truth in about 95
    of 100 repetitions, Wilson's of as many independent grasps in far fewer; where grasps are
    independent, or all alike, it is no narrower than Wilson's."""
    drawn = np.random.default_rng(0)
    covered = dict.fromkeys(("clustered", "wilson"), 0)
    for _ in range(400):
        grasps = drawn.integers(5, 25, 80)
        lifted = drawn.binomial(grasps, drawn.beta(3.0, 1.0, 80))  # 0.75 on average
        total = metrics.wilson(int(lifted.sum()), int(grasps.sum()))
        for name, one in (("clustered", metrics.clustered(lifted, grasps)), ("wilson", total)):
            covered[name] += one["low"] <= 0.75 <= one["high"]
    assert 368 <= covered["clustered"] <= 392  # 380 +- 3 deviations of a binomial
    assert covered["wilson"] < 300
    for lifted, n in ((6, 10), (10, 10), (0, 10)):
        got = metrics.clustered(np.full(50, lifted), np.full(50, n))
        assert got == pytest.approx(metrics.wilson(50 * lifted, 50 * n), abs=1e-12)


def test_bootstrap_repeats():
    """Claim: the interval is the same each time, and another with another seed."""
    above, below = np.arange(10), np.arange(10) + 5
    one, again, other = (metrics.bootstrap_ratio(above, below, 10, seed) for seed in (1, 1, 2))
    assert one == again != other


def _episodes() -> Episodes:
    """Three episodes, with rubbish beyond their ends.

    0: push, lift, lift: both blocks taken in 3 actions.  1: dropped, lift: one taken, the other
    left the square. 2: nothing, empty, touched as the block was a wrong one, push: nothing taken of
    2 blocks, ended by the action cap.
    """
    return Episodes(
        valid=np.array([[1, 1, 1, 0], [1, 1, 0, 0], [1, 1, 1, 1]], bool),
        primitive=np.array([[0, 1, 1, 1], [1, 1, 1, 1], [1, 1, 1, 0]], np.int32),
        outcome=np.array([[4, 4, 4, 4], [3, 4, 4, 4], [0, 1, 2, 4]], np.int32),
        cleared=np.array([[0, 1, 1, 9], [0, 1, 9, 9], [0, 0, 0, 0]], np.int32),
        blocks=np.array([2, 2, 2], np.int32),
        completed=np.array([True, True, False]),
        blocks_lost=np.array([0, 1, 0], np.int32),
        changed=np.array([[0, 1, 1, 1], [0, 1, 0, 0], [0, 0, 0, 0]], bool),
        wrong=np.array([[1, 0, 0, 1], [0, 0, 1, 1], [0, 0, 1, 0]], bool),
        unreachable=np.array([[0, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]], bool),
        ending=np.array([0, 0, 1], np.int32),
    )


def test_summary_by_hand():
    """Claim: every metric is what its definition says, worked out by hand."""
    got = metrics.summarise(_episodes())
    rows = {name: entry for name, entry in got.items() if "value" in entry}
    assert all(entry["low"] <= entry["value"] <= entry["high"] for entry in rows.values())
    assert {name: (entry["value"], entry["n"]) for name, entry in rows.items()} == {
        "grasp_success": (3 / 7, 7),  # lifts at 0.1, 0.2 and 1.1 of 2 + 2 + 3 grasps
        "completion": (1 / 3, 3),
        "completion_reachable": (2 / 3, 3),
        "declutter_rate": (3 / 6, 6),  # 3 of 2 + 2 + 2 blocks
        "action_efficiency": (3 / 9, 9),  # 3 blocks in 3 + 2 + 4 actions
        "action_efficiency_completed": (2 / 3, 1),  # 2 blocks in 3 actions, of episode 0 alone
        "action_efficiency_grasps": ((2 / 2 + 1 / 2 + 0 / 3) / 3, 3),  # not the 3 / 7 of all
        "actions_per_episode": (9 / 3, 3),
        "pushes_per_episode": (2 / 3, 3),
    }
    assert got["outcomes"] == {"nothing": 1, "empty": 1, "touched": 1, "dropped": 1, "lifted": 3}
    counts = {"episodes": 3, "blocks": 6, "pushes": 2, "grasps": 7, "taken": 3, "blocks_lost": 1}
    assert got["counts"] == counts


def test_failures_by_hand():
    """Claim: every cause of failure is what its definition says, worked out by hand."""
    got = metrics.summarise(_episodes())["failures"]
    assert {name: (entry["value"] * entry["n"], entry["n"]) for name, entry in got.items()} == {
        "grasp_nothing": (1, 7),
        "grasp_empty": (1, 7),
        "grasp_touched": (0, 7),  # the only one brought a wrong block
        "grasp_dropped": (1, 7),
        "grasp_wrong_block": (1, 7),
        "push_no_change": (2, 2),
        "action_unreachable": (2, 9),
        "block_lost": (1, 6),
        "episode_action_cap": (1, 3),
        "episode_no_change_cap": (0, 3),
        "episode_physics_diverged": (0, 3),
        "episode_failed_grasps": (0, 3),
    }
    for entry in got.values():
        assert entry["low"] <= entry["value"] <= entry["high"]


@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_every_ending_is_counted(number: int):
    """Claim: of the endings, each that is a failure has its own share of the episodes."""
    got = metrics.summarise(_episodes()._replace(ending=np.full(3, number, np.int32)))["failures"]
    ends = {name: entry["value"] for name, entry in got.items() if name.startswith("episode_")}
    assert ends == {
        f"episode_{name}": float(i == number) for i, name in enumerate(metrics.ENDINGS) if i > 0
    }


def test_efficiency_counts_blocks_per_action():
    """Claim: the efficiencies are blocks per action and no shares: a grasp that lifts two blocks
    takes both, and the value exceeds 1."""
    first = np.arange(4) < np.ones((3, 1), int)  # the only action takes both blocks
    done, both = np.ones(3, bool), (2 * first).astype(np.int32)
    got = metrics.summarise(_episodes()._replace(valid=first, cleared=both, completed=done))
    for name in metrics.PER_ACTION:
        assert got[name]["value"] == got[name]["low"] == got[name]["high"] == 2.0
    counts = {*metrics.PER_ACTION, *metrics.PER_EPISODE}
    shares = {name for name, entry in got.items() if "value" in entry} - counts
    assert len(shares) == 5
    assert all(got[name]["high"] <= 1.0 for name in shares)


def test_no_grasps():
    """Claim: a policy that only pushes has no grasp success, and the other metrics still stand."""
    pushes, none = np.zeros((3, 4), np.int32), np.zeros(3, bool)
    got = metrics.summarise(_episodes()._replace(primitive=pushes, completed=none))
    for name in ("grasp_success", "action_efficiency_completed", "action_efficiency_grasps"):
        assert got[name]["n"] == 0
    assert got["pushes_per_episode"]["value"] == got["actions_per_episode"]["value"] == 3.0
    assert got["completion"]["value"] == 0.0
