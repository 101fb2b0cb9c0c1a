"""Config to JSON and back, and configs in files: TOML, YAML or JSON, a run's config.json too.

    preset = "quick"
    algo = "vpg"
    seed = 1
    [learn]
    tau = 0.01

Such a file changes settings of its preset. One with a `format`, as runs write it, holds all; a
setting that it lacks takes its default. Nothing in a file is executed.
"""

import dataclasses
import functools
import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from csac_jax import algorithms, grippers, presets, reading
from csac_jax.config import Config, SimConfig
from csac_jax.errors import SettingsError
from csac_jax.grippers import Gripper
from csac_jax.io import renames
from csac_jax.section import (
    ALTERNATIVES,
    Section,
    alternative,
    alternative_kind,
    names,
    require,
    shown,
)

FORMAT = 2
_LARGEST = 2**17  # bytes of a config file
_LONGEST_LINE = 2**12  # bytes in TOML, whose parser takes the square of a key's parts
_MOST_BRACKETS = 1000  # in YAML, whose scanner takes the square of their number


def to_dict(cfg: Config) -> dict[str, Any]:
    """Returns a config as plain JSON values, with the number of its format."""
    values = {"format": FORMAT, **json.loads(json.dumps(vars(cfg), default=_plain))}
    if not cfg.parts:
        del values["parts"]  # earlier versions read such a config
    return values


def _plain(value: Section | Gripper) -> dict[str, Any]:
    if isinstance(value, Gripper):
        return {"folder": str(value.folder), **grippers.to_numbers(value)}
    return vars(value)


def from_dict(values: Any, acts: bool = False) -> Config:
    """Reads what `to_dict` returned, of older versions too. Raises SettingsError in one line.

    `acts`: the config is of a policy that only acts. Former settings of the replay are left out.
    """
    if not isinstance(values, dict):
        raise SettingsError(f"config: must be an object, not {shown(values)}")
    if (number := values.get("format")) != FORMAT:
        text = f"{shown(number)} is unknown, this version reads {FORMAT}"
        raise SettingsError(f"format: {text}; use the csac-jax that wrote it")
    stored = renames.current(values)
    if acts and isinstance(replay := stored.get("replay"), dict):
        former = renames.FIXED["replay"]
        stored["replay"] = {name: replay[name] for name in replay if name not in former}
    return Config(**{name: _validated(name, stored[name]) for name in stored if name != "format"})


def differences(a: Config, b: Config) -> list[str]:
    """Returns the dotted names of the settings that differ, in order of their definition."""
    flat_a, flat_b = flat(to_dict(a)), flat(to_dict(b))
    return [name for name in flat_a | flat_b if flat_a.get(name) != flat_b.get(name)]


def flat(values: dict[str, Any]) -> dict[str, Any]:
    """Returns the value of each setting by its dotted name."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        fields = value if isinstance(value, dict) else {}
        flat |= {f"{name}.{field}": item for field, item in fields.items()} or {name: value}
    return flat


def recorded(values: dict[str, Any]) -> dict[str, Any]:
    """Returns the settings of a stored config by dotted name, and the former ones as it has them.

    Other values of former settings, which `from_dict` refuses, are read: it is a record.
    """
    stored, former = renames.current(values), dict[str, Any]()
    for name, fields in renames.FIXED.items():
        section = stored.get(name)
        if isinstance(section, dict):
            former |= {f"{name}.{key}": section.pop(key) for key in fields & section.keys()}
    return with_former(from_dict(stored)) | former


def with_former(cfg: Config) -> dict[str, Any]:
    """Returns the settings by dotted name, and constants of the config that were settings once."""
    return flat(to_dict(cfg)) | {
        f"{name}.{field}": _constant(getattr(cfg, name), field)
        for name, fields in renames.FIXED.items()
        for field in sorted(fields)
        if hasattr(getattr(cfg, name), field)
    }


def _constant(section: Any, field: str) -> Any:
    return json.loads(json.dumps(getattr(section, field)))


def _validated(name: str, stored: Any) -> Any:
    if name == "sim" and isinstance(stored, dict) and isinstance(stored.get("gripper"), dict):
        sim = _validated(name, stored | {"gripper": SimConfig.gripper})
        return dataclasses.replace(sim, gripper=_own_gripper(stored["gripper"]))
    kind, items = _kind(name, stored), stored.items() if isinstance(stored, dict) else ()
    fixed = {k: v for k, v in items if k in renames.FIXED.get(name, ()) and hasattr(kind, k)}
    rest = {k: v for k, v in items if k not in fixed} if fixed else stored
    part = _parsed(kind, name, rest)
    for field, value in fixed.items():
        today = _constant(part, field)
        require(value == today, f"{name}.{field}: must be {shown(today)}, not {shown(value)}")
    return part


def _parsed(kind: Any, name: str, stored: Any) -> Any:
    try:
        text = json.dumps(stored)
    except RecursionError:
        raise SettingsError(f"{name}: is nested too deeply") from None
    try:
        return _adapter(kind).validate_json(text, strict=True)
    except ValueError as error:
        first = error.errors(include_url=False)[0]
    if first["type"] == "value_error":
        raise first["ctx"]["error"]
    place, what = ".".join(map(str, (name, *first["loc"]))), first["msg"]
    if first["type"] == "unexpected_keyword_argument":
        raise SettingsError(f"{place}: unknown setting")
    raise SettingsError(f"{place}: {what[0].lower()}{what[1:]}, not {shown(first['input'])}")


def _kind(name: str, stored: Any) -> Any:
    require(name in names(Config), f"{name}: unknown setting")
    tag, _ = ALTERNATIVES.get(name, ("", ()))
    if tag and isinstance(stored, dict) and tag in stored:
        return alternative_kind(name, stored[tag])
    return type(getattr(Config, name))


def _own_gripper(stored: dict[str, Any]) -> Gripper:
    numbers = {name: value for name, value in stored.items() if name != "folder"}
    try:
        return grippers.from_numbers(Path(str(stored.get("folder"))), numbers)
    except ValueError as error:
        raise SettingsError(f"sim.gripper: {error}") from None


@functools.cache
def _adapter(kind: Any) -> Any:
    import pydantic  # slow

    return pydantic.TypeAdapter(kind)


def load_config(path: str | Path, preset: str | None = None, algo: str | None = None) -> Config:
    """Reads the config of a file; its settings win over what `algo` brings, `algo` over its own.

    `preset` must not contradict the file's. Raises SettingsError, one line with file and key.
    """
    try:
        return _configured(_read(Path(path)), preset, algo)
    except (OSError, ValueError) as error:
        text = error.strerror if isinstance(error, OSError) else str(error)
        raise SettingsError(f"{path}: {' '.join(str(text).split())}") from None


def _configured(values: dict[str, Any], preset: str | None, algo: str | None) -> Config:
    own = values.pop("preset", None)
    if preset is not None and own not in (None, preset):
        raise SettingsError(f"preset: is {shown(own)}; leave out {preset}, or change the file")
    name = preset or own
    if not isinstance(name, str):
        raise SettingsError('preset: is missing; add one, such as preset = "quick"')
    if "format" in values:
        cfg = from_dict(values | {"preset": name})
        return cfg if algo is None else algorithms.configure(cfg, algo)
    cfg, own_algo = presets.get(name), values.pop("algo", None)
    if (chosen := algo or own_algo) is not None:
        cfg = algorithms.configure(cfg, str(chosen))
    return from_dict(_changed(cfg, renames.current(values)))


def _changed(base: Config, values: dict[str, Any]) -> dict[str, Any]:
    whole = to_dict(base)
    for name, value in values.items():
        section = getattr(base, name, None)
        if not isinstance(section, Section):
            whole[name] = value
            continue
        if not isinstance(value, dict):
            raise SettingsError(f"{name}: must be a section of settings, not {shown(value)}")
        tag, _ = ALTERNATIVES.get(name, ("", ()))
        if tag in value:
            whole[name] = vars(alternative(section, value[tag]))
        whole[name] = whole[name] | value
    return whole


def _read(path: Path) -> dict[str, Any]:
    require(path.suffix in READERS, f"the name of a config file ends in {', '.join(READERS)}")
    kind, parse = READERS[path.suffix]
    text = reading.read_bytes(path, _LARGEST).decode()
    try:
        content = json.loads(json.dumps(parse(text), default=str))
    except RecursionError:
        raise SettingsError("is nested too deeply") from None
    except (tomllib.TOMLDecodeError, json.JSONDecodeError) as error:
        raise SettingsError(f"is no readable {kind} ({error})") from None
    require(isinstance(content, dict), "must hold settings by name")
    return content


def _toml(text: str) -> Any:
    longest = max(map(len, text.splitlines()), default=0)
    require(longest <= _LONGEST_LINE, f"has a line of {longest} characters; break it")
    return tomllib.loads(text)


def _yaml(text: str) -> Any:
    """Reads plain values. Refuses aliases: a short file could stand for an endless one."""
    import yaml

    brackets = text.count("[") + text.count("{")
    require(brackets <= _MOST_BRACKETS, f"has {brackets} brackets, more than {_MOST_BRACKETS}")
    try:
        if any(isinstance(token, yaml.AliasToken) for token in yaml.scan(text)):
            raise SettingsError("aliases (*name) are not read; write the values out")
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise SettingsError(f"is no readable YAML ({error})") from None


READERS: dict[str, tuple[str, Callable[[str], Any]]] = {
    ".toml": ("TOML", _toml),
    ".yaml": ("YAML", _yaml),
    ".yml": ("YAML", _yaml),
    ".json": ("JSON", json.loads),
}
