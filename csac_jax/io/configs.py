"""Config to JSON and back. Old formats are translated; a missing setting takes its default.

An unknown setting, a wrong type or a value out of range raises ValueError in one line.
"""

import dataclasses
import functools
import json
import math
from pathlib import Path
from typing import Any

from csac_jax import config, grippers
from csac_jax.config import CameraConfig, Config, SimConfig
from csac_jax.grippers import Gripper
from csac_jax.io import renames


def to_dict(cfg: Config) -> dict[str, Any]:
    """A config as plain JSON values, with the number of its format."""
    gripper = cfg.sim.gripper
    if isinstance(gripper, Gripper):
        cfg = cfg.change(sim={"gripper": ""})
    values = {"format": renames.FORMAT, **json.loads(json.dumps(dataclasses.asdict(cfg)))}
    if isinstance(gripper, Gripper):
        numbers = grippers.to_numbers(gripper)
        values["sim"]["gripper"] = {"folder": str(gripper.folder), **numbers}
    return values


def from_dict(values: Any) -> Config:
    """The inverse of `to_dict`, for every format written so far. Raises ValueError."""
    if not isinstance(values, dict):
        raise ValueError(f"config: must be an object, not {config.shown(values)}")
    values = dict(values)
    number = values.pop("format", 1)
    if number not in (1, renames.FORMAT):
        raise ValueError(
            f"format: {config.shown(number)} is unknown, "
            f"this version reads up to {renames.FORMAT}; update csac-jax"
        )
    try:
        values = _from_format_1(values) if number == 1 else _without_constants(values)
    except (TypeError, KeyError, IndexError, AttributeError, OverflowError):
        raise ValueError("a setting of the old format has a value of another kind") from None
    values["algo"] = algorithm(values)
    return Config(**{name: _validated(name, value) for name, value in values.items()})


def algorithm(values: dict[str, Any]) -> Any:
    """Today's name of the algorithm of a stored config; the default's where it has none."""
    stored, target = values.get("algo", Config.algo), values.get("target")
    former, setting = renames.ALGORITHMS.get(str(stored), (stored, ""))
    return stored if isinstance(target, dict) and setting in target else former


def differences(a: Config, b: Config) -> list[str]:
    """Dotted names of the settings in which two configs differ, in order of their definition."""
    flat_a, flat_b = flat(to_dict(a)), flat(to_dict(b))
    names = dict.fromkeys([*flat_a, *flat_b])
    return [name for name in names if flat_a.get(name) != flat_b.get(name)]


def flat(values: dict[str, Any]) -> dict[str, Any]:
    """Dotted name of each setting -> its value."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        fields = value if isinstance(value, dict) else {}
        flat |= {f"{name}.{field}": item for field, item in fields.items()} or {name: value}
    return flat


def _kind(name: str, stored: Any) -> Any:
    """Type of a section or a setting outside them; of alternatives, the one that is stored."""
    if name not in config.names(Config):
        raise ValueError(f"{name}: unknown setting")
    tag, _ = config.ALTERNATIVES.get(name, ("", ()))
    if tag and isinstance(stored, dict) and tag in stored:
        return config.alternative_kind(name, stored[tag])
    return type(getattr(Config, name))


def _validated(name: str, stored: Any) -> Any:
    if name == "sim" and isinstance(stored, dict) and isinstance(stored.get("gripper"), dict):
        sim = _validated(name, stored | {"gripper": SimConfig.gripper})
        return dataclasses.replace(sim, gripper=_own_gripper(stored["gripper"]))
    adapter = _adapter(_kind(name, stored))
    try:
        text = json.dumps(stored)
    except RecursionError:
        raise ValueError(f"{name}: is nested too deeply") from None
    try:
        return adapter.validate_json(text, strict=True)
    except ValueError as error:
        first = error.errors(include_url=False)[0]
    if first["type"] == "value_error":
        raise first["ctx"]["error"]
    place, what = ".".join(map(str, (name, *first["loc"]))), first["msg"]
    if first["type"] == "unexpected_keyword_argument":
        raise ValueError(f"{place}: unknown setting")
    raise ValueError(f"{place}: {what[0].lower()}{what[1:]}, not {config.shown(first['input'])}")


def _own_gripper(stored: dict[str, Any]) -> Gripper:
    """Builds the gripper that `to_dict` wrote. Raises ValueError for numbers that are none."""
    numbers = {name: value for name, value in stored.items() if name != "folder"}
    try:
        return grippers.from_numbers(Path(str(stored.get("folder"))), numbers)
    except ValueError as error:
        raise ValueError(f"sim.gripper: {error}") from None


@functools.cache
def _adapter(kind: Any) -> Any:
    import pydantic  # slow

    return pydantic.TypeAdapter(kind)


def _without_constants(values: dict[str, Any]) -> dict[str, Any]:
    """The values of a config of format 2 without what is no setting any more."""
    values = dict(values)
    for name in (*renames.CONSTANTS, *renames.DROPPED):
        section, field = name.split(".")
        stored = values.get(section)
        if not isinstance(stored, dict) or field not in stored:
            continue
        constant = name in renames.CONSTANTS and hasattr(_kind(section, stored), field)
        if constant:
            _require_same(name, stored[field], getattr(_kind(section, stored), field))
        if constant or name in renames.DROPPED:
            values[section] = {key: value for key, value in stored.items() if key != field}
    return values


def _from_format_1(values: dict[str, Any]) -> dict[str, Any]:
    """The values of a config of format 1 under today's names."""
    every = {name: value for name, value in flat(values).items() if "." in name}
    old = {name: value for name, value in every.items() if name not in renames.DROPPED}
    if old.pop("learn.target_update", "soft") == "hard":
        old["learn.tau"] = 1.0
    old.pop("net.weights", None)
    for name, kept in renames.GONE.items():
        _require_same(name, old.pop(name, kept), kept)
    noise, clip = old.get("explore.noise_std", 0.0), old.pop("explore.noise_clip", None)
    if noise and clip is not None:
        _require_same("explore.noise_clip", clip, 3.0 * noise)
    sim = SimConfig(grasp_phases=tuple(old.get("sim.grasp_phases", SimConfig.grasp_phases)))
    push_phases = tuple(old.pop("sim.push_phases", sim.push_phases))
    _require_same("sim.push_phases", push_phases, sim.push_phases)
    if isinstance(extent := old.get("scene.drop_extent"), float):
        old["scene.drop_extent"] = [extent, extent]
    scale = old.pop("camera.scale", 1.0)
    new = {name: value for name, value in values.items() if not isinstance(value, dict)}
    for name, value in old.items():
        _put(new, values, renames.SETTINGS.get(name, name), value)
    if scale != 1.0:
        fields = {name: tuple(value) for name, value in new.get("camera", {}).items()}
        new["camera"] = dataclasses.asdict(CameraConfig(**fields).scaled(scale))
    return new


def _require_same(name: str, value: Any, now: Any) -> None:
    """Raises ValueError unless a file has today's value of what is no setting any more."""
    value, now = (list(one) if isinstance(one, tuple) else one for one in (value, now))
    close = isinstance(value, float) and isinstance(now, float) and math.isclose(value, now)
    if value != now and not close:
        raise ValueError(f"{name}: is {now} now and cannot be {value}")


def _put(new: dict[str, Any], values: dict[str, Any], name: str, value: Any) -> None:
    """Sets the setting `section.field` or `section.field.place`; a constant, or a setting of
    another alternative, is left out."""
    section, field, *place = name.split(".")
    kind = _kind(section, values.get(section))
    _, alternatives = config.ALTERNATIVES.get(section, ("", ()))
    if field in config.names(kind):
        fields = new.setdefault(section, {})
        if place:
            fields = fields.setdefault(field, list(getattr(kind, field)))
        fields[int(place[0]) if place else field] = value
    elif field in vars(kind):
        now = vars(kind)[field]
        _require_same(name, value, now[int(place[0])] if place else now)
    elif not any(field in vars(other) for other in alternatives):
        raise ValueError(f"{name}: unknown setting")
