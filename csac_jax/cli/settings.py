"""PRESET and settings on the command line -> Config; `train`, `sweep` and `doctor` share this."""

import dataclasses
import inspect
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from csac_jax import algorithms, presets
from csac_jax.cli import parsing
from csac_jax.cli.failures import exists
from csac_jax.cli.parsing import PROGRAM
from csac_jax.config import Config
from csac_jax.errors import SettingsError
from csac_jax.section import ALTERNATIVES, Section, alternative, names

PRESETS = ", ".join(presets.PRESETS)
FIRST = {
    "train": ("actions", "scenes", "learning_starts"),
    "task": ("kind",),
    "sim": ("physics",),
    "scene": ("slots", "packed_fraction"),
    "heightmap": ("view",),
    "learn": ("learning_rate", "batch", "updates_per_step"),
    "target": ("gamma",),
    "replay": ("sampler",),
    "net": ("kind",),
}
"""The settings that people change first: those of the short help."""
_HAND = ("gripper", "base", "adapter", "clearance", "opening", "pad_friction", "grip_force")
VIEW: dict[str, tuple[str, ...]] = {"heightmap": (), "camera": (), "sensor": (), "sim": _HAND}
"""Sections of a policy's view and hand, () or some of their settings; `train` has all."""


@dataclasses.dataclass(frozen=True)
class RunOptions:
    """Options of commands that train."""

    config: Path | None = None
    """File of settings, TOML, YAML or JSON, in place of a preset; a run's config.json too."""
    init: str | None = None
    """Start from the networks of a run, a policy file or `shipped`; brings its net settings
    and its heightmap.size."""
    json: Path | None = None
    """File to write the result to, as JSON."""
    seed: int = 0
    """Number that all randomness of the run follows from; of a sweep the first seed."""
    algo: str = "csac_beta"
    """Algorithm; settings given as options win over it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class DecisionOptions:
    """Settings of section `policy` that a policy may be used with, see `csac-jax train --help-all`;
    by default its own."""

    augment: Literal["on", "off"] | None = None
    """Decide by the mean Q over mirror images of the view; by default as the policy does."""
    height_bonus: float | None = None
    """Q that each metre of the surface under a cell adds; by default the policy's."""
    retry_temperature: float | None = None
    """Temperature of the draw of another place after failed grasps; by default the policy's."""

    @property
    def decision(self) -> dict[str, Any]:
        """Returns the settings that are given."""
        augment = None if self.augment is None else self.augment == "on"
        numbers = {name: getattr(self, name) for name in ("height_bonus", "retry_temperature")}
        return {k: v for k, v in {**numbers, "augment": augment}.items() if v is not None}


def split(arguments: Sequence[str]) -> tuple[str | None, list[str]]:
    """Splits off the preset, if one stands first."""
    if arguments and not arguments[0].startswith("-"):
        return arguments[0], list(arguments[1:])
    return None, list(arguments)


def check_new(command: str, preset: str | None, file: Path | None, folder: Path | None) -> None:
    """Raises SettingsError without a preset or config file, or for a folder that exists."""
    if preset is None and file is None:
        raise SettingsError(f"{command}: give a preset first, one of: {PRESETS}; or --config FILE")
    if folder is not None and folder.exists():
        raise exists(folder)


def base(name: str | None, flags: Sequence[str]) -> Config:
    """Returns the preset, or the config of a file, with the algorithm and networks of the flags."""
    algo, init, file = (parsing.take(flags, f"--{name}")[0] for name in ("algo", "init", "config"))
    if file is not None and not parsing.asks_help(flags):
        from csac_jax.io import configs

        cfg = configs.load_config(file, name, algo)
    else:
        cfg = presets.get(name or Config.preset)
        cfg = cfg if algo is None else algorithms.configure(cfg, algo)
    if init is None or parsing.asks_help(flags):
        return cfg
    from csac_jax import api

    return api.match_networks(cfg, init)


def parse(
    options: type, command: str, base: Config, flags: Sequence[str], examples: Sequence[str] = ()
) -> tuple[Any, Config]:
    """Parses the `options` of a command, and `base` with the settings that the flags change."""
    sections = _sections(base, flags)
    description = None
    if parsing.SHORT_HELP.intersection(flags):
        description = _description(options, command, examples)
        sections = {
            name: _some(type(sections[name]), some)(**{k: getattr(sections[name], k) for k in some})
            for name, some in FIRST.items()
        }
    kind = _with_sections(options, {name: type(one) for name, one in sections.items()})
    default = kind(**sections, seed=base.seed, algo=base.algo)
    given = parsing.parse(kind, flags, command, default, description)
    changed = {name: getattr(given, name) for name in (*sections, "algo", "seed")}
    return given, dataclasses.replace(base, **changed)


def _with_sections(options: type, kinds: dict[str, Any]) -> Any:
    fields = [(name, kind, dataclasses.field(default=kind())) for name, kind in kinds.items()]
    kind: Any = dataclasses.make_dataclass(
        options.__name__, fields, bases=(options,), frozen=True, kw_only=True
    )
    kind.__doc__ = options.__doc__
    return kind


def _sections(base: Config, flags: Sequence[str]) -> dict[str, Any]:
    """Returns the sections of a config; a flag such as --replay.sampler selects an alternative.

    Raises SettingsError for a flag that is a setting of another alternative.
    """
    sections: dict[str, Any] = {
        name: one for name, one in vars(base).items() if isinstance(one, Section)
    }
    for name, (tag, kinds) in ALTERNATIVES.items():
        choice = parsing.take(flags, f"--{name}.{tag}")[0] or getattr(sections[name], tag)
        sections[name] = alternative(sections[name], choice)
        others = set().union(*(vars(kind()) for kind in kinds)) - vars(sections[name]).keys()
        for flag in flags:
            prefix, _, setting = flag.split("=")[0].replace("-", "_").rpartition(".")
            if prefix == f"__{name}" and setting in others:
                raise SettingsError(f"{flag}: --{name}.{tag} {choice} has no such setting")
    return sections


def _description(options: type, command: str, examples: Sequence[str]) -> str:
    lines = [
        *(inspect.getdoc(options) or "", "", f"presets: {PRESETS}", ""),
        *(f"algorithms: {', '.join(algorithms.ALGORITHMS)}", "", "examples:"),
        *(f"  {PROGRAM} {command.split()[0]} {example}" for example in examples),
        *(
            "",
            "`--device cpu|gpu` says where JAX computes. `--import MODULE` first loads a module of",
        ),
        f"your own. All settings: {PROGRAM} {command}",
        "--help-all; below are those that people change first.",
    ]
    return "\n".join(lines)


def _some(section: type, some: Collection[str], hint: str = "") -> Any:
    """Returns a dataclass of some settings of a section; `hint` replaces their default values."""
    fields = [
        (
            field.name,
            Annotated[field.type, tyro.conf.arg(help_behavior_hint=hint)] if hint else field.type,
            dataclasses.field(default=field.default),
        )
        for field in dataclasses.fields(section)
        if field.name in some
    ]
    kind = dataclasses.make_dataclass(section.__name__, fields, frozen=True)
    kind.__doc__, kind.__module__ = section.__doc__, section.__module__  # where tyro reads the help
    return kind


def parse_view(
    options: type, command: str, flags: Sequence[str]
) -> tuple[Any, dict[str, dict[str, Any]]]:
    """Parses the `options` of a command, and the changes of the sections VIEW.

    Returns the latter as `Config.change` takes them: a setting without a flag stays the policy's.
    The former are `options` alone: a class made here could not be sent to another process.
    """
    kinds = {}
    for name, some in VIEW.items():
        kind = type(getattr(Config, name))
        kinds[name] = _some(kind, some or names(kind), "(default: the policy's)")
    given = parsing.parse(_with_sections(options, kinds), flags, command)
    named = {flag.split("=")[0].replace("-", "_") for flag in flags}
    plain = {field.name: getattr(given, field.name) for field in dataclasses.fields(options)}
    return options(**plain), {  # whose class has a module, so that a process of its own takes it
        name: {k: v for k, v in vars(getattr(given, name)).items() if f"__{name}.{k}" in named}
        for name in VIEW
    }
