"""What a policy is measured on: environments whose scenes training never saw.

`own`        scenes dropped or arranged like the training's, from another stream of random numbers.
`random10`   ten blocks of all shapes, dropped.
`cases`      the shipped hard arrangements, one environment each, quarter turns of the case as it is.
`generated`  ordered arrangements of all levels of difficulty, drawn anew.
a path       the user's case file.
"""

import dataclasses
from pathlib import Path

import jax
import numpy as np

from csac_jax import env as environment, presets
from csac_jax.config import Config, SceneConfig, SlotKind
from csac_jax.env import Env
from csac_jax.scene import cases, model
from csac_jax.scene.layout import Scene
from csac_jax.sim import physics as simulation

SUITES = ("own", "random10", "cases", "generated")
TEN = presets.get("fast")  # its blocks are those of random10, its contacts enough for ten
PACKED: tuple[SlotKind, ...] = ("box",) * 6 + ("arch",) * 2 + ("prism",) * 2 + ("cylinder",) * 2


def environments(cfg: Config, suite: str, episodes: int, seed: int) -> dict[str, Env]:
    """The suite's parts by name, each for `episodes` episodes of a policy trained with `cfg`.

    Raises ValueError for a suite that is none, a case file that is not sound, or one without the target that is asked
    for.
    """
    stream = 1 + seed  # stream 0 is the training's
    if suite == "own":
        return {suite: environment.make(cfg, stream, episodes)}
    if suite == "random10":
        slots = TEN.scene.slots
        scene = dataclasses.replace(cfg.scene, slots=slots, min_blocks=len(slots), arranged=0.0)
        return {suite: environment.make(_wide(cfg, scene), stream, episodes)}
    if suite == "generated":
        return {suite: _generated(cfg, episodes, stream)}
    if suite == "cases":
        return {name: _case(cfg, cases.shipped(name)) for name in cases.names()}
    if Path(suite).is_file():
        return {Path(suite).stem: _case(cfg, Path(suite))}
    raise ValueError(f"--suite: '{suite}' is neither a case file nor one of: {', '.join(SUITES)}")


def _wide(cfg: Config, scene: SceneConfig) -> Config:
    """The config with other blocks, and contacts enough for them."""
    sim = dataclasses.replace(
        cfg.sim,
        geom_pairs=max(cfg.sim.geom_pairs, TEN.sim.geom_pairs),
        contacts=max(cfg.sim.contacts, TEN.sim.contacts),
    )
    return dataclasses.replace(cfg, scene=scene, sim=sim)


def _placed(cfg: Config, scene: SceneConfig, scenes: Scene) -> Env:
    """The environment of scenes [P, N, ...] that nobody dropped."""
    cfg = _wide(cfg, scene)
    return Env(cfg, simulation.make(model.build(scene, cfg.sim), cfg.sim), scenes, any_yaw=False)


def _case(cfg: Config, path: Path) -> Env:
    case = cases.load(path, cfg.heightmap.extent)
    if cfg.task.kind == "target":
        cases.require_target(case)
    scene = dataclasses.replace(cfg.scene, slots=case.slots, min_blocks=len(case.slots))
    return _placed(cfg, scene, jax.tree.map(lambda leaf: np.asarray(leaf)[None], case.scene))


def _generated(cfg: Config, episodes: int, stream: int) -> Env:
    scene = dataclasses.replace(cfg.scene, slots=PACKED, min_blocks=environment.LEAST_ARRANGED)
    scenes = environment.arrangements(scene, cfg.heightmap.extent, stream, episodes)
    return _placed(cfg, scene, scenes)
