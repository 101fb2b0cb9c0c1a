"""Sections of a config with other constants than those of their class; a camera of fewer pixels."""

import dataclasses
from typing import Any

from csac_jax.config import CameraConfig


def with_constants(section: Any, **constants: Any) -> Any:
    """The section, of a subclass with these class variables."""
    kind = type(section)
    assert constants.keys() <= set(dir(kind)), constants
    fields = {field.name: getattr(section, field.name) for field in dataclasses.fields(section)}
    assert not constants.keys() & fields.keys(), constants
    return type(kind.__name__, (kind,), constants)(**fields)


def scaled(cfg: CameraConfig, share: float) -> CameraConfig:
    """The same view with a share of the pixels along each side."""
    (width, height), (x, y) = cfg.size, cfg.centre
    size = (round(width * share), round(height * share))
    focal = (cfg.focal[0] * share, cfg.focal[1] * share)
    centre = ((x + 0.5) * share - 0.5, (y + 0.5) * share - 0.5)
    return dataclasses.replace(cfg, size=size, focal=focal, centre=centre)
