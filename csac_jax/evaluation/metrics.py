"""What an evaluation reports, from arrays of episodes; NumPy only.

Every metric is `{"value", "low", "high", "n"}`: the value, its 95 % interval and the number of
cases it is taken over. Where there are none, `n` is 0 and the others are None. In the target task
only the target counts as a block, and a grasp that brings another one counts as `touched`.

`grasp_success`                lifted / grasps. Wilson interval over grasps.
`completion`                   episodes in which the hand took every block from the table within the caps / episodes.
                               A block that left the square was not taken. Wilson interval over episodes.
`completion_reachable`         episodes that ended with no block in the square / episodes: blocks that left the square
                               do not count. Wilson interval over episodes.
`action_efficiency`            blocks taken / actions (pushes and grasps), summed over all episodes. Bootstrap interval
                               over episodes, since the actions of one episode depend on one another.
`action_efficiency_completed`  mean of blocks in play at the start / actions, over the episodes that `completion`
                               counts: VPG's "action efficiency" (Zeng et al. 2018, sec. VI). Bootstrap interval over
                               those episodes.

Beside them `outcomes` counts grasps by what came of them (nothing, empty, touched, dropped,
lifted), and `counts` holds episodes, blocks, pushes, grasps, and blocks that were taken and that
left the square.

`failures` are metrics too, one for each cause; no action has two of them. Wilson intervals over the
cases named.
`grasp_nothing`           grasps at bare table / grasps.
`grasp_empty`             grasps that met no block although there was something at the place / grasps.
`grasp_touched`           grasps that met a block and did not lift it by 1 cm between the pads / grasps.
`grasp_dropped`           grasps that lifted a block by 1 cm or more and lost it / grasps.
`grasp_wrong_block`       grasps that brought another block than the target / grasps; they do not count as touched here.
`push_no_change`          pushes that moved no more than 12 cm^2 of the height map / pushes.
`block_lost`              blocks that left the square / blocks in play at the start.
`episode_action_cap`      episodes cut off at `task.max_actions` / episodes.
`episode_no_change_cap`   episodes cut off after `task.max_steps_without_change` actions in a row without change / episodes.
`episode_physics_diverged`             episodes in which physics failed / episodes.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from csac_jax.constants import OUTCOMES, Outcome, Primitive

ENDINGS = (
    "terminated",
    "action_cap",
    "no_change_cap",
    "physics_diverged",
)  # numbers 0 to 3: why an episode was over
Z_95 = 1.959963984540054  # 97.5 % quantile of the normal distribution
RESAMPLES = 2000


class Episodes(NamedTuple):
    """Finished episodes, as arrays. M = episodes, T = most actions of one; beyond its end `valid`
    is False."""

    valid: np.ndarray  # [M, T] bool, an action was taken
    primitive: np.ndarray  # [M, T] int32, 0 push, 1 grasp
    outcome: np.ndarray  # [M, T] int32, number in OUTCOMES; only of grasps
    cleared: np.ndarray  # [M, T] int32, blocks taken from the table by the action
    blocks: np.ndarray  # [M] int32, in play at the start
    completed: np.ndarray  # [M] bool, no block was in the square at the end
    blocks_lost: np.ndarray  # [M] int32, blocks that left the square
    changed: np.ndarray  # [M, T] bool, the height map moved by more than 12 cm^2
    wrong: np.ndarray  # [M, T] bool, the grasp brought a block, but not the target
    ending: np.ndarray  # [M] int32, number in ENDINGS


def wilson(successes: int, n: int) -> dict[str, Any]:
    """A share with Wilson's 95 % interval, which holds for few cases and near 0 and 1 (Wilson
    1927).

    centre = (p + z^2 / 2n) / (1 + z^2 / n),  half width = z sqrt(p (1 - p) / n + z^2 / 4n^2) / (1 +
    z^2 / n).
    """
    if n == 0:
        return _empty()
    share, z2 = successes / n, Z_95**2
    centre = (share + z2 / (2 * n)) / (1 + z2 / n)
    half = Z_95 * math.sqrt(share * (1 - share) / n + z2 / (4 * n * n)) / (1 + z2 / n)
    low, high = max(0.0, centre - half), min(1.0, centre + half)
    return {
        "value": share,
        "low": low if successes else 0.0,
        "high": high if successes < n else 1.0,
        "n": n,
    }


def bootstrap_ratio(above: np.ndarray, below: np.ndarray, n: int, seed: int = 0) -> dict[str, Any]:
    """sum(above) / sum(below) over cases [M], with the 95 % percentile interval of resampled cases.

    `n` is what is reported as the number of cases. `seed` makes the interval repeatable.
    """
    if below.sum() == 0:
        return _empty()
    drawn = np.random.default_rng(seed).integers(0, above.size, (RESAMPLES, above.size))
    total = below[drawn].sum(axis=1)
    ratios = above[drawn].sum(axis=1)[total > 0] / total[total > 0]
    low, high = np.percentile(ratios, [2.5, 97.5])
    return {
        "value": float(above.sum() / below.sum()),
        "low": float(low),
        "high": float(high),
        "n": n,
    }


def _empty() -> dict[str, Any]:
    return {"value": None, "low": None, "high": None, "n": 0}


def summarise(episodes: Any) -> dict[str, Any]:
    """Every metric of the module's docstring, ready for JSON. `episodes` has the fields of
    `Episodes`."""
    episodes = Episodes(*(np.asarray(getattr(episodes, name)) for name in Episodes._fields))
    valid, primitive, outcome, cleared, blocks, completed, lost = episodes[:7]
    grasps = valid & (primitive == Primitive.GRASP)
    actions = valid.sum(axis=1)
    taken = np.where(valid, cleared, 0).sum(axis=1)
    counts = np.bincount(outcome[grasps], minlength=len(OUTCOMES))
    cleared_all = completed & (taken == blocks)
    per_episode = blocks[cleared_all] / np.maximum(actions[cleared_all], 1)
    return {
        "grasp_success": wilson(int(counts[Outcome.LIFTED]), int(grasps.sum())),
        "completion": wilson(int(cleared_all.sum()), completed.size),
        "completion_reachable": wilson(int(completed.sum()), completed.size),
        "action_efficiency": bootstrap_ratio(taken, actions, int(actions.sum())),
        "action_efficiency_completed": bootstrap_ratio(
            per_episode, np.ones(per_episode.size), per_episode.size
        ),
        "failures": _failures(episodes),
        "outcomes": {name: int(count) for name, count in zip(OUTCOMES, counts, strict=True)},
        "counts": {
            "episodes": int(completed.size),
            "blocks": int(blocks.sum()),
            "pushes": int((valid & ~grasps).sum()),
            "grasps": int(grasps.sum()),
            "taken": int(taken.sum()),
            "blocks_lost": int(lost.sum()),
        },
    }


def _failures(episodes: Episodes) -> dict[str, dict[str, Any]]:
    """What went wrong, by cause."""
    grasps = episodes.valid & (episodes.primitive == Primitive.GRASP)
    pushes, wrong = episodes.valid & ~grasps, episodes.wrong & grasps
    found = {
        f"grasp_{name}": wilson(
            int((grasps & ~wrong & (episodes.outcome == number)).sum()), int(grasps.sum())
        )
        for number, name in enumerate(OUTCOMES)
        if number != Outcome.LIFTED
    }
    found["grasp_wrong_block"] = wilson(int(wrong.sum()), int(grasps.sum()))
    found["push_no_change"] = wilson(int((pushes & ~episodes.changed).sum()), int(pushes.sum()))
    found["block_lost"] = wilson(int(episodes.blocks_lost.sum()), int(episodes.blocks.sum()))
    for number, name in enumerate(ENDINGS[1:], 1):
        found[f"episode_{name}"] = wilson(
            int((episodes.ending == number).sum()), episodes.ending.size
        )
    return found
