"""`csac-jax bench`: runs the scripts of a checkout that measure speed."""

import runpy
from pathlib import Path

import csac_jax
from csac_jax.algorithms import unknown
from csac_jax.cli.parsing import PROGRAM, SHORT_HELP
from csac_jax.errors import SettingsError

BENCHMARKS = Path(csac_jax.__file__).parents[1] / "experiments" / "bench"


def run(arguments: list[str]) -> int:
    """Runs `main` of a script; returns the exit code."""
    scripts = {path.stem: path for path in sorted(BENCHMARKS.glob("[!_]*.py"))}
    name, *rest = arguments or [""]
    if name in SHORT_HELP:
        print(f"usage: {PROGRAM} bench NAME ..., with NAME one of: {', '.join(scripts)}")
    elif name not in scripts:
        raise SettingsError(f"bench: {unknown('benchmark', name, scripts)} (in {BENCHMARKS})")
    else:
        runpy.run_path(str(scripts[name]))["main"](rest)
    return 0
