"""Methods and settings in words, for readers who do not know the flags."""

from csac_jax.report.comparison import NAMES
from csac_jax.report.results import Variant

WORDS = {
    "explore.decay": "exploration decay",
    "heightmap.size": "map cells",
    "learn.tau": "target update share",
    "learn.updates": "updates per step",
    "net.kind": "network",
    "policy.place": "place by",
    "policy.primitive": "primitive by",
    "replay.capacity": "replay capacity",
    "replay.sampler": "replay",
    "scene.arranged": "share of packed scenes",
    "target.gamma": "discount",
    "target.value": "target value",
    "task.kind": "task",
    "train.actions": "actions",
}
"""Settings whose own name says too little; of the others it is the name without its section."""


def name_of(variant: Variant) -> str:
    """A variant in words."""
    changed = [f"{words(name)} {_value(value)}" for name, value in variant.changed]
    if variant.is_long:
        changed = [variant.source]
    return ", ".join([NAMES.get(variant.algo, variant.algo), *changed])


def words(setting: str) -> str:
    """The name of a setting in words."""
    return WORDS.get(setting, setting.rpartition(".")[2].replace("_", " "))


def _value(text: str) -> str:
    return {"True": "on", "False": "off"}.get(text, text)
