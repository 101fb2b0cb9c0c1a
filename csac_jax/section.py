"""A section of a config: a frozen dataclass whose fields have choices and bounds."""

import dataclasses
import math
import typing
from typing import Any, ClassVar, Literal

from csac_jax.errors import SettingsError
from csac_jax.grippers import Gripper

MOST_ITEMS = 64  # of a setting that is a list (ours: networks and scenes need far fewer)
_LARGEST = 2**53  # integers up to here are floats too


def number(default: Any, low: float, high: float = math.inf, above: bool = False) -> Any:
    """Builds a field whose numbers lie in low .. high; `above` excludes low itself."""
    return dataclasses.field(default=default, metadata={"bounds": (low, high, above)})


def require(condition: bool, message: str) -> None:
    """Raises SettingsError unless the condition holds."""
    if not condition:
        raise SettingsError(message)


@typing.dataclass_transform(frozen_default=True)
class Section:
    """A group of settings, a frozen dataclass that checks choices and bounds of its fields."""

    SECTION: ClassVar[str] = ""  # its name in `Config`
    __pydantic_config__: ClassVar[Any] = {"extra": "forbid"}  # unknown keys of a file

    def __init_subclass__(cls, section: str | None = None) -> None:
        cls.SECTION = cls.SECTION if section is None else section
        dataclasses.dataclass(frozen=True)(cls)

    def __post_init__(self) -> None:
        if not _is_plain(self):
            return
        for field in dataclasses.fields(typing.cast(Any, self)):
            value = getattr(self, field.name)
            items = value if isinstance(value, tuple) else (value,)
            few = len(items) <= MOST_ITEMS
            faults = [f"at most {MOST_ITEMS} items, not {len(items)}"] if not few else []
            faults += [fault for item in items[:MOST_ITEMS] if (fault := _fault(field, item))]
            require(not faults, f"{self.SECTION}.{field.name}: {(faults or [''])[0]}".lstrip("."))
        self.check()

    def check(self) -> None:
        """Raises SettingsError for values that do not fit one another."""


def _is_plain(value: Any) -> bool:
    """Returns whether a value can be checked; the numbers of a sweep may be traced."""
    if isinstance(value, Section | tuple):
        return all(map(_is_plain, value if isinstance(value, tuple) else vars(value).values()))
    return isinstance(value, int | float | str | Gripper)


def _fault(field: Any, value: Any) -> str | None:
    kind = typing.get_args(field.type)[0] if typing.get_origin(field.type) is tuple else field.type
    choices = typing.get_args(kind)
    if typing.get_origin(kind) is Literal and value not in choices:
        return f"{shown(value)} is not one of: {', '.join(map(str, choices))}"
    if not isinstance(value, int | float):
        return None
    low, high, above = field.metadata.get("bounds", (-_LARGEST, _LARGEST, False))
    if value > min(high, _LARGEST):
        return f"must be at most {min(high, _LARGEST):.16g}, not {shown(value)}"
    if not (low < value if above else low <= value):
        return f"must be {'above' if above else 'at least'} {low:g}, not {shown(value)}"
    return None


def shown(value: Any) -> str:
    """Returns a value as a message shows it, cut off after 60 characters."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def names(section: Any) -> set[str]:
    """Returns the names of the settings of a section or of its class."""
    return {field.name for field in dataclasses.fields(section)}


ALTERNATIVES: dict[str, tuple[str, tuple[type[Section], ...]]] = {}
"""Sections that are unions: the field that names the alternative, and the alternatives."""


def alternative_kind(section: str, choice: Any) -> Any:
    """Returns the class of the alternative of that name. Raises SettingsError for an unknown."""
    tag, kinds = ALTERNATIVES[section]
    choices = [getattr(kind, tag) for kind in kinds]
    fault = f"{section}.{tag}: {shown(choice)} is not one of: {', '.join(choices)}"
    require(choice in choices, fault)
    return kinds[choices.index(choice)]


def alternative(section: Any, choice: str) -> Any:
    """Returns the alternative of that name, with what it shares with `section`."""
    kind = alternative_kind(section.SECTION, choice)
    shared = names(kind) & names(section) - {ALTERNATIVES[section.SECTION][0]}
    return kind(**{name: getattr(section, name) for name in shared})


def changed(section: Any, values: dict[str, Any]) -> Any:
    """Returns a section with other values; a dict changes a section in it, or its alternative."""
    tag, _ = ALTERNATIVES.get(section.SECTION, ("", ()))
    section = alternative(section, values[tag]) if tag in values else section
    for name in values.keys() - names(section):
        raise SettingsError(f"{section.SECTION}.{name}: unknown setting".lstrip("."))
    inner = {
        name: changed(part, new)
        for name, new in values.items()
        if isinstance(part := getattr(section, name), Section) and isinstance(new, dict)
    }
    return dataclasses.replace(section, **values | inner)
