"""The settings of a sweep: `--vary NAME=A,B` as flags of the command line, one combination after
the other.

Without JAX, so that complaints come at once. The flags are read by the same parser as a user's own.
"""

import dataclasses
import difflib
import itertools
import typing
from collections.abc import Sequence
from typing import NamedTuple

from csac_jax.config import Algo, Config

BASE = "base"  # name of the only setting where nothing is varied
LONGEST = 120  # characters of a setting's name, which is a folder's


class Setting(NamedTuple):
    """One combination of the varied values."""

    name: str  # as in `learn.tau=0.01,replay.sampler=beta`
    values: dict[str, str]  # setting -> value, as given
    flags: list[str]  # for the parser of `train`


def settings(varied: Sequence[str]) -> list[Setting]:
    """Every combination of the values of `NAME=A,B,...`, the last name's values changing fastest.

    Items of a tuple are parted by colons, as in `replay.beta_end=1:4,1:12`. Raises ValueError for a
    name that is no setting, for no value or an empty one, and for what is given twice.
    """
    axes = dict(map(_axis, varied))
    if len(axes) < len(varied):
        raise ValueError("--vary: a setting is given twice; name it once, with all its values")
    found = []
    for combination in itertools.product(*axes.values()):
        values = dict(zip(axes, combination, strict=True))
        name = ",".join(f"{name}={value}" for name, value in values.items()) or BASE
        flags = [flag for name, value in values.items() for flag in _flags(name, value)]
        found.append(Setting(name, values, flags))
    if any(len(setting.name) > LONGEST for setting in found):
        found = [setting._replace(name=f"setting-{i}") for i, setting in enumerate(found)]
    return found


def _axis(text: str) -> tuple[str, list[str]]:
    name, equals, rest = text.partition("=")
    name, values = name.replace("-", "_"), rest.split(",")
    if not equals or not all(values):
        raise ValueError(f"--vary {text}: give a setting and its values, as in learn.tau=0.01,0.02")
    _kind(name)
    if len(set(values)) < len(values):
        raise ValueError(f"--vary {text}: a value is given twice")
    if any(
        "/" in value or (value.startswith((".", "-")) and not _is_number(value)) for value in values
    ):
        raise ValueError(
            f"--vary {text}: a value must not hold a slash nor begin with a dot or dash"
        )
    return name, values


def _is_number(value: str) -> bool:
    try:
        return bool(float(value)) or True
    except ValueError:
        return False


def _kinds() -> dict[str, object]:
    """Type of everything that can be varied, by its dotted name."""
    kinds: dict[str, object] = {"algo": Algo}
    for section in dataclasses.fields(Config):
        if dataclasses.is_dataclass(section.type):
            hints = typing.get_type_hints(section.type)
            kinds |= {f"{section.name}.{name}": kind for name, kind in hints.items()}
    return kinds


def _kind(name: str) -> object:
    kinds = _kinds()
    if name not in kinds:
        near = difflib.get_close_matches(name, kinds, 1)
        meant = (
            f"; perhaps you meant {near[0]}" if near else "; csac-jax train quick --help lists them"
        )
        reason = (
            "seeds are varied by --seeds" if name == "seed" else f"'{name}' is no setting{meant}"
        )
        raise ValueError(f"--vary: {reason}")
    return kinds[name]


def _flags(name: str, value: str) -> list[str]:
    flag = "--" + name.replace("_", "-")
    if _kind(name) is bool:
        if value not in ("true", "false"):
            raise ValueError(f"--vary {name}: {value!r} is neither true nor false")
        section, _, field = flag.rpartition(".")
        return [flag if value == "true" else f"{section}.no-{field}"]
    items = value.split(":") if typing.get_origin(_kind(name)) is tuple else [value]
    return [flag, *items]
