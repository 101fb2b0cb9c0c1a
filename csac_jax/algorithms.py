"""The CSAC family and its baselines: functions from a config to a config, for one learner.

A function sets what defines its algorithm. Sizes, rates, exploration of places and the run's length
stay the preset's, so that two algorithms on one preset differ in nothing else. `docs/paper.md` has
the table of differences. `register` adds your own algorithm.
"""

import difflib
from collections.abc import Callable, Iterable

from csac_jax.config import Config, RewardConfig
from csac_jax.section import require

Algorithm = Callable[[Config], Config]

VPG_REWARD = RewardConfig(
    success_bonus=0.0,
    grasp_levels=(0.0, 0.0, 0.0, 0.0, 1.0),
    push_label="map_changed",
    push_levels=(0.0, 1.0),
)
"""Rewards of VPG (arXiv:1803.09956 sec. IV): 1 for a grasp that lifts, 0.5 = Gamma for a push that
changes the map."""


def csac(cfg: Config) -> Config:
    """Returns CSAC: continuous pose by CEM, softmax target, actor, uniform replay."""
    return _csac(cfg, "uniform")


def csac_per(cfg: Config) -> Config:
    """Returns CSAC with prioritised replay."""
    return _csac(cfg, "prioritised")


def csac_beta(cfg: Config) -> Config:
    """Returns CSAC with beta-ranked replay, sec. 3.5; the law of the ranks is the preset's."""
    return _csac(cfg, "beta")


def _csac(cfg: Config, sampler: str) -> Config:
    return cfg.change(
        policy={"place": "cem", "primitive": "argmax"},
        target={"value": "softmax", "bootstrap": "episodic"},
        learn={"actor": True},
        replay={"sampler": sampler},
    )


def vpg(cfg: Config) -> Config:
    """Returns VPG as its authors' code has it (arXiv:1803.09956): best pixel, maximum target with
    discount 0.5 by the network itself, no actor, replay of opposite outcomes.

    An action without effect has no future. An episode's last grasp bootstraps from the next scene.
    Critics and loss are the preset's, as for all. Deviations: docs/paper.md.
    """
    return cfg.change(
        reward=VPG_REWARD,
        policy={"place": "argmax", "primitive": "argmax"},
        target={"value": "max", "gamma": 0.5, "bootstrap": "continuing"},
        explore={"noise_std": 0.0, "epsilon_primitive": (0.5, 0.1), "push_fraction": 0.5},
        learn={"actor": False, "tau": 1.0},
        replay={"sampler": "opposite"},
    )


def reactive(cfg: Config) -> Config:
    """Returns VPG's baseline P+G reactive: no future, gamma = 0.

    Deviation: VPG's classifies outcomes by cross-entropy; here their rewards are regressed.
    """
    return vpg(cfg).change(target={"gamma": 0.0})


def grasp_only(cfg: Config) -> Config:
    """Returns the baseline Grasping-only of CSAC sec. 4.1 and VPG: greedy, no pushes, no future.

    Deviation: as of `reactive`.
    """
    return reactive(cfg).change(policy={"primitive": "grasp"}, explore={"push_fraction": 0.0})


ALGORITHMS: dict[str, Algorithm] = {
    algorithm.__name__: algorithm
    for algorithm in (csac, csac_per, csac_beta, vpg, grasp_only, reactive)
}


def register(name: str, algorithm: Algorithm) -> None:
    """Registers `algorithm`, a function from a config to a config, for API and commands.

    Raises SettingsError if the name is taken.
    """
    require(name not in ALGORITHMS, f"algorithm '{name}' exists; choose another name")
    ALGORITHMS[name] = algorithm


def configure(cfg: Config, name: str) -> Config:
    """Returns the config with the settings of the algorithm `name`. Raises SettingsError."""
    require(name in ALGORITHMS, unknown("algorithm", name, ALGORITHMS))
    return ALGORITHMS[name](cfg).change(algo=name)


def unknown(what: str, name: str, known: Iterable[str]) -> str:
    """Returns the message about an unknown name, with the nearest known one."""
    near = difflib.get_close_matches(name, known, 1)
    meant = f"did you mean {near[0]}? " if near else ""
    return f"unknown {what} '{name}'; {meant}choose one of: {', '.join(known)}"
