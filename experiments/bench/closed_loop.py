"""Grasps through a renderer that is not ours, as JSON: `csac-jax bench closed_loop [--episodes N]
[--policy SOURCE] [--robot ur5|hand] [--gripper NAME] [--suite NAME] [--objects LIBRARY]
[--sensor KIND [KIND]] [--seed N] [--record DIR]`.

MuJoCo's OpenGL renderer draws colour and depth of the scenes of a suite through the config's
camera. `deploy.CameraPolicy.decide` gets the image, C MuJoCo the waypoints. The images are those
of each sensor in turn, exact ones and a D415's by default. An image that is refused counts as an
action without change. EPISODES of each (100); the robot is out of the camera's view. DIR gets the
images, decisions and outcomes, for `csac-jax finetune`.
"""

import time
from pathlib import Path
from typing import get_args

from csac_jax.cli.failures import check_seed
from csac_jax.config import SensorConfig, SensorKind
from csac_jax.errors import SettingsError
from csac_jax.render import gl
from experiments.bench._options import Parser, emit


def main(arguments: list[str]) -> None:
    """Prints the result."""
    parser = Parser(prog="bench closed_loop", allow_abbrev=False)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--policy", default="shipped")
    parser.add_argument("--robot", choices=("ur5", "hand"), default="ur5")
    parser.add_argument("--gripper")
    parser.add_argument("--suite", default="random10")
    parser.add_argument("--objects")
    kinds = get_args(SensorKind)
    parser.add_argument("--sensor", nargs="+", choices=kinds, default=("none", "d415"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--record", type=Path)
    options = parser.parse_args(arguments)
    if options.episodes < 1:
        parser.error("--episodes: must be at least 1")
    check_seed(options.seed)
    if gl.choose() is None:
        raise SettingsError("bench closed_loop: OpenGL draws neither by EGL nor by OSMesa here")
    from experiments.bench import _closed_loop  # MuJoCo reads what `choose` sets when imported

    begun = time.perf_counter()
    loop = _closed_loop.make(options)
    found = {kind: _closed_loop.measure(loop, SensorConfig(kind=kind)) for kind in options.sensor}
    seconds = time.perf_counter() - begun
    del options.record  # a path of this machine
    emit({"options": vars(options), **found, "seconds": seconds})
