"""Grasps through a renderer that is not ours, as JSON: `csac-jax bench closed_loop [--episodes N]
[--policy SOURCE] [--robot ur5|hand] [--sensor KIND] [--seed N]`.

MuJoCo's OpenGL renderer draws colour and depth of the scenes of random10 through the config's
camera. `deploy.CameraPolicy.decide` gets the image, C MuJoCo the waypoints. First with exact
images, then with those that the sensor makes of them. An image that is refused counts as an
action without change. EPISODES of each (100); the robot is out of the camera's view.
"""

import time

from csac_jax.cli.failures import check_seed
from csac_jax.errors import SettingsError
from csac_jax.render import gl
from experiments.bench._options import Parser, emit


def main(arguments: list[str]) -> None:
    """Prints the result."""
    parser = Parser(prog="bench closed_loop", allow_abbrev=False)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--policy", default="shipped")
    parser.add_argument("--robot", choices=("ur5", "hand"), default="ur5")
    parser.add_argument("--sensor", default="d415")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    if options.episodes < 1:
        parser.error("--episodes: must be at least 1")
    check_seed(options.seed)
    if gl.choose() is None:
        raise SettingsError("bench closed_loop: OpenGL draws neither by EGL nor by OSMesa here")
    from experiments.bench import _closed_loop  # MuJoCo reads what `choose` sets when imported

    begun = time.perf_counter()
    loop = _closed_loop.make(options.policy, options.robot, options.episodes, options.seed)
    sensors = _closed_loop.sensors(options.sensor)
    found = {name: _closed_loop.measure(loop, sensor) for name, sensor in sensors.items()}
    seconds = time.perf_counter() - begun
    result = {"options": vars(options), **found, "seconds": seconds}
    emit(result)
