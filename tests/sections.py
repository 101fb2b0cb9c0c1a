"""Sections of a config with other constants than those of their class."""

import dataclasses
from typing import Any


def with_constants(section: Any, **constants: Any) -> Any:
    """The section, of a subclass with these class variables."""
    kind = type(section)
    assert constants.keys() <= set(dir(kind)), constants
    fields = {field.name: getattr(section, field.name) for field in dataclasses.fields(section)}
    assert not constants.keys() & fields.keys(), constants
    return type(kind.__name__, (kind,), constants)(**fields)
