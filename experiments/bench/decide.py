"""Times decisions of the policies that ship, as JSON: `csac-jax bench decide [--repeats N]`.

The image is that of examples/08_camera_image.py, 640 x 480 px. Each policy decides by one look, and
by the mean over four mirror images (`policy.augment`), in turn, REPEATS (30) times: given the
image, or the view from above that follows from it. The least time is that of a machine on which
nothing else runs; the median has what else ran.
"""

import dataclasses
import functools
import importlib
import statistics
import tempfile
from pathlib import Path
from typing import Any

import jax

from csac_jax.deploy import CameraPolicy, image_files
from csac_jax.io import policy_file
from csac_jax.runtime import processes
from experiments.bench._options import timed
from experiments.bench._timing import seconds

camera_image = importlib.import_module("examples.08_camera_image")
LOOKS = {"one look": False, "four looks": True}


def image() -> tuple[Any, ...]:
    """Draws the image of a camera: colour, depth, intrinsics and pose."""
    with tempfile.TemporaryDirectory() as folder:
        camera_image.main(folder)
        names = ("rgb.png", "depth.png", "intrinsics.json", "pose.json")
        return image_files.read_image(*(Path(folder, name) for name in names))


def measure(repeats: int) -> dict[str, Any]:
    """Measures each policy, with one look and with four."""
    seen, calls = image(), {}
    for name in policy_file.SHIPPED:
        loaded = CameraPolicy.load(name)
        for looks, augment in LOOKS.items():
            policy = dataclasses.replace(loaded, cfg=loaded.cfg.change(policy={"augment": augment}))
            view = jax.device_get(policy.observe(*seen))
            calls[name, looks, "image"] = functools.partial(policy.decide, *seen)
            decide = functools.partial(policy.decide_each, [view], [1], only_target=False)
            calls[name, looks, "view"] = decide
    rows = []
    for key, times in seconds(calls, repeats).items():
        named = dict(zip(("policy", "looks", "given"), key, strict=True))
        rows.append(
            named | {"least_ms": 1e3 * min(times), "median_ms": 1e3 * statistics.median(times)}
        )
    return {"cores": processes.cores(), "rows": rows}


def main(arguments: list[str]) -> None:
    """Prints the result."""
    timed("decide", arguments, measure, repeats=30)
