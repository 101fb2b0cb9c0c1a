"""The CSAC family and its baselines: each a function from a config to a config, for one and the
same learner.

A function sets what makes its algorithm; sizes, rates, exploration of places and the run's length
stay the preset's, so that two algorithms on one preset differ in nothing else. `docs/paper.md` has
the table of what differs.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

from csac_jax.config import Algo, Config, RewardConfig

VPG_REWARD = RewardConfig(
    success_bonus=0.0,
    nothing=0.0,
    empty=0.0,
    touched=0.0,
    dropped=0.0,
    lifted=1.0,
    push_effect="change",
    push_better=1.0,
    push_worse=0.0,
)
"""Rewards of VPG (arXiv:1803.09956 sec. IV): 1 for a grasp that lifts, 0.5 = Gamma for a push that
changes the map."""


def _change(cfg: Config, **sections: dict[str, Any]) -> Config:
    """The config with the given fields of the given sections changed."""
    changed = {
        name: dataclasses.replace(getattr(cfg, name), **fields) for name, fields in sections.items()
    }
    return dataclasses.replace(cfg, **changed)


def csac(cfg: Config) -> Config:
    """Continuous pose by CEM, softmax target, actor; transitions drawn alike."""
    return _change(
        cfg,
        policy={"place": "cem", "primitive": "argmax"},
        target={"value": "softmax"},
        learn={"actor": True},
        replay={"sampler": "uniform"},
    )


def csac_per(cfg: Config) -> Config:
    """CSAC with prioritised replay."""
    return _change(csac(cfg), replay={"sampler": "prioritised"})


def csac_beta(cfg: Config) -> Config:
    """CSAC with beta-ranked replay, sec. 3.5; the law of the ranks is the preset's."""
    return _change(csac(cfg), replay={"sampler": "beta"})


def vpg(cfg: Config) -> Config:
    """VPG, arXiv:1803.09956: best pixel, maximum target with discount 0.5 by the network itself, no
    actor, power law.

    Deviations: Adam for SGD with momentum, batches for single transitions, random places while
    learning as for all.
    """
    return _change(
        dataclasses.replace(cfg, reward=VPG_REWARD),
        policy={"place": "argmax", "primitive": "argmax"},
        target={"value": "max", "gamma": 0.5},
        explore={
            "noise_std": 0.0,
            "epsilon_primitive_start": 0.5,
            "epsilon_primitive_end": 0.1,
            "push_fraction": 0.5,
        },
        learn={
            "actor": False,
            "critics": 1,
            "loss": "huber",
            "target_update": "hard",
            "target_update_period": 1,
        },
        replay={
            "sampler": "beta",
            "beta_start": (1.0, 2.0),
            "beta_middle": (1.0, 2.0),
            "beta_end": (1.0, 2.0),
        },
    )


def reactive(cfg: Config) -> Config:
    """VPG's baseline P+G reactive: no future, gamma = 0.

    Deviation: VPG's classifies outcomes as good or bad by cross-entropy; here their rewards are
    regressed.
    """
    return _change(vpg(cfg), target={"gamma": 0.0})


def grasp_only(cfg: Config) -> Config:
    """The baseline Grasping-only of CSAC sec. 4.1 and VPG: greedy, deterministic, never pushes, no
    future.

    Deviation: as of `reactive`.
    """
    return _change(reactive(cfg), policy={"primitive": "grasp"}, explore={"push_fraction": 0.0})


ALGORITHMS: dict[Algo, Callable[[Config], Config]] = {
    "csac": csac,
    "csac_per": csac_per,
    "csac_beta": csac_beta,
    "vpg": vpg,
    "grasp_only": grasp_only,
    "reactive": reactive,
}


def configure(cfg: Config, name: str) -> Config:
    """The config made one of the algorithm `name`. Raises ValueError if there is none, naming those
    that there are."""
    for algo, change in ALGORITHMS.items():
        if algo == name:
            return dataclasses.replace(change(cfg), algo=algo)
    raise ValueError(f"unknown algorithm '{name}'; choose one of: {', '.join(ALGORITHMS)}")
