"""`csac-jax bench`: runs the scripts of a checkout that measure speed."""

import runpy
from pathlib import Path

import csac_jax
from csac_jax.algorithms import unknown
from csac_jax.cli.failures import PROGRAM, BadArgumentsError

BENCHMARKS = Path(csac_jax.__file__).parents[1] / "experiments" / "bench"


def run(arguments: list[str]) -> int:
    """Runs `main` of a script; returns the exit code."""
    scripts = {path.stem: path for path in sorted(BENCHMARKS.glob("[!_]*.py"))}
    if not scripts:
        raise BadArgumentsError(f"bench: no scripts in {BENCHMARKS}; they come with a checkout")
    name, *rest = arguments or [""]
    if name in ("-h", "--help"):
        print(f"usage: {PROGRAM} bench NAME ..., with NAME one of: {', '.join(scripts)}")
        return 0
    if name not in scripts:
        raise BadArgumentsError(f"bench: {unknown('benchmark', name, scripts)}")
    try:
        script = runpy.run_path(str(scripts[name]))
    except ModuleNotFoundError as error:
        raise BadArgumentsError(
            f"bench {name} needs the module {error.name}; install the extra of pyproject.toml that "
            "brings it: pip install 'csac-jax[EXTRA]'"
        ) from None
    script["main"](rest)
    return 0
