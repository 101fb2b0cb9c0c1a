"""The command `csac-jax`. Exit codes: 0 done, 1 failed, 2 bad arguments, 130 and 143 stopped by
SIGINT and SIGTERM.

A file per command, whose `run` takes its arguments and returns the exit code. JAX is imported only
once the arguments are known to be good, so that help and complaints come at once.
"""

import difflib
import os
import sys
from collections.abc import Callable, Sequence

import csac_jax
from csac_jax import algorithms, presets
from csac_jax.cli import bench, doctor, evaluation, export, parsing, play, report, sweep, train
from csac_jax.cli.failures import PROGRAM, BadArgumentsError, FailedError, complain
from csac_jax.errors import DeviceError, SceneError

COMMANDS: dict[str, Callable[[list[str]], int]] = {
    "train": train.run,
    "sweep": sweep.run,
    "eval": evaluation.run,
    "play": play.run,
    "report": report.run,
    "export": export.run,
    "doctor": doctor.run,
    "bench": bench.run,
}
USAGE = f"""usage: {PROGRAM} COMMAND ...

A robot learns to push and grasp in clutter.

  train PRESET       train with a preset: {", ".join(presets.PRESETS)}
                     --algo NAME: {", ".join(algorithms.ALGORITHMS)}
  train --resume DIR go on with a run that was stopped
  sweep PRESET       train several seeds and settings side by side, in one program
                     --seeds N, --vary NAME=A,B
  eval POLICY        measure a policy: a run's folder, a policy file, or the one shipped
  play               run one episode, as text, picture and video
  report RUN...      tables and figures of recorded runs and evaluations
  export DIR FILE    write the policy of a run into one small file
  doctor             versions, devices and a self-test of this machine
  bench NAME         speed of a part, as JSON; needs a checkout of the sources

`--device cpu` or `--device gpu` says where JAX computes.
`{PROGRAM} COMMAND --help` lists the options of a command; --version prints the version.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command in `argv` (without the program's name; the process's own if None); returns
    the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        return _dispatch(arguments)
    except (BadArgumentsError, DeviceError) as error:
        return complain(2, error)
    except BrokenPipeError:  # whoever read the output, such as `head`, has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (FailedError, SceneError, OSError) as error:
        return complain(1, error)
    except KeyboardInterrupt:
        return complain(130, "stopped")


def _call(command: Callable[[list[str]], int], arguments: list[str]) -> int:
    """Runs a command. If JAX starts without a device, DeviceError says so."""
    try:
        return command(arguments)
    except (RuntimeError, AssertionError):
        from csac_jax.runtime import devices

        devices.require()
        raise


def _dispatch(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE, end="")
        return 0 if arguments else 2
    if arguments[0] == "--version":
        print(csac_jax.__version__)
        return 0
    name, *rest = arguments
    if name not in COMMANDS:
        near = difflib.get_close_matches(name, COMMANDS, 1)
        meant = f"did you mean {near[0]}? " if near else ""
        listed = ", ".join(COMMANDS)
        raise BadArgumentsError(f"unknown command '{name}'; {meant}choose one of: {listed}")
    return _call(COMMANDS[name], _on_device(rest))


def _on_device(arguments: list[str]) -> list[str]:
    """The arguments without --device, which decides where JAX computes."""
    device = parsing.value_of(arguments, "--device")
    if device is None:
        return arguments
    if device not in ("cpu", "gpu"):
        raise BadArgumentsError(f"--device: '{device}' is not one of: cpu, gpu")
    from csac_jax.runtime import devices

    devices.select("cpu" if device == "cpu" else "gpu")
    return parsing.without(arguments, "--device")
