"""Fine-tuning on recorded grasps of a gripper that opens less, as JSON: `csac-jax bench finetune
[--seeds N] [--grasps N] [--opening-mm N] [--episodes N] [--updates N] [--batch N] [--policy SOURCE]
[--learning-rate X] [--camera above|side]`.

The shipped policy was trained with fingers that open 110 mm. Here they open OPENING-MM (65). For
each of SEEDS (3): the policy acts through `deploy.CameraPolicy` on images of MuJoCo's renderer,
random10, until GRASPS (500) are recorded as `act --record` does; it learns from them as
`csac-jax finetune` does; and both policies act in EPISODES (24) other scenes, through the same
camera. Gains are means over the seeds, with Student's interval.
"""

import json
import sys
import time
from typing import Any

from csac_jax.cli.failures import BadArgumentsError, as_bad_arguments
from csac_jax.render import gl
from csac_jax.runtime import cache, provenance
from experiments.bench._options import Parser

COUNTS = {"seeds": 3, "grasps": 500, "opening-mm": 65, "episodes": 24, "updates": 150, "batch": 16}


def main(arguments: list[str]) -> None:
    """Prints the result."""
    parser = Parser(prog="bench finetune", allow_abbrev=False)
    for name, default in COUNTS.items():
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--learning-rate", type=float, default=3e-4)
    parser.add_argument("--policy", default="shipped")
    parser.add_argument("--camera", choices=("above", "side"), default="above")
    options = vars(parser.parse_args(arguments))
    for name, value in options.items():
        if isinstance(value, int) and value < 1:
            parser.error(f"--{name.replace('_', '-')}: must be at least 1")
    if gl.choose() is None:
        raise BadArgumentsError("bench finetune: OpenGL draws neither by EGL nor by OSMesa here")
    from experiments.bench import _finetune  # MuJoCo reads what `choose` sets when imported

    cache.enable()
    begun, opening = time.perf_counter(), 1e-3 * options["opening_mm"]
    names = ("updates", "batch", "learning_rate")
    learn = _finetune.Settings(**{name: options[name] for name in names})
    setting = _finetune.World(opening, options["camera"], options["episodes"], learn)
    found: list[dict[str, Any]] = []
    with as_bad_arguments(ValueError, FileNotFoundError):
        for seed in range(options["seeds"]):
            found.append(_finetune.measure(options["policy"], setting, options["grasps"], seed))
            rates = [found[-1][when]["grasp_success"]["value"] for when in _finetune.TIMES]
            print(f"seed {seed}: {rates[0]:.1%} -> {rates[1]:.1%}", file=sys.stderr, flush=True)
    gains = {name: _finetune.gain(found, name) for name in _finetune.SHOWN}
    seconds = time.perf_counter() - begun
    result = {"options": options, "gain": gains, "seeds": found, "seconds": seconds}
    print(json.dumps(result | provenance.record(), indent=2))
