"""Config to JSON and back. Old formats are translated; a missing setting takes its default.

An unknown setting, a wrong type or a value out of range raises ValueError in one line.
"""

import dataclasses
import functools
import json
import math
from typing import Any

from csac_jax import config
from csac_jax.config import CameraConfig, Config, SimConfig
from csac_jax.io import renames


def to_dict(cfg: Config) -> dict[str, Any]:
    """A config as plain JSON values, with the number of its format."""
    return {"format": renames.FORMAT, **json.loads(json.dumps(dataclasses.asdict(cfg)))}


def from_dict(values: Any) -> Config:
    """The inverse of `to_dict`, for every format written so far. Raises ValueError."""
    if not isinstance(values, dict):
        raise ValueError(f"config: must be an object, not {values!r}")
    values = dict(values)
    number = values.pop("format", 1)
    if number not in (1, renames.FORMAT):
        raise ValueError(
            f"format: {number!r} is unknown, this version reads up to {renames.FORMAT}; "
            "update csac-jax"
        )
    return _validated(_from_format_1(values) if number == 1 else values)


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


def _validated(values: dict[str, Any]) -> Config:
    import pydantic

    try:
        return _adapter().validate_json(json.dumps(values), strict=True)
    except pydantic.ValidationError as error:
        raise ValueError(_line(values, error.errors(include_url=False))) from None


@functools.cache
def _adapter() -> Any:
    import pydantic

    return pydantic.TypeAdapter(Config)


def _line(values: dict[str, Any], errors: Any) -> str:
    """The first error, `section.name: what`; of a union, one of the alternative that was chosen."""
    chosen = {kind.__name__ for kind in (type(values.get(name)) for name in config.ALTERNATIVES)}
    for name, (tag, kinds) in config.ALTERNATIVES.items():
        section = values.get(name)
        choice = section.get(tag) if isinstance(section, dict) else None
        fitting = [kind for kind in kinds if kind.__dataclass_fields__[tag].default == choice]
        chosen |= {kind.__name__ for kind in fitting or kinds[:1]}
    every = {kind.__name__ for _, kinds in config.ALTERNATIVES.values() for kind in kinds}
    own = [error for error in errors if not (every & set(error["loc"])) - chosen] or errors
    first = own[0]
    place = ".".join(str(part) for part in first["loc"] if part not in every)
    if first["type"] == "value_error":
        return str(first["ctx"]["error"])
    if first["type"] == "unexpected_keyword_argument":
        return f"{place}: unknown setting"
    return f"{place}: {first['msg'][0].lower()}{first['msg'][1:]}, not {first['input']!r}"


def _from_format_1(values: dict[str, Any]) -> dict[str, Any]:
    """The values of a config of format 1 under today's names."""
    old = {name: value for name, value in flat(values).items() if "." in name}
    hard = old.pop("learn.target_update", "soft") == "hard"
    period = old.pop("learn.copy_every", 1)
    if hard:
        old |= {"learn.tau": 1.0, "learn.copy_every": period}
    for name, kept in renames.GONE.items():
        if old.pop(name, kept) != kept:
            raise ValueError(f"{name}: this setting is gone; only {kept!r} can be read")
    old.pop("net.weights", None)
    if isinstance(extent := old.get("scene.drop_extent"), float):
        old["scene.drop_extent"] = [extent, extent]
    push_phases = old.pop("sim.push_phases", None)
    noise, clip = old.get("explore.noise_std", 0.0), old.pop("explore.noise_clip", None)
    if clip is not None and noise and not math.isclose(clip, 3.0 * noise):
        raise ValueError(f"explore.noise_clip: is {3.0 * noise:g} now and cannot be {clip}")
    scale = old.pop("camera.scale", 1.0)
    new: dict[str, Any] = {
        name: value for name, value in values.items() if not isinstance(value, dict)
    }
    for name, value in old.items():
        _put(new, values, renames.SETTINGS.get(name, name), value)
    grasp_phases = tuple(old.get("sim.grasp_phases", SimConfig().grasp_phases))
    phases = SimConfig(grasp_phases=grasp_phases).push_phases
    if push_phases is not None and tuple(push_phases) != phases:
        raise ValueError(f"sim.push_phases: is {phases} now and cannot be {push_phases}")
    if scale != 1.0:
        fields = {name: tuple(value) for name, value in new.get("camera", {}).items()}
        new["camera"] = dataclasses.asdict(CameraConfig(**fields).scaled(scale))
    return new


def _put(new: dict[str, Any], values: dict[str, Any], name: str, value: Any) -> None:
    """Sets the setting `section.field` or `section.field.place`; drops what its section has not."""
    section, field, *place = name.split(".")
    kind = _section(section, values)
    if field not in {one.name for one in dataclasses.fields(kind)} and _dropped(
        kind, name, field, place, value
    ):
        return
    fields = new.setdefault(section, {})
    if place:
        default = kind.__dataclass_fields__[field].default
        fields.setdefault(field, list(default))[int(place[0])] = value
    else:
        fields[field] = value


def _section(name: str, values: dict[str, Any]) -> Any:
    """Class of a section of format 1."""
    if name in config.ALTERNATIVES:
        tag, kinds = config.ALTERNATIVES[name]
        default = "small" if name == "net" else "beta"
        choice = values[name].get(tag, default)
        return next((k for k in kinds if k.__dataclass_fields__[tag].default == choice), kinds[0])
    known = Config.__dataclass_fields__.get(name)
    if known is None:
        raise ValueError(f"{name}: unknown setting")
    return type(known.default)


def _dropped(kind: Any, name: str, field: str, place: list[str], value: Any) -> bool:
    """Whether a setting that is none of `kind` may be left out: a constant, or an alternative's."""
    section = name.split(".")[0]
    constant = kind.__dataclass_fields__.get(field)
    if constant is None:
        _, kinds = config.ALTERNATIVES.get(section, ("", ()))
        return any(field in other.__dataclass_fields__ for other in kinds)
    now = getattr(kind, field)[int(place[0])] if place else getattr(kind, field)
    if now != value:
        raise ValueError(f"{name}: is {now} now and cannot be {value}")
    return True
