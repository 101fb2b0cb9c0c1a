"""A config in a file of one's own: TOML, YAML or JSON, a run's config.json too.

    preset = "quick"
    algo = "vpg"
    seed = 1
    [learn]
    tau = 0.01

Such a file changes settings of its preset. One with a `format`, as runs write it, holds all.
Values are read as data: nothing in a file is executed.
"""

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from csac_jax import algorithms, config, presets
from csac_jax.config import Config
from csac_jax.errors import SettingsError
from csac_jax.io import configs, files


def load_config(path: str | Path, preset: str | None = None, algo: str | None = None) -> Config:
    """The config of a file; settings of the file win over what `algo` brings.

    Args: preset, given elsewhere, which the file's must not contradict; algo, which wins over the
    file's. Raises SettingsError, one line that names the file and the key.
    """
    try:
        return _config(_read(Path(path)), preset, algo)
    except (OSError, ValueError) as error:
        text = error.strerror if isinstance(error, OSError) else str(error)
        raise SettingsError(f"{path}: {' '.join(str(text).split())}") from None


def _config(values: dict[str, Any], preset: str | None, algo: str | None) -> Config:
    own = values.pop("preset", None)
    if preset is not None and own not in (None, preset):
        raise ValueError(f"preset: is {config.shown(own)}; leave out {preset}, or change the file")
    name = preset or own
    if not isinstance(name, str):
        raise ValueError('preset: is missing; add one, such as preset = "quick"')
    if "format" in values:
        cfg = configs.from_dict(values | {"preset": name})
        return cfg if algo is None else algorithms.configure(cfg, algo)
    cfg, own_algo = presets.get(name), values.pop("algo", None)
    if (chosen := algo or own_algo) is not None:
        cfg = algorithms.configure(cfg, str(chosen))
    return configs.from_dict(_changed(cfg, values))


def _changed(base: Config, values: dict[str, Any]) -> dict[str, Any]:
    """The values of a whole config: `base` with those of a file."""
    whole = configs.to_dict(base)
    for name, given in values.items():
        section = getattr(base, name, None)
        if not isinstance(section, config.Section):
            whole[name] = given
            continue
        if not isinstance(given, dict):
            raise ValueError(f"{name}: must be a section of settings, not {config.shown(given)}")
        tag, _ = config.ALTERNATIVES.get(name, ("", ()))
        if tag in given:
            section = config.alternative(section, given[tag])
        whole[name] = configs.to_dict(base.change(**{name: section}))[name] | given
    return whole


def _read(path: Path) -> dict[str, Any]:
    """The content of a file as JSON values. Raises ValueError where it is none."""
    if path.suffix not in READERS:
        raise ValueError(f"the name of a config file ends in {', '.join(READERS)}")
    try:
        text = files.read_bytes(path).decode()
        content = json.loads(json.dumps(READERS[path.suffix](text), default=str))
    except RecursionError:
        raise ValueError("is nested too deeply") from None
    if not isinstance(content, dict):
        raise ValueError("must hold settings by name")
    return content


def _yaml(text: str) -> Any:
    """Plain values of YAML. Aliases are refused: a short file could stand for an endless one."""
    import yaml

    try:
        if any(isinstance(token, yaml.AliasToken) for token in yaml.scan(text)):
            raise ValueError("aliases (*name) are not read; write the values out")
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(f"is no readable YAML ({error})") from None


def _toml(text: str) -> Any:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"is no readable TOML ({error})") from None


def _json(text: str) -> Any:
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"is no readable JSON ({error})") from None


READERS: dict[str, Callable[[str], Any]] = {
    ".toml": _toml,
    ".yaml": _yaml,
    ".yml": _yaml,
    ".json": _json,
}
