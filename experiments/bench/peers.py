"""Policies in a peer's simulator, as JSON: `csac-jax bench peers CLONE [--policies NAME ...]
[--scenes pile packed] [--rounds N] [--seed N] [--view above|oblique] [--noise M] [--gripper NAME]
[--opening full|fit ...] [--clearance M] [--objects test|train]`.

CLONE is a clone of github.com/HaojHuang/Edge-Grasp-Network; it needs `pip install pybullet`.
NAME is a policy that ships, a policy file, a run's folder, `random` or `geometric`. Each image goes
through `CameraPolicy`, each decision to the clone's `execute_grasp`, whose label counts: five
objects a round, until none is left or two grasps in a row failed. `grasp_success` is lifted over
tried (GSR), `declutter_rate` lifted over presented (DR). All policies meet the same scenes.
"""

import contextlib
import importlib.metadata
import itertools
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from csac_jax.cli.failures import check_seed
from csac_jax.errors import SettingsError
from experiments.bench._options import Parser, emit
from experiments.peers import clutter_removal, exam

OBJECTS = 5  # of a round
MOST_NOISE = 0.05  # m


def main(arguments: list[str]) -> None:
    """Prints the result."""
    parser = Parser(prog="bench peers", allow_abbrev=False)
    parser.add_argument("clone", type=Path)
    parser.add_argument("--policies", nargs="+", default=[exam.BASE, "geometric", "random"])
    parser.add_argument("--scenes", nargs="+", choices=("pile", "packed"), default=["pile"])
    parser.add_argument("--rounds", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--view", choices=("above", "oblique"), default="above")
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--gripper", default="franka_hand")
    parser.add_argument("--opening", nargs="+", choices=("full", "fit"), default=["full"])
    parser.add_argument("--clearance", type=float, default=0.0)
    parser.add_argument("--objects", choices=("test", "train"), default="test")
    options = parser.parse_args(arguments)
    if options.rounds < 1:
        parser.error("--rounds: must be at least 1")
    if not 0.0 <= options.noise <= MOST_NOISE:
        parser.error(f"--noise: must lie in 0 .. {MOST_NOISE} m")
    check_seed(options.seed)
    begun = time.perf_counter()
    try:
        with _stdout_to_stderr():
            peer = clutter_removal.load(options.clone.resolve())
            rows = list(_rows(peer, options))
    except SettingsError as error:
        raise SettingsError(f"bench peers: {error}") from None
    shown = {name: value for name, value in vars(options).items() if name != "clone"}
    versions = {"pybullet": importlib.metadata.version("pybullet"), "simulator": peer.digest}
    result = {"options": shown, "peer": versions, "rows": rows}
    emit(result | {"seconds": time.perf_counter() - begun})


def _rows(peer: clutter_removal.Peer, options: Any) -> Iterator[dict[str, Any]]:
    """Yields a result for each scene, policy and opening."""
    asked = exam.Options(options.view, options.noise, OBJECTS, options.rounds, options.seed)
    clone, home = options.clone.resolve(), Path.cwd()
    for scene in options.scenes:
        with contextlib.chdir(clone):
            sim = clutter_removal.start(peer, clone, scene, options.objects)
        for policy, opening in itertools.product(options.policies, options.opening):
            changes = {"gripper": options.gripper, "opening": opening}
            changes |= {"clearance": options.clearance} if options.clearance else {}
            with contextlib.chdir(home):
                decide = exam.decider(policy, sim, changes)
            begun, rounds = time.perf_counter(), []
            with contextlib.chdir(clone):  # its paths are relative
                for number in range(options.rounds):
                    rounds.append(exam.play(peer, sim, decide, asked, number))
            found = exam.summarise(rounds) | {"seconds": time.perf_counter() - begun}
            shares = (found[name]["value"] for name in ("grasp_success", "declutter_rate"))
            print(scene, policy, opening, *shares, file=sys.stderr, flush=True)
            yield {"scene": scene, "policy": policy, "opening": opening} | found
        sim.world.close()


@contextlib.contextmanager
def _stdout_to_stderr() -> Iterator[None]:
    """Sends to stderr what PyBullet writes to stdout, which is for the result."""
    sys.stdout.flush()
    stdout = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(stdout, 1)
        os.close(stdout)
