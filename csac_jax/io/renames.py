"""Names in stored files that have changed: each table maps an old name to the name of today.

A config is renamed as it is read, see `configs.from_dict`; so are the values of `sweep --vary`.
"""

from collections.abc import Mapping
from typing import Any

SETTINGS: dict[str, str | None] = {
    "explore.decay": "explore.epsilon_decay",
    "learn.updates": "learn.updates_per_step",
    "net.margin": "net.pad_fraction",
    "net.subcells": "net.subpixel",
    "net.zoom": "net.upsample",
    "policy.cells": "policy.action_mask",
    "policy.retry": "policy.retry_temperature",
    "reward.push_effect": "reward.push_label",
    "reward.source": "reward.outcome_source",
    "scene.arranged": "scene.packed_fraction",
    "cem.std_estimator": None,
    "learn.target_update_period": None,
    "reward.distance_weight": None,
    "reward.eta": None,
    "target.samples": None,
}
"""Settings by their dotted names; None: the setting is gone, whatever its value."""

FIXED = {
    "cem": {"elites", "start"},
    "net": {"pad_fraction", "upsample"},
    "replay": {"middle", "rank_by", "start"},
}
"""Former settings of each section, which must have the value of today's constant."""

VALUES: dict[str, dict[str, str]] = {
    "heightmap.view": {"both": "ortho"},  # half of the episodes were seen from the side
    "policy.action_mask": {"all": "none"},
    "reward.outcome_source": {"truth": "simulator", "sensed": "sensors"},
    "reward.push_label": {"value": "stored", "renewed": "current_critic", "change": "map_changed"},
    "scene.objects": {"made:": "procedural:", "mixed:": "procedural+assemblies:"},
}
"""Values of a setting by its name of today. One that ends with a colon stands for all texts that
begin with it."""

METRICS = {
    "left": "blocks_lost",
    "ill": "physics_diverged",
    "saturated": "contact_overflow",
    "block_left": "block_lost",
    "episode_ill": "episode_physics_diverged",
    "own": "in_distribution",
}
"""Keys of metrics.jsonl and of results of `eval --json`, and the suite of that name."""


def current(values: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the values of a stored config under the names of today."""
    new: dict[str, Any] = {}
    for section, fields in values.items():
        if not isinstance(fields, dict):
            new[section] = fields
            continue
        new.setdefault(section, {})
        for field, value in fields.items():
            dotted = f"{section}.{field}"
            if (name := SETTINGS.get(dotted, dotted)) is not None:
                target, key = (section, field) if name == dotted else name.split(".")
                new.setdefault(target, {})[key] = _current_value(VALUES.get(name, {}), value)
    return new


def current_setting(name: str, value: str) -> tuple[str, str]:
    """Returns the name and the value of today of a varied setting."""
    name = SETTINGS.get(name) or name
    return name, _current_value(VALUES.get(name, {}), value)


def _current_value(texts: Mapping[str, str], value: Any) -> Any:
    for old, new in texts.items():
        if value == old or (old[-1:] == ":" and isinstance(value, str) and value.startswith(old)):
            return new + value[len(old) :]
    return value
