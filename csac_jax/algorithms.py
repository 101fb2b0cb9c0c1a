"""The CSAC family and its baselines: each a function from a config to a config, for one learner.

A function sets what makes its algorithm. Sizes, rates, exploration of places and the run's length
stay the preset's, so that two algorithms on one preset differ in nothing else. `docs/paper.md` has
the table of what differs. `register` adds an algorithm of your own.
"""

import difflib
from collections.abc import Callable, Iterable

from csac_jax.config import Config, RewardConfig

Algorithm = Callable[[Config], Config]

VPG_REWARD = RewardConfig(
    success_bonus=0.0,
    grasp_levels=(0.0, 0.0, 0.0, 0.0, 1.0),
    push_effect="change",
    push_levels=(0.0, 1.0),
)
"""Rewards of VPG (arXiv:1803.09956 sec. IV): 1 for a grasp that lifts, 0.5 = Gamma for a push that
changes the map."""


def csac(cfg: Config) -> Config:
    """Continuous pose by CEM, softmax target, actor; all transitions are equally likely."""
    return _csac(cfg, "uniform")


def csac_per(cfg: Config) -> Config:
    """CSAC with prioritised replay."""
    return _csac(cfg, "prioritised")


def csac_beta(cfg: Config) -> Config:
    """CSAC with beta-ranked replay, sec. 3.5; the law of the ranks is the preset's."""
    return _csac(cfg, "beta")


def _csac(cfg: Config, sampler: str) -> Config:
    return cfg.change(
        policy={"place": "cem", "primitive": "argmax"},
        target={"value": "softmax", "bootstrap": "episodic"},
        learn={"actor": True},
        replay={"sampler": sampler},
    )


def vpg(cfg: Config) -> Config:
    """VPG as its authors' code has it (arXiv:1803.09956): best pixel, maximum target with discount
    0.5 by the network itself, no actor, replay of opposite outcomes.

    An action without effect has no future. An episode's last grasp bootstraps from the next scene.
    Critics and loss are the preset's, as for all. Deviations: docs/paper.md.
    """
    return _vpg(cfg).change(target={"bootstrap": "continuing"}, replay={"sampler": "opposite"})


def vpg_episodic(cfg: Config) -> Config:
    """VPG as this package had it first: an episode's end has no future, ranks follow a power law
    alone, one critic, Huber loss. In it, to push an episode's last block for ever pays most."""
    return _vpg(cfg).change(
        target={"bootstrap": "episodic"},
        learn={"critics": 1, "loss": "huber"},
        replay={"sampler": "beta", "start": (1.0, 2.0), "middle": (1.0, 2.0), "end": (1.0, 2.0)},
    )


def _vpg(cfg: Config) -> Config:
    return cfg.change(
        reward=VPG_REWARD,
        policy={"place": "argmax", "primitive": "argmax"},
        target={"value": "max", "gamma": 0.5},
        explore={"noise_std": 0.0, "epsilon_primitive": (0.5, 0.1), "push_fraction": 0.5},
        learn={"actor": False, "tau": 1.0},
    )


def reactive(cfg: Config) -> Config:
    """VPG's baseline P+G reactive: no future, gamma = 0.

    Deviation: VPG's classifies outcomes by cross-entropy; here their rewards are regressed.
    """
    return vpg(cfg).change(target={"gamma": 0.0})


def grasp_only(cfg: Config) -> Config:
    """The baseline Grasping-only of CSAC sec. 4.1 and VPG: greedy, never pushes, no future.

    Deviation: as of `reactive`.
    """
    return reactive(cfg).change(policy={"primitive": "grasp"}, explore={"push_fraction": 0.0})


ALGORITHMS: dict[str, Algorithm] = {
    algorithm.__name__: algorithm
    for algorithm in (csac, csac_per, csac_beta, vpg, grasp_only, reactive, vpg_episodic)
}


def register(name: str, algorithm: Algorithm) -> None:
    """Makes `algorithm`, a function from a config to a config, known as `name` to API and commands.
    Raises ValueError if the name is taken."""
    if name in ALGORITHMS:
        raise ValueError(f"algorithm '{name}' exists; choose another name")
    ALGORITHMS[name] = algorithm


def configure(cfg: Config, name: str) -> Config:
    """The config made one of the algorithm `name`. Raises ValueError for an unknown name."""
    if name not in ALGORITHMS:
        raise ValueError(unknown("algorithm", name, ALGORITHMS))
    return ALGORITHMS[name](cfg).change(algo=name)


def unknown(what: str, name: str, known: Iterable[str]) -> str:
    """The complaint about an unknown name, with the nearest known one."""
    near = difflib.get_close_matches(name, known, 1)
    meant = f"did you mean {near[0]}? " if near else ""
    return f"unknown {what} '{name}'; {meant}choose one of: {', '.join(known)}"
