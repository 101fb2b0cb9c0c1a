"""Variants of a method: their names, and the commands that make their runs and evaluations."""

import contextlib
import dataclasses
import functools
import json
from collections.abc import Iterable
from typing import Any

from csac_jax import algorithms, presets
from csac_jax.config import Config
from csac_jax.io import configs

NAMES = {
    "grasp_only": "Grasping-only",
    "reactive": "P+G reactive",
    "vpg": "VPG",
    "csac": "CSAC",
    "csac_per": "CSAC-PER",
    "csac_beta": "CSAC-beta",
}
UNNAMED = {"seed", "preset", "algo", "sim.physics"}  # have a place of their own in tables
UNNAMED |= {"format", "train.chunk", "train.save_every"}  # no result depends on them
PARTS = {"parts": ""}  # of configs without parts of one's own
OWN_LEARNER = "own learner"  # has no algorithm of the config's
LENGTH = "train."  # settings of a run's length and shape do not make another method
MOST_CHANGES = 6  # a variant with more is named by its folder
DECISION = {"policy.augment": False, "policy.height_bonus": 0.0, "policy.retry_temperature": 0.0}
"""Settings that `eval` can change, and their values in configs that lack them."""
VIEW = ("camera.", "sensor.", "heightmap.view", "sim.gripper", "sim.clearance", "sim.opening")
"""Likewise."""
WORLD = ("sim.", "camera.", "sensor.", "heightmap.")
"""Sections of what an evaluation acts in, whoever acts."""

Json = dict[str, Any]


@dataclasses.dataclass(frozen=True, order=True)
class Variant:
    """Everything that runs share which differ in their seed alone."""

    preset: str
    algo: str
    changed: tuple[tuple[str, str], ...]  # dotted settings unlike the preset's, values as text
    source: str = dataclasses.field(default="", compare=False)  # name of the folder or file

    @property
    def unchanged(self) -> bool:
        """Returns True for the algorithm as the preset has it, whatever the run's length."""
        return all(name.startswith(LENGTH) for name, _ in self.changed)


def variant(config: Json) -> Variant:
    """Builds the variant of a recorded config. Missing settings count as the preset's."""
    preset, algo = config.get("preset", ""), config.get("algo", Config.algo)
    base, settings = {}, configs.flat(config)
    with contextlib.suppress(ValueError):  # the preset or the algorithm is gone
        base = _preset_settings(preset, algo)
    with contextlib.suppress(ValueError):  # written by a version with other settings
        settings = _settings(json.dumps({**config, "seed": 0}))
    changed = tuple(
        (name, _text(value))
        for name, value in settings.items()
        if value != base.get(name, PARTS.get(name, value)) and name not in UNNAMED
    )
    has_learner = "learner " in settings.get("parts", "")
    return Variant(preset, OWN_LEARNER if has_learner else algo, changed)


@functools.cache
def _preset_settings(preset: str, algo: str) -> Json:
    cfg = presets.get(preset)
    if algo in algorithms.ALGORITHMS:  # one that is gone is described by its settings
        cfg = algorithms.configure(cfg, algo)
    return configs.with_former(cfg)


@functools.lru_cache(maxsize=64)  # runs of a folder mostly differ in their seed
def _settings(text: str) -> Json:
    return configs.recorded(json.loads(text))


def world_settings(config: Json) -> dict[str, str]:
    """Returns the settings of WORLD by name, as text."""
    settings = configs.flat(config)
    with contextlib.suppress(ValueError):  # written by a version with other settings
        settings = _settings(json.dumps({**config, "seed": 0}))
    return {name: _text(value) for name, value in settings.items() if name.startswith(WORLD)}


def label(variant: Variant, preset: bool = True, most: int | None = None) -> str:
    """Names a variant with at most `most` of its changes, or by its folder if it has many."""
    name = NAMES.get(variant.algo, variant.algo)
    changed = [" ".join(change).removeprefix("parts ") for change in variant.changed]
    if most is None and len(changed) > MOST_CHANGES and variant.source:
        changed = [variant.source]
    if most is not None and len(changed) > most:
        changed[most:] = [f"others ({len(changed) - most})"]
    return ", ".join([f"{name} ({variant.preset})" if preset else name, *changed])


def world(config: Json) -> tuple[str, str]:
    """Returns physics and robot of a config; the first records name neither."""
    sim = config.get("sim", {})
    return sim.get("physics", "mjx"), sim.get("robot", "hand")


def train_command(config: Json) -> str:
    """Returns the command that trains with a recorded config."""
    made, (physics, _) = variant(config), world(config)
    algo, seed = config.get("algo", Config.algo), config.get("seed", 0)
    command = f"csac-jax train {made.preset} --algo {algo} --seed {seed}"
    command += f" --sim.physics {physics}{_flags(made.changed)}"
    return f"{command}, by csac_jax.train with {config['parts']}" if "parts" in config else command


def eval_command(asked: str, evaluated: Json, trained: Json) -> str:
    """Returns the command of an evaluation: what was `asked`, and where the configs differ."""
    physics, robot = world(evaluated)
    now, before = ({**DECISION, **configs.flat(one)} for one in (evaluated, trained))
    options = f"csac-jax eval RUN {asked} --physics {physics} --robot {robot}"
    if library := now.get("scene.objects"):
        options += "" if library == before.get("scene.objects") else f" --objects {library}"
        split = now.get("scene.split", "")
        options += "" if split == "held_out" else f" --split {split}"
    for name in DECISION:
        if (value := now[name]) != before[name]:
            text = {True: "on", False: "off"}[value] if isinstance(value, bool) else value
            options += f" --{name.removeprefix('policy.').replace('_', '-')} {text}"
    viewed = [name for name in now if name.startswith(VIEW)]
    changed = [name for name in viewed if now[name] != before.get(name, now[name])]
    return options + _flags((name, _text(now[name])) for name in changed)


def _text(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


def _flags(settings: Iterable[tuple[str, str]]) -> str:
    """Writes settings as options; a switch that is off is --SECTION.no-FIELD."""
    text = ""
    for name, value in settings:
        if name in PARTS:
            continue  # no option makes them
        section, _, field = name.replace("_", "-").rpartition(".")
        switch = {"True": field, "False": f"no-{field}"}.get(value, f"{field} {value}")
        text += f" --{section}.{switch}"
    return text
