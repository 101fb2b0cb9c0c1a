"""Arguments of benchmarks: whole numbers by name, switches, and the settings of a preset."""

import argparse
import dataclasses
import json
import time
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from csac_jax.cli import settings
from csac_jax.config import Config
from csac_jax.errors import SettingsError
from csac_jax.runtime import provenance


class Parser(argparse.ArgumentParser):
    """Complains in one line, as the rest of the command line does."""

    def error(self, message: str) -> NoReturn:
        raise SettingsError(f"{self.prog}: {message}")


def _numbers(name: str, defaults: dict[str, int]) -> Parser:
    parser = Parser(prog=f"bench {name}", allow_abbrev=False)
    for option, default in defaults.items():
        if default is False:
            parser.add_argument(f"--{option}", action="store_true")
        else:
            parser.add_argument(f"--{option}", type=int, default=default)
    return parser


def _checked(parser: Parser, options: argparse.Namespace) -> dict[str, int]:
    for option, value in vars(options).items():
        if value < 1 and value is not False:
            parser.error(f"--{option}: must be at least 1")
    return vars(options)


def read(name: str, arguments: list[str], **defaults: int) -> dict[str, int]:
    """Parses whole numbers of at least 1, and switches, whose default is False."""
    parser = _numbers(name, defaults)
    return _checked(parser, parser.parse_args(arguments))


def read_preset(
    name: str, arguments: list[str], **defaults: int
) -> tuple[str, dict[str, int], list[str]]:
    """Parses as `read`; also returns the preset, `quick` if none is given, and the settings."""
    parser = _numbers(name, defaults)
    preset, options, flags = split(parser, arguments)
    return preset, _checked(parser, options), flags


def emit(result: dict[str, Any]) -> None:
    """Prints a result with device, versions and commit, as JSON."""
    print(json.dumps(result | provenance.record(), indent=2))


def timed(name: str, arguments: list[str], measure: Callable[..., Any], **defaults: int) -> None:
    """Prints the result of `measure` with these numbers, and its time."""
    options = read(name, arguments, **defaults)
    begun = time.perf_counter()
    result = measure(**options)
    result["seconds"] = time.perf_counter() - begun
    emit(result)


@dataclasses.dataclass(frozen=True)
class _Run:
    """A preset's settings, as `csac-jax train` takes them."""

    seed: int = 0
    algo: str = "csac_beta"


def split(parser: Parser, arguments: list[str]) -> tuple[str, argparse.Namespace, list[str]]:
    """Splits arguments into preset, options that `parser` knows, and settings."""
    preset, flags = settings.split(arguments)
    return preset or "quick", *parser.parse_known_args(flags)


def config(name: str, preset: str, flags: Sequence[str]) -> Config:
    """Builds the config of a preset with settings as `train` takes them."""
    try:
        return settings.parse(_Run, f"bench {name}", settings.base(preset, flags), flags)[1]
    except SettingsError as error:
        raise SettingsError(f"bench {name}: {error}") from None
