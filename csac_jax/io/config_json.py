"""Config to JSON and back, strictly: an unknown key, a missing key or a wrong type is an error."""

import dataclasses
import types
import typing
from typing import Any, Literal

from csac_jax.config import Config


def to_dict(cfg: Any) -> dict[str, Any]:
    """A config dataclass as plain JSON values; tuples become lists."""
    return {field.name: _encode(getattr(cfg, field.name)) for field in dataclasses.fields(cfg)}


def _encode(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return to_dict(value)
    return list(value) if isinstance(value, tuple) else value


def from_dict(values: dict[str, Any]) -> Config:
    """The inverse of `to_dict`. Raises ValueError naming the field that does not fit."""
    return _decode(Config, values, "")


def _decode(kind: Any, value: Any, name: str) -> Any:
    """`value` from JSON as a `kind`; `name` is its dotted path, for messages."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        return _decode_dataclass(kind, value, name)
    if origin is tuple:
        return _decode_tuple(arguments, value, name)
    if origin is Literal:
        _check(
            value in arguments and type(value) in map(type, arguments),
            name,
            f"one of {arguments}",
            value,
        )
        return value
    if origin in (types.UnionType, typing.Union):
        _check(type(value) in arguments, name, str(kind), value)
        return value
    if kind is float:
        _check(type(value) in (int, float), name, "a number", value)
        return float(value)
    _check(type(value) is kind, name, f"of type {kind.__name__}", value)
    return value


def _decode_dataclass(kind: Any, value: Any, name: str) -> Any:
    _check(isinstance(value, dict), name or "config", "an object", value)
    hints = typing.get_type_hints(kind)
    prefix = f"{name}." if name else ""
    unknown, missing = sorted(value.keys() - hints.keys()), sorted(hints.keys() - value.keys())
    if unknown:
        raise ValueError(f"{prefix}{unknown[0]}: unknown setting")
    if missing:
        raise ValueError(f"{prefix}{missing[0]}: setting is missing")
    return kind(**{key: _decode(hints[key], value[key], prefix + key) for key in hints})


def _decode_tuple(arguments: tuple[Any, ...], value: Any, name: str) -> tuple[Any, ...]:
    _check(isinstance(value, list), name, "a list", value)
    if arguments[-1] is Ellipsis:
        arguments = (arguments[0],) * len(value)
    _check(len(value) == len(arguments), name, f"a list of {len(arguments)}", value)
    return tuple(
        _decode(kind, item, f"{name}[{i}]")
        for i, (kind, item) in enumerate(zip(arguments, value, strict=True))
    )


def _check(good: bool, name: str, wanted: str, value: Any) -> None:
    if not good:
        raise ValueError(f"{name}: must be {wanted}, not {value!r}")


def differences(a: Config, b: Config) -> list[str]:
    """Dotted names of the settings in which two configs differ, in order of their definition."""
    return _differences(to_dict(a), to_dict(b), "")


def _differences(a: dict[str, Any], b: dict[str, Any], prefix: str) -> list[str]:
    names: list[str] = []
    for key in a:
        if isinstance(a[key], dict):
            names += _differences(a[key], b[key], f"{prefix}{key}.")
        elif a[key] != b[key]:
            names.append(prefix + key)
    return names
