"""PRESET and settings on the command line -> Config; what `train`, `sweep` and `doctor` share."""

import dataclasses
import functools
import inspect
import re
import textwrap
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from csac_jax import algorithms, config, presets
from csac_jax.cli import parsing
from csac_jax.cli.failures import PROGRAM, as_bad_arguments
from csac_jax.config import Config

PRESETS = ", ".join(presets.PRESETS)
FIRST = (
    *("train.actions", "train.scenes", "train.learning_starts", "task.kind", "sim.physics"),
    *("scene.slots", "scene.arranged", "heightmap.view", "learn.learning_rate", "learn.batch"),
    *("learn.updates", "target.gamma", "replay.sampler", "replay.capacity", "net.kind"),
)
"""The settings that people change first."""
WIDTH, COLUMN = 100, 32  # of the short help, and where its texts begin
_METAVARS = {
    (bool,): "",
    (Path,): "PATH",
    (int,): "N",
    (str,): "TEXT",
    (tuple[str, ...],): "NAME=A,B",
}


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


def parse(options: type, command: str, base: Config, flags: Sequence[str]) -> tuple[Any, Config]:
    """The `options` of a command, and `base` with the settings that the flags give."""
    with as_bad_arguments(ValueError):
        sections = _sections(base, flags)
    fields: Any = [
        (name, type(section), dataclasses.field(default=section))
        for name, section in sections.items()
    ]
    namespace = {"__doc__": options.__doc__}
    kind = dataclasses.make_dataclass(
        f"_{options.__name__}", fields, bases=(options,), frozen=True, namespace=namespace
    )
    default = kind(seed=base.seed, algo=base.algo)
    given: Any = parsing.parse(kind, flags, command, default, "--help-all")
    with as_bad_arguments(ValueError):
        changed = {name: getattr(given, name) for name in (*sections, "algo", "seed")}
        return given, dataclasses.replace(base, **changed)


def _sections(base: Config, flags: Sequence[str]) -> dict[str, Any]:
    """The sections of a config; a flag such as --replay.sampler decides which settings one has.

    Raises ValueError for a flag that is a setting of another alternative.
    """
    sections = {name: getattr(base, name) for name in _names(base)}
    sections = {name: one for name, one in sections.items() if isinstance(one, config.Section)}
    for name, (tag, kinds) in config.ALTERNATIVES.items():
        choice = parsing.value_of(flags, f"--{name}.{tag}") or getattr(sections[name], tag)
        sections[name] = config.alternative(sections[name], choice)
        others = set().union(*map(_names, kinds)) - _names(sections[name])
        for flag in flags:
            prefix, _, setting = flag.split("=")[0].replace("-", "_").rpartition(".")
            if prefix == f"__{name}" and setting in others:
                raise ValueError(f"{flag}: --{name}.{tag} {choice} has no such setting")
    return sections


def _names(section: Any) -> set[str]:
    return {field.name for field in dataclasses.fields(section)}


def print_help(
    options: type, command: str, examples: Sequence[str], arguments: Sequence[str]
) -> None:
    """The short help of a command that takes settings: examples, options, the settings of FIRST."""
    name, flags = split(arguments)
    cfg = preset(name or "quick", flags)
    print(f"usage: {PROGRAM} {command} PRESET [--OPTION VALUE ...]\n")
    print(inspect.cleandoc(options.__doc__ or ""))
    print(f"\npresets: {PRESETS}\nalgorithms: {', '.join(algorithms.ALGORITHMS)}\n\nexamples:")
    for example in examples:
        print(f"  {PROGRAM} {command} {example}")
    print("\noptions:")
    for option in dataclasses.fields(options):
        value = _METAVARS.get(typing.get_args(option.type)[:1], option.default)
        _print_row(option.name, value, _docs(options)[option.name])
    _print_row("device", "cpu|gpu", "Where JAX computes; by default on a GPU, if there is one.")
    print(f"\nsettings that people change first, with the values of {cfg.preset}:")
    for setting in FIRST:
        section_name, field = setting.split(".")
        section = getattr(cfg, section_name)
        _print_row(setting, getattr(section, field), _docs(section.__class__)[field])
    print(f"\nAll settings: {PROGRAM} {command} {name or 'PRESET'} --help-all")


def _print_row(name: str, value: Any, text: str) -> None:
    """A flag with its value and, in a column of its own, what it does."""
    shown = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
    flag = f"  --{name.replace('_', '-')} {shown}"
    if len(flag) >= COLUMN:
        print(flag)
        flag = ""
    paragraph = textwrap.TextWrapper(WIDTH, flag.ljust(COLUMN), " " * COLUMN)
    paragraph.break_long_words = paragraph.break_on_hyphens = False
    print(paragraph.fill(text.replace("`", "")))


@functools.cache
def _docs(kind: Any) -> dict[str, str]:
    """The text beside or below each field of a dataclass, in one line."""
    field = r'^    (\w+): .*(?:  # (.*)|\n    """([^"]*)""")$'
    found = re.findall(field, inspect.getsource(kind), re.MULTILINE)
    return {name: " ".join((beside or below).split()) for name, beside, below in found}
