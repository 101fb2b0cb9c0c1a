"""What a policy is measured on: environments whose scenes training never saw.

`own`        scenes dropped or arranged like the training's, from another stream of random numbers.
`random10`   ten blocks of all shapes, dropped.
`random30`   thirty, poured into a pile; on a CPU of use in C MuJoCo (`--physics c`) only, MJX takes minutes to compile.
`cases`      the shipped hard arrangements, one environment each, turned as a whole from episode to episode.
`target`     the cases and random10 with one marked block to get within 5 actions (CSAC sec. 4.4); for policies of the
             target task.
`generated`  ordered arrangements of all levels of difficulty, drawn anew.
a path       the user's case file.

Dropped and drawn scenes follow streams of random numbers from 1 on; training's is stream 0. Cases
are in no training. Sizes and materials of what is dropped or drawn are SceneConfig's defaults,
whatever a policy was trained with. Every scene is turned by a random yaw, or by quarters where
another turn would take a block out of the square. An episode may take 2.5 actions for every dropped
block, or as many as in training if that is more.
"""

import dataclasses
import typing
from pathlib import Path

import jax
import numpy as np

from csac_jax import env as environment, presets
from csac_jax.config import Config, SceneConfig, SimConfig, SlotKind
from csac_jax.env import Env
from csac_jax.scene import cases, model, sources
from csac_jax.scene.layout import Scene
from csac_jax.sim import physics as simulation

SUITES = ("own", "random10", "random30", "cases", "target", "generated")
TEN = presets.get("fast")  # its blocks are those of random10, its contacts enough for ten
TARGET_ACTIONS = 5  # CSAC sec. 4.4
THIRTY = SimConfig(geom_pairs=72, contacts=240)  # three times those for ten
PACKED: tuple[SlotKind, ...] = ("box",) * 6 + ("arch",) * 2 + ("prism",) * 2 + ("cylinder",) * 2


def environments(
    cfg: Config, suite: str, episodes: int, seed: int, policy: str = "learned"
) -> dict[str, Env]:
    """The suite's parts by name, each for `episodes` episodes of a policy trained with `cfg`.

    Raises ValueError for a suite that is none, a case file that is not sound, or one without the
    target that is asked for; and for the suite `target` where the policy is learned and has never
    been shown one.
    """
    stream = 1 + seed
    if suite == "own":
        return {suite: environment.make_env(cfg, stream, episodes)}
    if suite == "random10":
        return {suite: _ten(cfg, episodes, stream)}
    if suite == "random30":
        return {suite: _thirty(cfg, episodes, stream)}
    if suite == "generated":
        return {suite: _generated(cfg, episodes, stream)}
    if suite == "cases":
        return _cases(cfg)
    if suite == "target":
        cfg = _marked(cfg, policy)
        return {**_cases(cfg), "random10": _with_task(_ten(cfg, episodes, stream), cfg)}
    if Path(suite).is_file():
        return {Path(suite).stem: _case(cfg, Path(suite))}
    raise ValueError(f"--suite: '{suite}' is neither a case file nor one of: {', '.join(SUITES)}")


def _marked(cfg: Config, policy: str) -> Config:
    """The config with the target task."""
    if policy == "learned" and cfg.task.kind != "target":
        raise ValueError(
            "--suite: target needs a policy trained with --task.kind target, this one was trained to clear the table; "
            "choose another suite, or --policy oracle or random"
        )
    task = dataclasses.replace(cfg.task, kind="target", max_actions=TARGET_ACTIONS)
    return dataclasses.replace(cfg, task=task)


def _with_task(env: Env, cfg: Config) -> Env:
    """The environment with the task of `cfg`."""
    return dataclasses.replace(env, cfg=dataclasses.replace(env.cfg, task=cfg.task))


def _wide(cfg: Config, scene: SceneConfig, sim: SimConfig = TEN.sim) -> Config:
    """The config with other blocks, and contacts enough for them: no fewer than those of `sim`."""
    pairs, contacts = max(cfg.sim.geom_pairs, sim.geom_pairs), max(cfg.sim.contacts, sim.contacts)
    return dataclasses.replace(
        cfg, scene=scene, sim=dataclasses.replace(cfg.sim, geom_pairs=pairs, contacts=contacts)
    )


def _dropped(cfg: Config, slots: tuple[SlotKind, ...], sim: SimConfig) -> Config:
    """The config with these blocks in play, of sizes and materials as by default, and actions
    enough to take them."""
    scene = SceneConfig(slots=slots, min_blocks=len(slots))
    task = dataclasses.replace(cfg.task, max_actions=max(cfg.task.max_actions, len(slots) * 5 // 2))
    return dataclasses.replace(_wide(cfg, scene, sim), task=task)


def _ten(cfg: Config, episodes: int, stream: int) -> Env:
    return environment.make_env(_dropped(cfg, TEN.scene.slots, TEN.sim), stream, episodes)


def _thirty(cfg: Config, episodes: int, stream: int) -> Env:
    cfg = _dropped(cfg, TEN.scene.slots * 3, THIRTY)
    scenes = sources.settled(cfg, stream, episodes, poured=True)
    return Env(cfg, simulation.make(model.build(cfg.scene, cfg.sim), cfg.sim), scenes)


def _placed(cfg: Config, scene: SceneConfig, scenes: Scene) -> Env:
    """The environment of scenes [P, N, ...] that nobody dropped."""
    cfg = _wide(cfg, scene)
    return Env(cfg, simulation.make(model.build(scene, cfg.sim), cfg.sim), scenes)


def _case(cfg: Config, path: Path) -> Env:
    case = cases.load(path, cfg.heightmap.extent)
    if cfg.task.kind == "target":
        cases.require_target(case)
    scene = dataclasses.replace(cfg.scene, slots=case.slots, min_blocks=len(case.slots))
    return _placed(cfg, scene, jax.tree.map(lambda leaf: np.asarray(leaf)[None], case.scene))


def _cases(cfg: Config) -> dict[str, Env]:
    """The shipped cases, all in the slots that the largest need of each kind asks for: one
    compilation serves all."""
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
    scene = SceneConfig(slots=PACKED, min_blocks=sources.MIN_ARRANGED)
    scenes = sources.arrangements(scene, cfg.heightmap.extent, stream, episodes)
    return _placed(cfg, scene, scenes)
