"""PRESET and settings on the command line -> Config; what `train`, `sweep` and `doctor` share."""

import ast
import dataclasses
import functools
import inspect
import itertools
from collections.abc import Sequence
from typing import Any

from csac_jax import algorithms, config, presets
from csac_jax.cli import parsing
from csac_jax.cli.errors import PROGRAM, as_bad_arguments
from csac_jax.config import Config

PRESETS = ", ".join(presets.PRESETS)
FIRST = (
    *("train.actions", "train.scenes", "train.learning_starts", "task.kind", "sim.physics"),
    *("scene.slots", "scene.arranged", "heightmap.view", "learn.learning_rate", "learn.batch"),
    *("learn.updates", "target.gamma", "replay.sampler", "replay.capacity", "net.kind"),
)
"""The settings that people change first."""
WIDTH = 100


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
    """The `options` of a command, and `base` with the settings that the flags give.

    A flag that names an alternative, such as --replay.sampler, decides which settings there are.
    """
    for name, (tag, _) in config.ALTERNATIVES.items():
        choice = parsing.value_of(flags, f"--{name}.{tag}")
        if choice is not None:
            with as_bad_arguments(ValueError):
                base = base.change(**{name: {tag: choice}})
    sections = {
        field.name: getattr(base, field.name)
        for field in dataclasses.fields(Config)
        if isinstance(getattr(base, field.name), config.Section)
    }
    fields: Any = [
        (name, type(section), dataclasses.field(default=section))
        for name, section in sections.items()
    ]
    namespace = {"__doc__": options.__doc__}
    kind = dataclasses.make_dataclass(
        f"_{options.__name__}", fields, bases=(options,), frozen=True, namespace=namespace
    )
    default = kind(seed=base.seed, algo=base.algo)
    given: Any = parsing.parse(kind, flags, command, default)
    with as_bad_arguments(ValueError):
        changed = {name: getattr(given, name) for name in (*sections, "algo", "seed")}
        return given, dataclasses.replace(base, **changed)


def print_help(options: type, command: str, examples: Sequence[str]) -> None:
    """The short help of a command that takes settings: examples, options, the settings of FIRST."""
    print(f"usage: {PROGRAM} {command} PRESET [--OPTION VALUE ...]\n")
    print(f"{inspect.cleandoc(options.__doc__ or '')}\n\nPresets: {PRESETS}\n\nexamples:")
    for example in examples:
        print(f"  {PROGRAM} {command} {example}")
    print("\noptions:")
    for field in dataclasses.fields(options):
        _print_row(_flag(field.name), _docs(options).get(field.name, ""))
    print("\nsettings that people change first, with the values of quick:")
    quick = presets.quick()
    for name in FIRST:
        section, setting = name.split(".")
        value = getattr(getattr(quick, section), setting)
        shown = " ".join(map(str, value)) if isinstance(value, tuple) else value
        _print_row(
            f"{_flag(name)} {shown}", _docs(getattr(quick, section).__class__).get(setting, "")
        )
    print(f"\nAll settings: {PROGRAM} {command} PRESET --help-all")


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


def _print_row(flag: str, text: str) -> None:
    """A flag and the first sentence of what it does."""
    sentence = text.replace("`", "").split(". ")[0].split("; ")[0].split(": ")[0].rstrip(".:;")
    start = f"  {flag:<32} " if len(flag) <= 32 else f"  {flag}\n{'':35}"
    print(f"{start}{sentence}"[: WIDTH + (0 if len(flag) <= 32 else len(flag) + 3)])


@functools.cache
def _docs(kind: Any) -> dict[str, str]:
    """The text below each field of a dataclass, in one line."""
    tree = ast.parse(inspect.getsource(kind))
    body = tree.body[0].body if isinstance(tree.body[0], ast.ClassDef) else []
    docs = {}
    for field, text in itertools.pairwise(body):
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
            docs[ast.unparse(field.target)] = " ".join(ast.literal_eval(text.value).split())
    return docs
