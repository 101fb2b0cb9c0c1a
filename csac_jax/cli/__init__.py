"""The command `csac-jax`. Exit codes: 0 done, 1 failed, 2 bad arguments, 130 and 143 stopped.

Each command has a file, whose `run` takes its arguments and returns the exit code. JAX is imported
only after the arguments are checked, so that help and errors come at once.
"""

import contextlib
import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import csac_jax
from csac_jax import algorithms, presets
from csac_jax.cli import (
    act,
    bench,
    calibrate,
    demo,
    doctor,
    evaluate,
    export,
    finetune,
    objects,
    output,
    parsing,
    play,
    report,
    scenes,
    serve,
    shipped,
    sweep,
    train,
)
from csac_jax.cli.failures import complain
from csac_jax.cli.parsing import PROGRAM
from csac_jax.errors import DataWarning, FailedError, SettingsError
from csac_jax.io import files
from csac_jax.runtime import modules
from csac_jax.section import require

_LESS = "lower --replay.capacity, --train.scenes, --learn.batch or --seeds, or raise --devices"

COMMANDS: dict[str, Callable[[list[str]], int]] = {
    "demo": demo.run,
    "train": train.run,
    "sweep": sweep.run,
    "eval": evaluate.run,
    "play": play.run,
    "policies": shipped.run,
    "calibrate": calibrate.run,
    "act": act.run,
    "serve": serve.run,
    "finetune": finetune.run,
    "report": report.run,
    "export": export.run,
    "objects": objects.run,
    "scenes": scenes.run,
    "doctor": doctor.run,
    "bench": bench.run,
}
USAGE = f"""usage: {PROGRAM} COMMAND ...

A robot learns to push and grasp in clutter.

  demo               write a video of an arm that pushes blocks apart, in a minute or two
  train PRESET       train with a preset: {", ".join(presets.PRESETS)}
                     --algo NAME: {", ".join(algorithms.ALGORITHMS)}
  train --resume DIR continue a run that was stopped
  sweep PRESET       train several seeds and settings side by side, in one program
                     --seeds N, --vary NAME=A,B
  eval POLICY        measure a policy: a run's folder, a policy file, or one that is shipped
  policies           list the policies that are shipped, and what each is for
  play               run one episode, as text, picture and video
  calibrate          find the camera's pose by a printed board
  act POLICY         decide where to grasp or push in a camera's image
  serve POLICY       answer images by decisions over HTTP
  finetune POLICY DIR
                     learn from actions that act or serve recorded in DIR
  report RUN...      tables and figures of recorded runs and evaluations
  export DIR FILE    write the policy of a run into one small file
  objects COMMAND    make, import or show a library of objects
  scenes certify     keep scenes in which a push must come before a grasp
  doctor             versions, devices and a self-test of this machine
  bench NAME         speed of a part, as JSON; needs a checkout of the sources

`--device cpu` or `--device gpu` says where JAX computes.
`--import MODULE` first loads a module of your own, for the presets, algorithms, suites and policies
that it registers.
`{PROGRAM} COMMAND --help` lists the options of a command; --version prints the version.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command in `argv`, by default the process's arguments; returns the exit code."""
    if set(os.environ.get("COLUMNS", "")) == {"0"}:
        del os.environ["COLUMNS"]  # rich would print nothing
    with output.unbroken(), _logged(), warnings.catch_warnings():
        warnings.simplefilter("always", DataWarning)
        warnings.showwarning = _warner()
        return _guarded(list(sys.argv[1:] if argv is None else argv))


@contextlib.contextmanager
def _logged() -> Iterator[None]:
    logger, handler = logging.getLogger(csac_jax.__name__), logging.StreamHandler()
    level, propagate = logger.level, logger.propagate
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    logger.propagate = False  # Orbax gives the root logger a handler
    try:
        yield
    finally:
        logger.setLevel(level)
        logger.propagate = propagate
        logger.removeHandler(handler)


def _warner() -> Callable[..., None]:
    """Returns a function that prints each different warning once, in one line."""
    printed = set()

    def warn(message: object, *_: Any, **__: Any) -> None:
        line = " ".join(str(message).split())
        if line not in printed:
            printed.add(line)
            complain(0, f"warning: {line}")

    return warn


def _guarded(arguments: list[str]) -> int:
    """Runs a command; returns its exit code. Prints an error that the user can fix in one line."""
    try:
        return _dispatch(arguments)
    except SettingsError as error:
        return complain(2, error)
    except (FailedError, OSError) as error:
        return complain(1, error)
    except KeyboardInterrupt:
        return complain(130, "stopped")


def _dispatch(arguments: list[str]) -> int:
    name, *rest = arguments or [""]
    if name in ("", "-h", "--help"):
        print(USAGE, end="")
        return 0 if name else 2
    if name == "--version":
        print(csac_jax.__version__)
        return 0
    require(name in COMMANDS, algorithms.unknown("command", name, COMMANDS))
    try:
        return COMMANDS[name](_on_device(_with_modules(rest)))
    except (RuntimeError, AssertionError) as error:
        from csac_jax.runtime import devices

        devices.require()  # JAX may have started without a device
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        text = f"the device is out of memory; {_LESS} ({files.first_line(error)})"
        raise FailedError(text) from None


def _with_modules(arguments: list[str]) -> list[str]:
    """Loads the modules of one's own that `--import` names; returns the other arguments."""
    given, rest = parsing.take_all(arguments, "--import")
    for module in given:
        require(module is not None, "--import: give the name of a module")
        modules.load(str(module))
    return rest


def _on_device(arguments: list[str]) -> list[str]:
    device, rest = parsing.take(arguments, "--device")
    if device is None:
        return arguments
    require(device in ("cpu", "gpu"), f"--device: '{device}' is not one of: cpu, gpu")
    from csac_jax.runtime import devices

    devices.select("cpu" if device == "cpu" else "gpu")
    return rest
