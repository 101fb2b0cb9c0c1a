"""Metrics of an evaluation, from arrays of episodes; no JAX.

Every metric is `{"value", "low", "high", "n"}`: value, 95 % interval, number of cases. Without
cases `n` is 0 and the others are None. Shares have Wilson intervals over the cases named. Actions
of one episode depend on one another: their shares have the intervals of `clustered`, and the
efficiencies bootstrap intervals over episodes. In the target task only the target counts as a
block.

`grasp_success`                lifted / grasps.
`completion`                   episodes in which the hand took every block / episodes. A lost block
                               was not taken.
`completion_reachable`         episodes that ended with no block in the workspace / episodes. Lost
                               blocks do not count.
`declutter_rate`               blocks taken / blocks at the start, over all episodes.
`action_efficiency`            blocks taken / actions (pushes and grasps), over all episodes.
`action_efficiency_completed`  mean of blocks at the start / actions over the episodes of
                               `completion`: VPG's "action efficiency" (Zeng et al. 2018, sec. VI).
`action_efficiency_grasps`     mean of lifted / grasps over the episodes with a grasp: CSAC's
                               "action efficiency" (sec. 4.2). It does not charge for pushes.
`actions_per_episode`          pushes and grasps / episodes.
`pushes_per_episode`           pushes / episodes.

The first two efficiencies are no shares: a grasp that lifts two blocks takes both, so they can
exceed 1. `failures` are shares too, see `_failures`. `outcomes` counts grasps by outcome. `counts`
holds episodes, blocks, pushes, grasps, and blocks taken and lost. Of suites of objects `objects`
counts by object, see `by_object`.
"""

import statistics
from typing import Any, NamedTuple

import numpy as np

from csac_jax.constants import OUTCOMES, Outcome, Primitive

ENDINGS = ("terminated", "action_cap", "no_change_cap", "physics_diverged", "failed_grasps")
PER_ACTION = ("action_efficiency", "action_efficiency_completed")  # blocks per action, no shares
PER_EPISODE = ("actions_per_episode", "pushes_per_episode")  # counts, no shares
NO_CASES = {"value": None, "low": None, "high": None, "n": 0}
RESAMPLES = 2000
_Z = statistics.NormalDist().inv_cdf(0.975)


class Episodes(NamedTuple):
    """Finished episodes. M = episodes, T = action limit; `valid` is False beyond their ends."""

    valid: Any  # [M, T] bool, an action was taken
    primitive: Any  # [M, T] int32, Primitive
    outcome: Any  # [M, T] int32, Outcome; of grasps only
    cleared: Any  # [M, T] int32, blocks taken from the table by the action
    blocks_lost: Any  # [M] int32, blocks that left the workspace
    changed: Any  # [M, T] bool, the height map moved by more than 12 cm^2
    wrong: Any  # [M, T] bool, the grasp took a block, but not the target
    unreachable: Any  # [M, T] bool, the robot cannot follow the action, so that nothing moved
    blocks: Any = None  # [M] int32, in play at the start; these three come at the end
    completed: Any = None  # [M] bool, no block was in the workspace at the end
    ending: Any = None  # [M] int32, index into ENDINGS
    left: Any = None  # [M, N] bool, blocks by their slots, in play at the end


def wilson(successes: int, n: int) -> dict[str, Any]:
    """Returns a share with Wilson's 95 % interval."""
    return _wilson(successes / n, n, n) if n else dict(NO_CASES)


def clustered(hits: np.ndarray, cases: np.ndarray) -> dict[str, Any]:
    """Returns the share of hits among cases, counts of each episode [M], with a 95 % interval.

    It is Wilson's for as many independent cases as these are worth: their number over the design
    effect (Kish, Survey Sampling, 1965), the variance of the ratio between episodes over that of
    independent cases, at least 1. One object that cannot be grasped fails many grasps in a row.
    """
    if (total := int(cases.sum())) == 0:
        return dict(NO_CASES)
    share = float(hits.sum()) / total
    episodes = np.count_nonzero(cases)
    between = np.square(hits - share * cases).sum() * episodes / max(episodes - 1, 1)
    effect = max(1.0, between / (total * share * (1.0 - share))) if 0.0 < share < 1.0 else 1.0
    return _wilson(share, total, total / effect)


def _wilson(share: float, n: int, worth: float) -> dict[str, Any]:
    """Returns a share of n cases with the interval for `worth` independent ones (Wilson 1927)."""
    shrink = 1.0 + _Z**2 / worth
    middle = (share + 0.5 * _Z**2 / worth) / shrink
    half = _Z * np.sqrt(share * (1.0 - share) / worth + (0.5 * _Z / worth) ** 2) / shrink
    # Rounding would leave 0 .. 1, or the value outside.
    low, high = max(0.0, min(share, middle - half)), min(1.0, max(share, middle + half))
    return {"value": share, "low": float(low), "high": float(high), "n": n}


def bootstrap_ratio(above: np.ndarray, below: np.ndarray, n: int, seed: int = 0) -> dict[str, Any]:
    """Returns sum(above) / sum(below) over cases [M], with a 95 % percentile bootstrap interval."""
    if below.sum() == 0:
        return dict(NO_CASES)
    drawn = np.random.default_rng(seed).integers(0, above.size, (RESAMPLES, above.size))
    total = below[drawn].sum(axis=1)
    ratios = above[drawn].sum(axis=1)[total > 0] / total[total > 0]
    low, high = map(float, np.percentile(ratios, [2.5, 97.5]))
    return {"value": float(above.sum() / below.sum()), "low": low, "high": high, "n": n}


def summarise(episodes: Episodes) -> dict[str, Any]:
    """Computes every metric of the module's docstring, ready for JSON."""
    valid, completed, blocks = episodes.valid, episodes.completed, episodes.blocks
    grasps = valid & (episodes.primitive == Primitive.GRASP)
    actions = valid.sum(axis=1)
    taken = np.where(valid, episodes.cleared, 0).sum(axis=1)
    outcomes = np.bincount(episodes.outcome[grasps], minlength=len(OUTCOMES))
    took_all = completed & (taken == blocks)
    rates = blocks[took_all] / np.maximum(actions[took_all], 1)
    tried, lifted = grasps.sum(axis=1), (grasps & (episodes.outcome == Outcome.LIFTED)).sum(axis=1)
    pushes = actions - tried
    return {
        "grasp_success": clustered(lifted, tried),
        "completion": _share(took_all),
        "completion_reachable": _share(completed),
        "declutter_rate": bootstrap_ratio(taken, blocks, int(blocks.sum())),
        "action_efficiency": bootstrap_ratio(taken, actions, int(actions.sum())),
        "action_efficiency_completed": _mean(rates),
        "action_efficiency_grasps": _mean(lifted[tried > 0] / tried[tried > 0]),
        "actions_per_episode": _mean(actions),
        "pushes_per_episode": _mean(pushes),
        "failures": _failures(episodes, grasps),
        "outcomes": {name: int(count) for name, count in zip(OUTCOMES, outcomes, strict=True)},
        "counts": {
            "episodes": int(completed.size),
            "blocks": int(blocks.sum()),
            "pushes": int(pushes.sum()),
            "grasps": int(grasps.sum()),
            "taken": int(taken.sum()),
            "blocks_lost": int(episodes.blocks_lost.sum()),
        },
    }


def by_object(names: np.ndarray, in_play: np.ndarray, left: np.ndarray) -> dict[str, Any]:
    """Counts how often each object was drawn (`episodes`), and how often it was gone at the end.

    Args: all [M, N] by slots: names, and whether it was in play at the start and at the end.
    """
    counts: dict[str, Any] = {}
    for name, stays in zip(names[in_play].tolist(), left[in_play].tolist(), strict=True):
        entry = counts.setdefault(name, {"episodes": 0, "gone": 0})
        entry["episodes"] += 1
        entry["gone"] += not stays
    return dict(sorted(counts.items()))


def _mean(values: np.ndarray) -> dict[str, Any]:
    return bootstrap_ratio(values, np.ones(values.shape), values.size)


def _share(true: np.ndarray, of: np.ndarray | None = None) -> dict[str, Any]:
    """Returns the share of episodes [M], or of actions `of` [M, T], in which `true` holds."""
    if of is None:
        return wilson(int(true.sum()), true.size)
    return clustered((true & of).sum(axis=1), of.sum(axis=1))


def _failures(episodes: Episodes, grasps: np.ndarray) -> dict[str, dict[str, Any]]:
    """Counts failures by cause; `grasps` [M, T] bool."""
    grasped = [_share(~episodes.wrong & (episodes.outcome == kind), grasps) for kind in Outcome]
    ended = {name: _share(episodes.ending == number) for number, name in enumerate(ENDINGS)}
    return {
        # Of all grasps:
        "grasp_nothing": grasped[Outcome.NOTHING],  # at bare table
        "grasp_empty": grasped[Outcome.EMPTY],  # met no block, though there was one below
        "grasp_touched": grasped[Outcome.TOUCHED],  # met a block and did not lift it by 1 cm
        "grasp_dropped": grasped[Outcome.DROPPED],  # lifted a block by 1 cm or more and lost it
        "grasp_wrong_block": _share(episodes.wrong, grasps),  # took another than the target
        # Of pushes, those that moved at most 12 cm^2 of the height map.
        "push_no_change": _share(~episodes.changed, episodes.valid & ~grasps),
        # Of actions, those that the robot cannot follow: nothing moved.
        "action_unreachable": _share(episodes.unreachable, episodes.valid),
        # Of blocks at the start, those that left the workspace.
        "block_lost": clustered(episodes.blocks_lost, episodes.blocks),
        # Of episodes:
        "episode_action_cap": ended["action_cap"],  # stopped at `task.max_actions`
        "episode_no_change_cap": ended["no_change_cap"],  # at `task.max_steps_without_change`
        "episode_physics_diverged": ended["physics_diverged"],
        "episode_failed_grasps": ended["failed_grasps"],  # after failures in a row, in some suites
    }
