"""Suites: scenes that training never saw, in which policies are measured.

`in_distribution`  scenes dropped or arranged like the training's, from other random numbers.
`random10`         ten blocks of all shapes, dropped.
`random30`         thirty, poured into a pile. In MJX on a CPU it takes minutes to compile.
`cases`            the shipped hard arrangements, one part each, turned in every episode.
`target`           the cases and random10 with one marked block to get within 5 actions (CSAC
                   sec. 4.4); for policies of the target task.
`packed`           ordered arrangements of all levels of difficulty.
`camera`           random10 seen straight down, from the side, with the noise of a depth camera,
                   with a camera that is also 5 mm off, and with the noise and other colours.
`pile`             five objects of a library, poured into a pile.
`objects_packed`   five, upright side by side.
`objects10`        ten, dropped as in random10.
`target_objects`   one marked object among ten, to get within 5 actions.
`blocked`          blocks side by side, of which no grasp lifts one before a push.
`enclosed`         one marked block that others enclose, to get within 5 actions.
`tray`             blocks along the walls and in the corners of a tray.
`tight`            piles of objects whose middle side is 0.6 to 0.95 of the opening, for hands that
                   open by 110 and 80 mm.
`hidden`           one marked block to get within 10 actions; from above 50 to 100 %, 1 to 50 % and
                   nothing of it is seen.
a path             the user's case file, or a folder of them, one part each.

Suites of objects draw from the library of `scene.objects`; docs/benchmark.md defines them.
Training draws from stream 0 of random numbers, a suite from stream 1 + seed. Dropped and drawn
blocks have SceneConfig's default sizes and materials. Every scene is turned by a random yaw, or by
quarters where another turn would take a block out of the workspace.
"""

import dataclasses
import functools
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from csac_jax import env as environment, grippers
from csac_jax.config import (
    Config,
    PhysicsKind,
    RobotKind,
    SceneConfig,
    SensorConfig,
    SensorKind,
    SimConfig,
    SlotKind,
    TaskKind,
)
from csac_jax.constants import RENAMED_SUITES
from csac_jax.env import MAX_FAILURES, Env
from csac_jax.errors import SettingsError
from csac_jax.objects.library import Split
from csac_jax.runtime import short
from csac_jax.scenes import arrange, cases, certify, constructions, pool
from csac_jax.section import require
from csac_jax.sim import backend, physics as simulation
from csac_jax.vision import observe
from csac_jax.world import model, object_slots, scene_state
from csac_jax.world.scene_state import SceneState

IN_DISTRIBUTION = "in_distribution"
TEN: tuple[SlotKind, ...] = (  # blocks of random10, of all kinds
    *("box", "box", "arch", "prism", "box"),
    *("cylinder", "half_cylinder", "box", "box", "box"),
)
TEN_CONTACTS = SimConfig(geom_pairs=24, contacts=80)
TARGET = {"kind": "target", "max_actions": 5}  # CSAC sec. 4.4
FEW = 5  # objects of `pile` and `objects_packed` (VGN, arXiv:2101.01132)
ACTIONS_EACH = 5  # most actions for each object (ours): pushes do not count as failures
TIGHT = (0.6, 0.95)  # middle side of an object of `tight` over the hand's opening
HIDDEN = {"kind": "target", "max_actions": 10}  # ours: a search takes longer
SEEN = {"seen_50_100": (0.5, 1.0), "seen_1_50": (0.01, 0.5), "seen_0": (-1.0, 0.0)}  # above, to
PACKED: tuple[SlotKind, ...] = ("box",) * 6 + ("arch",) * 2 + ("prism",) * 2 + ("cylinder",) * 2

# Config of the policy, episodes, stream of random numbers -> parts by name, or the only one.
Build = Callable[[Config, int, int], dict[str, Env] | Env]


class Suite(NamedTuple):
    """The builder of a suite's parts, and the policies that it is for."""

    build: Build
    episodes: int = 250  # of every part in a full measurement
    target: bool = False  # it asks for a target: a learned policy must know that task
    objects: bool = False  # it needs a library of objects


class PreparedSuite(NamedTuple):
    """The environments of a suite, built once for any number of policies of one config."""

    name: str
    cfg: Config
    parts: dict[str, Env]
    episodes: int  # of every part
    seed: int

    def __repr__(self) -> str:
        return short.text(self)


SUITES: dict[str, Suite] = {}


def register(
    name: str, build: Build, episodes: int = 250, target: bool = False, objects: bool = False
) -> None:
    """Adds a suite; see `Suite`. Raises SettingsError for a name that is taken."""
    if name in SUITES or name in RENAMED_SUITES:
        raise SettingsError(f"there is a suite '{name}' already; choose another name")
    SUITES[name] = Suite(build, episodes, target, objects)


def prepare(
    cfg: Config,
    suite: str,
    episodes: int = 50,
    seed: int = 0,
    physics: PhysicsKind = "auto",
    robot: RobotKind = "hand",
    objects: str | None = None,
    split: Split = "held_out",
    learned: bool = True,
) -> PreparedSuite:
    """Builds the environments of a suite for policies of a config; settles their scenes.

    Args: suite, a name of `SUITES`, a case file or a folder of them; episodes, of every part;
    objects and split, the library of suites of objects, by default the config's; learned, False for
    a policy that needs no training. Raises SettingsError for a suite that is unknown, damaged or
    does not fit the policy, and for a library that is missing or not needed.
    """
    check(suite)
    suite = RENAMED_SUITES.get(suite, suite)
    cfg = _with_objects(cfg, suite, objects, split)
    few = cfg.change(sim={"physics": physics, "robot": robot}, train={"scenes": 1})
    cfg = cfg.change(sim=backend.resolve(few).sim)  # `auto`: what suits a few scenes at a time
    if suite not in SUITES:
        parts: Any = {path.stem: _case(cfg, path) for path in _case_files(Path(suite))}
    elif SUITES[suite].target and learned and not cfg.task.has_target:
        raise SettingsError(
            f"suite: {suite} needs a policy trained with task.kind target, this one was trained to "
            "clear the table; choose another suite, or the policy oracle or random"
        )
    else:
        cfg = _with_suite_task(cfg, SUITES[suite].target)
        parts = SUITES[suite].build(cfg, episodes, 1 + seed)
    parts = parts if isinstance(parts, dict) else {suite: parts}
    return PreparedSuite(suite, cfg, parts, episodes, seed)


def standard(cfg: Config, suite: str) -> Config:
    """Returns a policy's config with one world where it trained in many, for the suites of all.

    A hand that varies becomes the RG2, a drawn grip the gripper's own; its certified scenes are
    left out. `in_distribution` keeps what training had.
    """
    if suite == IN_DISTRIBUTION:
        return cfg
    world: dict[str, Any] = {}
    if grippers.load(cfg.sim.gripper).varies is not None:
        world["gripper"] = SimConfig.gripper
    for name in ("pad_friction", "grip_force"):
        low, high = getattr(cfg.sim, name)
        if low < high:
            world[name] = getattr(SimConfig, name)
    return cfg.change(sim=world, scene={"certified": SceneConfig.certified})


def check(suite: str) -> None:
    """Raises SettingsError for a name that is neither a suite's, nor a file's, nor a folder's."""
    if RENAMED_SUITES.get(suite, suite) in SUITES:
        return
    if not Path(suite).exists():
        known = ", ".join(SUITES)
        raise SettingsError(f"suite: '{suite}' is neither a case file nor one of: {known}")
    require(bool(_case_files(Path(suite))), f"suite: {suite} holds no case file, NAME.json")


def _with_suite_task(cfg: Config, target: bool) -> Config:
    """Chooses the task of a suite for policies that were trained in both."""
    kind: TaskKind = "target" if target else "clear"
    return cfg.change(task={"kind": kind}) if cfg.task.kind == "both" else cfg


def _case_files(path: Path) -> list[Path]:
    return sorted(path.glob("*.json")) if path.is_dir() else [path]


def _with_objects(cfg: Config, suite: str, objects: str | None, split: Split) -> Config:
    if suite not in SUITES or not SUITES[suite].objects:
        if objects is not None:
            names = ", ".join(name for name, entry in SUITES.items() if entry.objects)
            raise SettingsError(f"objects: '{suite}' has no objects of a library; {names} have")
        return cfg
    if not (source := objects or cfg.scene.objects):
        raise SettingsError(
            f"objects: {suite} needs a library; csac-jax objects make --out LIB makes one, or "
            "give procedural:0:200"
        )
    scene = SceneConfig(slots=("object",), min_blocks=1, objects=source, split=split)
    return cfg.change(scene=scene, sim={"physics": "auto"})


def _wide(cfg: Config, scene: SceneConfig, sim: SimConfig = TEN_CONTACTS) -> Config:
    """Replaces the blocks, and allows at least the contacts of `sim`."""
    pairs, contacts = max(cfg.sim.geom_pairs, sim.geom_pairs), max(cfg.sim.contacts, sim.contacts)
    return cfg.change(scene=scene, sim={"geom_pairs": pairs, "contacts": contacts})


def _env(cfg: Config, scenes: SceneState, max_failures: int = 0) -> Env:
    physics = simulation.make(model.build(cfg.scene, cfg.sim), cfg.sim)
    return Env(cfg, physics, scenes, max_failures=max_failures)


def _dropped(cfg: Config, slots: tuple[SlotKind, ...], sim: SimConfig) -> Config:
    """Puts these blocks in play, of default sizes, with 2.5 actions for each or more."""
    actions = max(cfg.task.max_actions, len(slots) * 5 // 2)
    scene = SceneConfig(slots=slots, min_blocks=len(slots))
    return _wide(cfg, scene, sim).change(task={"max_actions": actions})


def _ten(cfg: Config, episodes: int, stream: int) -> Env:
    return environment.make_env(_dropped(cfg, TEN, TEN_CONTACTS), stream, episodes)


def _thirty(cfg: Config, episodes: int, stream: int) -> Env:
    cfg = _dropped(cfg, TEN * 3, SimConfig(geom_pairs=72, contacts=240))
    return _env(cfg, pool.settled(cfg, stream, episodes, poured=True))


def _pool(scene: SceneState) -> SceneState:
    """Makes a pool of one scene, leaves [1, N, ...]."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[None], scene)


def _case(cfg: Config, path: Path) -> Env:
    try:
        case = cases.load(path, cfg.heightmap.extent)
        cfg = _with_suite_task(cfg, bool(case.scene.target != scene_state.ANY))
        if cfg.task.kind == "target":
            cases.require_target(case)
    except ValueError as error:
        raise SettingsError(str(error)) from None
    placed: Any = {"slots": case.slots, "min_blocks": len(case.slots), "packed_fraction": 0.0}
    placed |= {"objects": case.objects, "split": "all"} if case.objects else {}
    return _env(_wide(cfg, dataclasses.replace(cfg.scene, **placed)), _pool(case.scene))


def _cases(cfg: Config, *_: int) -> dict[str, Env]:
    """Builds the shipped cases, with slots for the most blocks of each kind: one compilation."""
    loaded = {name: cases.load(cases.shipped(name), cfg.heightmap.extent) for name in cases.names()}
    slots: tuple[SlotKind, ...] = ()
    for kind in typing.get_args(SlotKind):
        slots += (kind,) * max(case.slots.count(kind) for case in loaded.values())
    cfg = _wide(cfg, dataclasses.replace(cfg.scene, slots=slots, min_blocks=1))
    seated = {name: _pool(cases.seat(case, slots)) for name, case in loaded.items()}
    first = _env(cfg, next(iter(seated.values())))
    return {name: dataclasses.replace(first, scenes=scenes) for name, scenes in seated.items()}


def _target(cfg: Config, episodes: int, stream: int) -> dict[str, Env]:
    cfg = cfg.change(task=TARGET)
    return {**_cases(cfg), "random10": _as_target(_ten(cfg, episodes, stream))}


def _packed(cfg: Config, episodes: int, stream: int) -> Env:
    cfg = _wide(cfg, SceneConfig(slots=PACKED, min_blocks=arrange.MIN_ARRANGED))
    return _env(cfg, arrange.arrangements(cfg.scene, cfg.heightmap.extent, stream, episodes))


def _objects(cfg: Config, count: int, extent: float) -> Config:
    """Puts `count` objects in play, placed in a square of side `extent` m."""
    placed: Any = {"slots": ("object",) * count, "min_blocks": count}
    scene = dataclasses.replace(cfg.scene, **placed, drop_extent=(extent, extent))
    return _wide(cfg, scene).change(task={"max_actions": ACTIONS_EACH * count})


def _pile(
    cfg: Config, episodes: int, stream: int, sides: tuple[float, float] = object_slots.ANY_SIDE
) -> Env:
    cfg = _objects(cfg, FEW, 0.10)  # extents as in VGN
    return _env(cfg, pool.settled(cfg, stream, episodes, poured=True, sides=sides), MAX_FAILURES)


def _objects_packed(cfg: Config, episodes: int, stream: int) -> Env:
    cfg = _objects(cfg, FEW, 0.30)
    return _env(cfg, pool.settled(cfg, stream, episodes, packed=True), MAX_FAILURES)


def _objects10(cfg: Config, episodes: int, stream: int) -> Env:
    cfg = _objects(cfg, 10, SceneConfig().drop_extent[0])
    return _env(cfg, pool.settled(cfg, stream, episodes))


def _as_target(env: Env) -> Env:
    return _with_task(env, TARGET)


def _pushes(suite: str, cfg: Config, *_: int) -> Env:
    """Builds a suite whose scenes need pushes; 2.5 actions for each block or more, as dropped."""
    scene = constructions.SUITES[suite]
    actions = max(cfg.task.max_actions, len(scene.slots) * 5 // 2)
    cfg = _wide(cfg, scene).change(sim=constructions.SIM, task={"max_actions": actions})
    certified = certify.load(certify.shipped(suite))
    return _env(cfg, certified.scenes, MAX_FAILURES)


def _with_task(env: Env, task: dict[str, Any]) -> Env:
    return dataclasses.replace(env, cfg=env.cfg.change(task=task))


def _hidden(cfg: Config, *_: int) -> dict[str, Env]:
    """Builds a part for each range of what is seen of the target."""
    env = _with_task(_pushes("hidden", cfg), HIDDEN)
    share = functools.partial(observe.seen_share, env.cfg.scene)
    shares = np.asarray(jax.jit(functools.partial(jax.lax.map, share))(env.scenes))
    return {
        name: dataclasses.replace(
            env, scenes=jax.tree.map(lambda leaf, rows=rows: leaf[rows], env.scenes)
        )
        for name, (low, high) in SEEN.items()
        if (rows := (shares > low) & (shares <= high)).any()
    }


def _tight(cfg: Config, episodes: int, stream: int) -> dict[str, Env]:
    """Builds piles of objects that hardly fit the hand, for two hands."""
    parts = {}
    for gripper in ("rg2", "franka_hand"):
        opening = grippers.load(gripper).opening[1]
        sides = (TIGHT[0] * opening, TIGHT[1] * opening)
        hand = cfg.change(sim={"gripper": gripper})
        parts[f"{1e3 * opening:.0f}_mm"] = _pile(hand, episodes, stream, sides)
    return parts


def _camera(cfg: Config, episodes: int, stream: int) -> dict[str, Env]:
    """Builds random10 for five cameras; the depth camera is the config's, or a D415."""
    kind: SensorKind = "d415" if cfg.sensor.kind == "none" else cfg.sensor.kind
    exact, noisy = SensorConfig(), SensorConfig(kind=kind)
    sensors = {
        "straight_down": exact,
        "oblique": exact,
        "noise": noisy,
        "noise_5mm": dataclasses.replace(noisy, pose_noise=(0.005, 0.0)),
        "noise_colours": dataclasses.replace(noisy, colour=0.2, light=0.2),
    }
    ten = _ten(cfg.change(heightmap={"view": "ortho"}, sensor=exact), episodes, stream)
    views = {name: {"view": "oblique"} for name in sensors} | {"straight_down": {}}
    return {
        name: dataclasses.replace(ten, cfg=ten.cfg.change(heightmap=views[name], sensor=sensor))
        for name, sensor in sensors.items()
    }


register(IN_DISTRIBUTION, lambda cfg, count, stream: environment.make_env(cfg, stream, count))
register("random10", _ten, 500)
register("random30", _thirty, 100)
register("cases", _cases)
register("target", _target, target=True)
register("packed", _packed)
register("camera", _camera)
register("pile", _pile, 1000, objects=True)
register("objects_packed", _objects_packed, 1000, objects=True)
register("objects10", _objects10, 500, objects=True)
register("target_objects", lambda *of: _as_target(_objects10(*of)), 500, target=True, objects=True)
register("blocked", functools.partial(_pushes, "blocked"))
register("enclosed", lambda *of: _as_target(_pushes("enclosed", *of)), target=True)
register("tray", functools.partial(_pushes, "tray"))
register("tight", _tight, 500, objects=True)
register("hidden", _hidden, target=True)
