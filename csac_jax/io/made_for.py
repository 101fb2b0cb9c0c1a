"""The world that a policy was trained in, in words, and a warning where it acts in another one."""

import warnings

from csac_jax import grippers
from csac_jax.config import Config
from csac_jax.errors import DataWarning

TASKS = {"clear": "take all", "target": "get a marked one", "both": "take all, or get a marked one"}


def task(cfg: Config) -> str:
    """Returns the task of a config."""
    return TASKS[cfg.task.kind]


def objects(cfg: Config) -> str:
    """Returns what lies in the scenes of a config."""
    some = "objects of many shapes"
    if not cfg.scene.has_objects:
        return "blocks"
    return some if set(cfg.scene.slots) == {"object"} else f"blocks and {some}"


def hand(cfg: Config) -> str:
    """Returns the hands that a policy of this config knows."""
    return "any" if cfg.net.gripper else str(cfg.sim.gripper)


def view(cfg: Config) -> str:
    """Returns what a policy of this config sees."""
    if cfg.heightmap.view == "ortho":
        return "maps from above"
    noise = "exact" if cfg.sensor.kind == "none" else "noisy"
    return f"{noise} images of an oblique camera"


def warn_if_elsewhere(made: Config, used: Config) -> None:
    """Warns, in one line, of a hand, view, task or objects that a policy was not trained with."""
    hands = (grippers.load(cfg.sim.gripper).fingers for cfg in (made, used))
    same_hand = made.net.gripper or len(set(hands)) == 1
    mixed = len({kind == "object" for kind in made.scene.slots}) == 2
    pairs = {  # any will do, what was, what is
        "hand ": (same_hand, str(made.sim.gripper), str(used.sim.gripper)),
        "view ": (False, view(made), view(used)),
        "task ": (made.task.kind == "both", task(made), task(used)),
        "": (mixed, objects(made), objects(used)),
    }
    others = [
        f"{name}{was}, not {now}"
        for name, (knows, was, now) in pairs.items()
        if not knows and was != now
    ]
    if others:
        text = f"this policy was trained with {'; '.join(others)}: expect less of it"
        warnings.warn(f"{text}; csac-jax policies lists those that ship", DataWarning, stacklevel=3)
