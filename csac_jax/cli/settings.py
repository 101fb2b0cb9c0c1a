"""PRESET and settings on the command line -> Config; what `train`, `sweep` and `doctor` share."""

import argparse
import dataclasses
import inspect
import re
import typing
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

from csac_jax import algorithms, config, presets
from csac_jax.cli import parsing
from csac_jax.cli.failures import PROGRAM, BadArgumentsError, as_bad_arguments, exists
from csac_jax.config import Config

PRESETS = ", ".join(presets.PRESETS)
FIRST = (
    *("train.actions", "train.scenes", "train.learning_starts", "task.kind", "sim.physics"),
    *("scene.slots", "scene.arranged", "heightmap.view", "learn.learning_rate", "learn.batch"),
    *("learn.updates", "target.gamma", "replay.sampler", "replay.capacity", "net.kind"),
)
"""The settings that people change first."""
VIEW: dict[str, tuple[str, ...]] = {
    "heightmap": (),
    "camera": (),
    "sensor": (),
    "sim": ("gripper", "base", "adapter", "clearance"),
}
"""Sections that say how a policy sees and what hand it moves, () or some of their settings; `eval`
and `play` take them for any policy."""
_METAVARS: Any = {bool: "", Path: "PATH", int: "N", str: "TEXT", tuple[str, ...]: "NAME=A,B"}
_LAYOUT = partial(argparse.RawDescriptionHelpFormatter, max_help_position=32, width=100)


def split(arguments: Sequence[str]) -> tuple[str | None, list[str]]:
    """The preset, if one stands first, and the flags."""
    if arguments and not arguments[0].startswith("-"):
        return arguments[0], list(arguments[1:])
    return None, list(arguments)


def check_new(command: str, preset: str | None, file: Path | None, folder: Path | None) -> None:
    """A new run needs a preset or a config file, and a folder that does not exist."""
    if preset is None and file is None:
        raise BadArgumentsError(
            f"{command}: give a preset first, one of: {PRESETS}; or --config FILE"
        )
    if folder is not None and folder.exists():
        raise exists(folder)


@as_bad_arguments(ValueError)
def base(name: str | None, flags: Sequence[str]) -> Config:
    """The preset, or the config of the file, of the algorithm and with networks of the policy that
    the flags name."""
    options = ("--algo", "--init", "--config")
    algo, init, file = (parsing.take(flags, option)[0] for option in options)
    if file is not None and not parsing.asks_help(flags):
        from csac_jax.io import config_file

        cfg = config_file.load_config(file, name, algo)
    else:
        cfg = presets.get(name or Config.preset)
        cfg = cfg if algo is None else algorithms.configure(cfg, algo)
    if init is None or parsing.asks_help(flags):
        return cfg
    from csac_jax import api

    return api.match_networks(cfg, init)


@as_bad_arguments(ValueError)
def parse(options: type, command: str, base: Config, flags: Sequence[str]) -> tuple[Any, Config]:
    """The `options` of a command, and `base` with the settings that the flags give."""
    sections = _sections(base, flags)
    fields = [(name, type(section)) for name, section in sections.items()]
    kind: Any = dataclasses.make_dataclass(
        options.__name__, fields, bases=(options,), frozen=True, kw_only=True
    )
    kind.__doc__ = options.__doc__
    default = kind(**sections, seed=base.seed, algo=base.algo)
    given = parsing.parse(kind, list(flags), command, default)
    changed = {name: getattr(given, name) for name in (*sections, "algo", "seed")}
    return given, dataclasses.replace(base, **changed)


def parse_view(
    options: type, command: str, flags: Sequence[str]
) -> tuple[Any, dict[str, dict[str, Any]]]:
    """The `options` of a command, and what its flags change in the sections VIEW, as
    `Config.change` takes it; what no flag gives stays the policy's."""
    fields = [(name, _inherited(type(getattr(Config, name)), some)) for name, some in VIEW.items()]
    listed = [(name, kind, dataclasses.field(default=kind())) for name, kind in fields]
    kind: Any = dataclasses.make_dataclass(
        options.__name__, listed, bases=(options,), frozen=True, kw_only=True
    )
    kind.__doc__ = options.__doc__
    given = parsing.parse(kind, list(flags), command)
    named = {flag.split("=")[0].replace("-", "_") for flag in flags}
    changes = {name: vars(getattr(given, name)).items() for name in VIEW}
    return given, {
        name: {key: value for key, value in values if f"__{name}.{key}" in named}
        for name, values in changes.items()
    }


def decision(options: Any) -> dict[str, Any]:
    """What a command's `--augment`, `--height-bonus` and `--retry` set in the section `policy`."""
    mirrored = None if options.augment is None else options.augment == "on"
    values = {"augment": mirrored, "height_bonus": options.height_bonus, "retry": options.retry}
    return {name: value for name, value in values.items() if value is not None}


def _inherited(section: Any, some: tuple[str, ...]) -> Any:
    """A dataclass of all or some settings of a section, which are the policy's unless given."""
    docs = field_docs(section)
    fields = [
        (field.name, parsing.inherited(field.type, docs[field.name]), field.default)
        for field in dataclasses.fields(section)
        if not some or field.name in some
    ]
    kind = dataclasses.make_dataclass(section.__name__, fields, frozen=True)
    kind.__doc__ = f"{section.__doc__} By default as the policy's."
    return kind


def _sections(base: Config, flags: Sequence[str]) -> dict[str, Any]:
    """The sections of a config; a flag such as --replay.sampler decides which settings one has.

    Raises ValueError for a flag that is a setting of another alternative.
    """
    sections: dict[str, Any] = {
        name: one for name, one in vars(base).items() if isinstance(one, config.Section)
    }
    for name, (tag, kinds) in config.ALTERNATIVES.items():
        choice = parsing.take(flags, f"--{name}.{tag}")[0] or getattr(sections[name], tag)
        sections[name] = config.alternative(sections[name], choice)
        others = set().union(*(vars(kind()) for kind in kinds)) - vars(sections[name]).keys()
        for flag in flags:
            prefix, _, setting = flag.split("=")[0].replace("-", "_").rpartition(".")
            if prefix == f"__{name}" and setting in others:
                raise ValueError(f"{flag}: --{name}.{tag} {choice} has no such setting")
    return sections


def print_help(options: type, command: str, examples: Sequence[str], arguments: list[str]) -> None:
    """The short help of a command that takes settings: examples, options, the settings of FIRST."""
    name, flags = split(arguments)
    cfg = base(name, flags)
    listed = "".join(f"\n  {PROGRAM} {command} {example}" for example in examples)
    parser = argparse.ArgumentParser(
        usage=f"{PROGRAM} {command} PRESET [--OPTION VALUE ...]",
        description=f"{inspect.getdoc(options)}\n\npresets: {PRESETS}\n"
        f"algorithms: {', '.join(algorithms.ALGORITHMS)}\n\nexamples:{listed}",
        epilog=f"All settings: {PROGRAM} {command} {name or 'PRESET'} --help-all",
        add_help=False,
        formatter_class=_LAYOUT,
    )
    for option in dataclasses.fields(options):
        kind = next(iter(typing.get_args(option.type)), None)
        _add(
            parser,
            option.name,
            _METAVARS.get(kind, option.default),
            field_docs(options)[option.name],
        )
    _add(parser, "device", "cpu|gpu", "Where JAX computes; by default on a GPU, if there is one.")
    title = f"settings that people change first, with the values of {cfg.preset}"
    first = parser.add_argument_group(title)
    for setting in FIRST:
        section_name, field = setting.split(".")
        section = getattr(cfg, section_name)
        _add(first, setting, getattr(section, field), field_docs(section.__class__)[field])
    parser.print_help()


def _add(group: Any, name: str, value: Any, text: str) -> None:
    """Adds a row to the help: a flag with its value, and what it does."""
    shown = " ".join(map(str, value)) or "NAME ..." if isinstance(value, tuple) else str(value)
    flag, text = f"--{name.replace('_', '-')}", text.replace("`", "").replace("%", "%%")
    group.add_argument(flag, metavar=shown, help=text)


@cache
def field_docs(kind: Any) -> dict[str, str]:
    """The text beside or below each field of a dataclass and of its bases, in one line."""
    field = r'^    (\w+): .*(?:  # (.*)|\n    """([^"]*)""")$'
    classes: list[Any] = [one for one in reversed(kind.__mro__) if dataclasses.is_dataclass(one)]
    source = "".join(inspect.getsource(one) for one in classes)
    found = re.findall(field, source, re.MULTILINE)
    return {name: " ".join((beside or below).split()) for name, beside, below in found}
