"""PRESET and settings on the command line -> Config; what `train` and `sweep` share."""

import dataclasses
from collections.abc import Sequence
from typing import Any

from csac_jax import algorithms, presets
from csac_jax.cli import parsing
from csac_jax.cli.errors import as_bad_arguments
from csac_jax.config import Config

PRESETS = ", ".join(presets.PRESETS)
_SECTIONS = [field for field in dataclasses.fields(Config) if dataclasses.is_dataclass(field.type)]


def with_sections(options: type) -> Any:
    """A dataclass of these options and, as groups of flags, of every section of Config."""
    fields = [(field.name, field.type, field) for field in _SECTIONS]
    namespace = {"__doc__": options.__doc__}
    return dataclasses.make_dataclass(
        f"_{options.__name__}", fields, bases=(options,), frozen=True, namespace=namespace
    )


def split(arguments: Sequence[str]) -> tuple[str | None, list[str]]:
    """The preset, if one stands first, and the flags."""
    if arguments and not arguments[0].startswith("-"):
        return arguments[0], list(arguments[1:])
    return None, list(arguments)


def preset(name: str, flags: Sequence[str]) -> Config:
    """The preset, of the algorithm that the flags name."""
    algo = parsing.value_of(flags, "--algo")
    with as_bad_arguments(ValueError):
        cfg = presets.get(name)
        return cfg if algo is None else algorithms.configure(cfg, algo)


def parse(kind: Any, command: str, base: Config, flags: Sequence[str]) -> tuple[Any, Config]:
    """The options, of a `kind` that `with_sections` made, and `base` with the settings given."""
    sections = {field.name: getattr(base, field.name) for field in _SECTIONS}
    default = kind(seed=base.seed, algo=base.algo, **sections)
    options: Any = parsing.parse(kind, flags, command, default)
    sections = {name: getattr(options, name) for name in sections}
    with as_bad_arguments(ValueError):
        return options, Config(preset=base.preset, algo=options.algo, seed=options.seed, **sections)


def resolve(cfg: Config, devices: int = 1, members: int = 1) -> Config:
    """The config with what `auto` stands for here, on so many devices, of so many runs side by
    side."""
    if cfg.sim.physics != "auto":
        return cfg  # no need of JAX
    from csac_jax.sim import backend

    return backend.resolve(cfg, devices, members)
