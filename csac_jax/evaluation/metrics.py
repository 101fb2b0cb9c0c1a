"""What an evaluation reports, from arrays of episodes; no JAX.

Every metric is `{"value", "low", "high", "n"}`: value, 95 % interval, number of cases. Without
cases `n` is 0 and the others are None. Shares have Wilson intervals over the cases named; the
efficiencies have bootstrap intervals over episodes, whose actions depend on one another. In the
target task only the target counts as a block.

`grasp_success`                lifted / grasps.
`completion`                   episodes in which the hand took every block / episodes. A lost block
                               was not taken.
`completion_reachable`         episodes that ended with no block in the workspace / episodes. Lost
                               blocks do not count.
`action_efficiency`            blocks taken / actions (pushes and grasps), over all episodes.
`action_efficiency_completed`  mean of blocks at the start / actions over the episodes of
                               `completion`: VPG's "action efficiency" (Zeng et al. 2018, sec. VI).

The efficiencies are blocks per action and no shares: a grasp that lifts two blocks at once takes
both, so they can exceed 1.

`outcomes` counts grasps by outcome. `counts` holds episodes, blocks, pushes, grasps, and blocks
taken and lost.

`failures` are shares too, one per cause. No action has two causes.
`grasp_nothing`             grasps at bare table / grasps.
`grasp_empty`               grasps that met no block, though there was one below / grasps.
`grasp_touched`             grasps that met a block and did not lift it by 1 cm / grasps.
`grasp_dropped`             grasps that lifted a block by 1 cm or more and lost it / grasps.
`grasp_wrong_block`         grasps that took another block than the target / grasps.
`push_no_change`            pushes that moved at most 12 cm^2 of the height map / pushes.
`block_lost`                blocks that left the workspace / blocks at the start.
`episode_action_cap`        episodes stopped at `task.max_actions` / episodes.
`episode_no_change_cap`     episodes stopped after `task.max_steps_without_change` / episodes.
`episode_physics_diverged`  episodes in which physics diverged / episodes.
"""

from typing import Any, NamedTuple

import numpy as np
import scipy.stats

from csac_jax.constants import OUTCOMES, Outcome, Primitive

ENDINGS = ("terminated", "action_cap", "no_change_cap", "physics_diverged")  # why an episode ended
PER_ACTION = ("action_efficiency", "action_efficiency_completed")  # blocks per action, no shares
RESAMPLES = 2000


class Episodes(NamedTuple):
    """Finished episodes. M = episodes, T = action limit; `valid` is False beyond an episode's end.

    NumPy arrays or anything that becomes one.
    """

    valid: np.ndarray  # [M, T] bool, an action was taken
    primitive: np.ndarray  # [M, T] int32, Primitive
    outcome: np.ndarray  # [M, T] int32, Outcome; of grasps only
    cleared: np.ndarray  # [M, T] int32, blocks taken from the table by the action
    blocks: np.ndarray  # [M] int32, in play at the start
    completed: np.ndarray  # [M] bool, no block was in the workspace at the end
    blocks_lost: np.ndarray  # [M] int32, blocks that left the workspace
    changed: np.ndarray  # [M, T] bool, the height map moved by more than 12 cm^2
    wrong: np.ndarray  # [M, T] bool, the grasp took a block, but not the target
    ending: np.ndarray  # [M] int32, index into ENDINGS


def wilson(successes: int, n: int) -> dict[str, Any]:
    """A share with Wilson's 95 % interval, which holds for few cases and near 0 and 1."""
    if n == 0:
        return _empty()
    low, high = scipy.stats.binomtest(successes, n).proportion_ci(method="wilson")
    return {"value": successes / n, "low": float(low), "high": float(high), "n": n}


def bootstrap_ratio(above: np.ndarray, below: np.ndarray, n: int, seed: int = 0) -> dict[str, Any]:
    """sum(above) / sum(below) over cases [M], with a 95 % percentile bootstrap interval.

    `n` is reported as the number of cases. `scipy.stats.bootstrap` refuses a single case.
    """
    if below.sum() == 0:
        return _empty()
    drawn = np.random.default_rng(seed).integers(0, above.size, (RESAMPLES, above.size))
    total = below[drawn].sum(axis=1)
    ratios = above[drawn].sum(axis=1)[total > 0] / total[total > 0]
    low, high = map(float, np.percentile(ratios, [2.5, 97.5]))
    return {"value": float(above.sum() / below.sum()), "low": low, "high": high, "n": n}


def _empty() -> dict[str, Any]:
    return {"value": None, "low": None, "high": None, "n": 0}


def summarise(episodes: Episodes) -> dict[str, Any]:
    """Every metric of the module's docstring, ready for JSON."""
    episodes = Episodes(*map(np.asarray, episodes))
    valid, completed, blocks = episodes.valid, episodes.completed, episodes.blocks
    grasps = valid & (episodes.primitive == Primitive.GRASP)
    actions = valid.sum(axis=1)
    taken = np.where(valid, episodes.cleared, 0).sum(axis=1)
    outcomes = np.bincount(episodes.outcome[grasps], minlength=len(OUTCOMES))
    took_all = completed & (taken == blocks)
    per_episode = blocks[took_all] / np.maximum(actions[took_all], 1)
    ones = np.ones(per_episode.size)
    return {
        "grasp_success": wilson(int(outcomes[Outcome.LIFTED]), int(grasps.sum())),
        "completion": _share(took_all),
        "completion_reachable": _share(completed),
        "action_efficiency": bootstrap_ratio(taken, actions, int(actions.sum())),
        "action_efficiency_completed": bootstrap_ratio(per_episode, ones, per_episode.size),
        "failures": _failures(episodes, grasps),
        "outcomes": {name: int(count) for name, count in zip(OUTCOMES, outcomes, strict=True)},
        "counts": {
            "episodes": int(completed.size),
            "blocks": int(blocks.sum()),
            "pushes": int((valid & ~grasps).sum()),
            "grasps": int(grasps.sum()),
            "taken": int(taken.sum()),
            "blocks_lost": int(episodes.blocks_lost.sum()),
        },
    }


def _share(true: np.ndarray, of: np.ndarray | None = None) -> dict[str, Any]:
    """The share of the cases `of`, bool, all if None, in which `true` holds."""
    of = np.ones_like(true) if of is None else of
    return wilson(int((true & of).sum()), int(of.sum()))


def _failures(episodes: Episodes, grasps: np.ndarray) -> dict[str, dict[str, Any]]:
    """What went wrong, by cause; `grasps` [M, T] bool."""
    grasp_causes = {
        f"grasp_{name}": _share(~episodes.wrong & (episodes.outcome == number), grasps)
        for number, name in enumerate(OUTCOMES)
        if number != Outcome.LIFTED
    }
    endings = {
        f"episode_{name}": _share(episodes.ending == number)
        for number, name in enumerate(ENDINGS)
        if name != "terminated"
    }
    return {
        **grasp_causes,
        "grasp_wrong_block": _share(episodes.wrong, grasps),
        "push_no_change": _share(~episodes.changed, episodes.valid & ~grasps),
        "block_lost": wilson(int(episodes.blocks_lost.sum()), int(episodes.blocks.sum())),
        **endings,
    }
