"""What a policy is measured on: environments whose scenes training never saw.

`in_distribution`  scenes dropped or arranged like the training's, from other random numbers.
`random10`         ten blocks of all shapes, dropped.
`random30`         thirty, poured into a pile. In MJX on a CPU it takes minutes to compile.
`cases`            the shipped hard arrangements, one part each, turned in every episode.
`target`           the cases and random10 with one marked block to get within 5 actions (CSAC
                   sec. 4.4); for policies of the target task.
`generated`        ordered arrangements of all levels of difficulty.
a path             the user's case file.

Training draws from stream 0 of random numbers, a suite from stream 1 + seed. No case is in
training. Sizes and materials of dropped and drawn blocks are SceneConfig's defaults, whatever a
policy was trained with. Every scene is turned by a random yaw, or by quarters where another turn
would take a block out of the workspace. Dropped suites allow 2.5 actions per block, or as many as
in training if that is more.
"""

import dataclasses
import typing
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from csac_jax import env as environment, presets
from csac_jax.config import Config, SceneConfig, SimConfig, SlotKind
from csac_jax.constants import RENAMED_SUITES
from csac_jax.env import Env
from csac_jax.scene import arrange, cases, model, pool
from csac_jax.scene.layout import Scene
from csac_jax.sim import physics as simulation

IN_DISTRIBUTION = "in_distribution"
TEN = presets.get("fast")  # its blocks are those of random10, its contacts enough for ten
TARGET_ACTIONS = 5  # CSAC sec. 4.4
THIRTY = SimConfig(geom_pairs=72, contacts=240)  # three times those for ten
PACKED: tuple[SlotKind, ...] = ("box",) * 6 + ("arch",) * 2 + ("prism",) * 2 + ("cylinder",) * 2

Build = Callable[[Config, int, int], dict[str, Env]]


class Suite(NamedTuple):
    """How the parts of a suite are made."""

    build: Build  # config of the policy, episodes, stream of random numbers -> parts by name
    target: bool = False  # it asks for a target: a learned policy must know that task


SUITES: dict[str, Suite] = {}


def register(name: str, build: Build, target: bool = False) -> None:
    """Adds a suite. Raises ValueError where there is one of that name."""
    if name in SUITES or name in RENAMED_SUITES:
        raise ValueError(f"there is a suite '{name}' already; choose another name")
    SUITES[name] = Suite(build, target)


def environments(
    cfg: Config, suite: str, episodes: int, seed: int, learned: bool = True
) -> dict[str, Env]:
    """The suite's parts by name, each for `episodes` episodes of a policy with this config.

    Raises ValueError for an unknown suite, an unsound case file or one without the target asked
    for, and for a suite with targets where the policy is learned and was trained without.
    """
    suite = RENAMED_SUITES.get(suite, suite)
    if suite in SUITES:
        build, target = SUITES[suite]
        if target and learned and cfg.task.kind != "target":
            raise ValueError(
                f"--suite: {suite} needs a policy trained with --task.kind target, this one was "
                "trained to clear the table; choose another suite, or --policy oracle or random"
            )
        return build(cfg, episodes, 1 + seed)
    if Path(suite).is_file():
        return {Path(suite).stem: _case(cfg, Path(suite))}
    raise ValueError(f"--suite: '{suite}' is neither a case file nor one of: {', '.join(SUITES)}")


def _target(cfg: Config, episodes: int, stream: int) -> dict[str, Env]:
    task = dataclasses.replace(cfg.task, kind="target", max_actions=TARGET_ACTIONS)
    cfg = dataclasses.replace(cfg, task=task)
    ten = _ten(cfg, episodes, stream)
    ten = dataclasses.replace(ten, cfg=dataclasses.replace(ten.cfg, task=task))
    return {**_cases(cfg), "random10": ten}


def _wide(cfg: Config, scene: SceneConfig, sim: SimConfig = TEN.sim) -> Config:
    """The config with other blocks, and contacts enough for them: at least those of `sim`."""
    pairs, contacts = max(cfg.sim.geom_pairs, sim.geom_pairs), max(cfg.sim.contacts, sim.contacts)
    return dataclasses.replace(
        cfg, scene=scene, sim=dataclasses.replace(cfg.sim, geom_pairs=pairs, contacts=contacts)
    )


def _dropped(cfg: Config, slots: tuple[SlotKind, ...], sim: SimConfig) -> Config:
    """The config with these blocks in play, of default sizes, and actions enough to take them."""
    scene = SceneConfig(slots=slots, min_blocks=len(slots))
    task = dataclasses.replace(cfg.task, max_actions=max(cfg.task.max_actions, len(slots) * 5 // 2))
    return dataclasses.replace(_wide(cfg, scene, sim), task=task)


def _ten(cfg: Config, episodes: int, stream: int) -> Env:
    return environment.make_env(_dropped(cfg, TEN.scene.slots, TEN.sim), stream, episodes)


def _thirty(cfg: Config, episodes: int, stream: int) -> Env:
    cfg = _dropped(cfg, TEN.scene.slots * 3, THIRTY)
    scenes = pool.settled(cfg, stream, episodes, poured=True)
    return Env(cfg, simulation.make(model.build(cfg.scene, cfg.sim), cfg.sim), scenes)


def _placed(cfg: Config, scene: SceneConfig, scenes: Scene) -> Env:
    """The environment of scenes [P, N, ...] that were placed, not dropped."""
    cfg = _wide(cfg, scene)
    return Env(cfg, simulation.make(model.build(scene, cfg.sim), cfg.sim), scenes)


def _case(cfg: Config, path: Path) -> Env:
    case = cases.load(path, cfg.heightmap.extent)
    if cfg.task.kind == "target":
        cases.require_target(case)
    scene = dataclasses.replace(cfg.scene, slots=case.slots, min_blocks=len(case.slots))
    return _placed(cfg, scene, jax.tree.map(lambda leaf: np.asarray(leaf)[None], case.scene))


def _cases(cfg: Config) -> dict[str, Env]:
    """The shipped cases. All have slots for the most blocks of each kind: one compilation."""
    every = {name: cases.load(cases.shipped(name), cfg.heightmap.extent) for name in cases.names()}
    most = {
        kind: max(case.slots.count(kind) for case in every.values())
        for kind in typing.get_args(SlotKind)
    }
    slots = tuple(kind for kind, count in most.items() for _ in range(count))
    scene = dataclasses.replace(cfg.scene, slots=slots, min_blocks=1)
    cfg = _wide(cfg, scene)
    physics = simulation.make(model.build(scene, cfg.sim), cfg.sim)
    seated = {name: cases.seat(case, slots) for name, case in every.items()}
    return {
        name: Env(cfg, physics, jax.tree.map(lambda leaf: np.asarray(leaf)[None], scene))
        for name, scene in seated.items()
    }


def _generated(cfg: Config, episodes: int, stream: int) -> Env:
    scene = SceneConfig(slots=PACKED, min_blocks=arrange.MIN_ARRANGED)
    scenes = arrange.arrangements(scene, cfg.heightmap.extent, stream, episodes)
    return _placed(cfg, scene, scenes)


def _single(name: str, build: Callable[[Config, int, int], Env]) -> Build:
    """A suite of one part, which has the suite's name."""
    return lambda cfg, episodes, stream: {name: build(cfg, episodes, stream)}


register(
    IN_DISTRIBUTION,
    _single(IN_DISTRIBUTION, lambda cfg, count, stream: environment.make_env(cfg, stream, count)),
)
register("random10", _single("random10", _ten))
register("random30", _single("random30", _thirty))
register("cases", lambda cfg, episodes, stream: _cases(cfg))
register("target", _target, target=True)
register("generated", _single("generated", _generated))
