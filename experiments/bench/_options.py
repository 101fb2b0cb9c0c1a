"""Arguments of benchmarks: whole numbers by name, and switches."""

import argparse
from typing import NoReturn

from csac_jax.cli.errors import BadArgumentsError


class Parser(argparse.ArgumentParser):
    """Complains in one line, as the rest of the command line does."""

    def error(self, message: str) -> NoReturn:
        raise BadArgumentsError(f"{self.prog}: {message}")


def read(name: str, arguments: list[str], **defaults: int) -> dict[str, int]:
    """The numbers given for the benchmark `name`, each at least 1, and its switches, whose default is False."""
    parser = Parser(prog=f"bench {name}", allow_abbrev=False)
    for option, default in defaults.items():
        if default is False:
            parser.add_argument(f"--{option}", action="store_true")
        else:
            parser.add_argument(f"--{option}", type=int, default=default)
    options = vars(parser.parse_args(arguments))
    for option, value in options.items():
        if value < 1 and value is not False:
            parser.error(f"--{option}: must be at least 1")
    return options
