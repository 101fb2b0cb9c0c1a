"""`csac-jax bench`: runs the scripts of a checkout that measure speed."""

import runpy
from pathlib import Path

import csac_jax
from csac_jax.cli.failures import PROGRAM, BadArgumentsError

BENCHMARKS = Path(csac_jax.__file__).parents[1] / "experiments" / "bench"


def run(arguments: list[str]) -> int:
    """Runs `main` of a script; returns the exit code."""
    scripts = {path.stem: path for path in BENCHMARKS.glob("[!_]*.py")}
    if not scripts:
        raise BadArgumentsError(
            f"bench: there is nothing in {BENCHMARKS}; benchmarks come with a checkout"
        )
    names = ", ".join(sorted(scripts))
    if arguments[:1] in (["-h"], ["--help"]):
        print(f"usage: {PROGRAM} bench NAME ..., with NAME one of: {names}")
        return 0
    name, *rest = arguments or [""]
    if name not in scripts:
        raise BadArgumentsError(f"bench: unknown benchmark '{name}'; choose one of: {names}")
    runpy.run_path(str(scripts[name]))["main"](rest)
    return 0
