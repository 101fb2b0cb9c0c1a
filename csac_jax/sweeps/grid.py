"""The points of a sweep: every combination of the values in `--vary NAME=A,B`.

It needs no JAX, so that complaints come at once. A point's flags go through the same parser as the
user's own.
"""

import dataclasses
import difflib
import itertools
import typing
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from csac_jax.config import ALTERNATIVES, Config, Section

BASE = "base"  # name of the only point where nothing is varied
LONGEST = 120  # characters of a point's name, which is a folder's


class SweepPoint(NamedTuple):
    """One combination of the varied values."""

    name: str  # as in `learn.tau=0.01,replay.sampler=beta`; of its folder
    values: dict[str, str]  # setting -> value, as given
    cfg: Config  # with the first seed


def points(varied: Sequence[str], configure: Callable[[list[str]], Config]) -> list[SweepPoint]:
    """Every combination of the values of `NAME=A,B,...`; the last name's values change fastest.

    `configure` makes a config of a point's flags. Items of a tuple are separated by colons, as in
    `replay.end=1:4,1:12`. Raises ValueError for what cannot be varied.
    """
    axes = dict(map(_axis, varied))
    if len(axes) < len(varied):
        raise ValueError("--vary: a setting is given twice; name it once, with all its values")
    combined = []
    for combination in itertools.product(*axes.values()):
        values = dict(zip(axes, combination, strict=True))
        flags = [flag for setting, value in values.items() for flag in _flags(setting, value)]
        combined.append(SweepPoint(name(values), values, configure(flags)))
    return with_short_names(combined)


def name(values: dict[str, str]) -> str:
    """Name of a point."""
    return ",".join(f"{setting}={value}" for setting, value in values.items()) or BASE


def with_short_names(found: list[SweepPoint]) -> list[SweepPoint]:
    """The points with numbers for names if one is too long for a folder."""
    if any(len(point.name) > LONGEST for point in found):
        return [point._replace(name=f"setting-{i}") for i, point in enumerate(found)]
    return found


def _axis(text: str) -> tuple[str, list[str]]:
    name, equals, rest = text.partition("=")
    name, values = name.replace("-", "_"), rest.split(",")
    if not equals or not all(values):
        raise ValueError(f"--vary {text}: give a setting and its values, as in learn.tau=0.01,0.02")
    kind_of(name)
    if len(set(values)) < len(values):
        raise ValueError(f"--vary {text}: a value is given twice")
    if not all(map(_names_a_folder, values)):
        raise ValueError(
            f"--vary {text}: a value must not hold a slash nor begin with a dot or dash"
        )
    return name, values


def _names_a_folder(value: str) -> bool:
    return "/" not in value and (not value.startswith((".", "-")) or _is_number(value))


def _is_number(value: str) -> bool:
    try:
        float(value)
    except ValueError:
        return False
    return True


def _kinds() -> dict[str, object]:
    """Type of everything that can be varied, by its dotted name."""
    kinds: dict[str, object] = {"algo": str}
    for section in dataclasses.fields(Config):
        default = getattr(Config(), section.name)
        if isinstance(default, Section):
            _, alternatives = ALTERNATIVES.get(section.name, ("", (type(default),)))
            kinds_of: Any = alternatives
            for kind in kinds_of:
                hints = typing.get_type_hints(kind)
                names = [field.name for field in dataclasses.fields(kind)]
                kinds |= {f"{section.name}.{name}": hints[name] for name in names}
    return kinds


def kind_of(name: str) -> object:
    """Type of a setting by its dotted name. Raises ValueError for what cannot be varied."""
    kinds = _kinds()
    if name == "seed":
        raise ValueError("--vary: seeds are varied by --seeds")
    if name not in kinds:
        near = difflib.get_close_matches(name, kinds, 1)
        hint = (
            f"perhaps you meant {near[0]}" if near else "csac-jax train quick --help-all lists them"
        )
        raise ValueError(f"--vary: '{name}' is no setting; {hint}")
    return kinds[name]


def _flags(name: str, value: str) -> list[str]:
    flag = "--" + name.replace("_", "-")
    if kind_of(name) is bool:
        if value not in ("true", "false"):
            raise ValueError(f"--vary {name}: {value!r} is neither true nor false")
        section, _, field = flag.rpartition(".")
        return [flag if value == "true" else f"{section}.no-{field}"]
    items = value.split(":") if typing.get_origin(kind_of(name)) is tuple else [value]
    return [flag, *items]
