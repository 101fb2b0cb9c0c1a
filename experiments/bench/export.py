"""Size and speed of exported policies, as JSON: `csac-jax bench export [--repeats N]`.

The shipped policy decides on 20 images of blocks, drawn by examples/camera_image.py: by
`CameraPolicy.decide`, and by the exported files. Beside the times: the largest difference of a Q
(ONNX) and of any number of a decision (StableHLO) from the policy's own.
"""

import contextlib
import sys
import tempfile
from pathlib import Path
from typing import Any

import jax
import numpy as np
import onnxruntime
from jax import export as jax_export

from csac_jax import cli
from csac_jax.config import CameraConfig
from csac_jax.deploy import CameraPolicy, decision_program, images, stablehlo
from csac_jax.vision import camera
from examples import camera_image
from experiments.bench._options import timed
from experiments.bench._timing import medians

IMAGES = 20
FORMATS = {
    "maps.stablehlo": ("--format", "stablehlo"),
    "image.stablehlo": ("--format", "stablehlo", "--input", "image"),
    "policy.onnx": ("--format", "onnx"),
}


def _images() -> list[dict[str, np.ndarray]]:
    """Arguments of the exported function of an image."""
    cfg, pose = CameraConfig(), np.eye(4, dtype=np.float32)
    eye = camera.make(cfg)
    pose[:3, :3], pose[:3, 3] = eye.rotation, eye.position
    lens = np.float32([*cfg.focal, *cfg.centre])
    drawn = [camera_image.draw(cfg, 0.01 * number - 0.1) for number in range(IMAGES)]
    return [
        {"rgb": rgb, "depth": np.float32(1e-3) * depth, "lens": lens, "pose": pose}
        for rgb, depth in drawn
    ]


def _largest(found: Any, wanted: Any) -> float:
    pairs = zip(found, wanted, strict=False)
    return max(float(np.abs(np.asarray(a, float) - np.asarray(b, float)).max()) for a, b in pairs)


def measure(repeats: int) -> dict[str, Any]:
    """All of it."""
    policy, given, sizes = CameraPolicy.load("shipped"), _images(), {}
    with tempfile.TemporaryDirectory() as folder:
        content = {}
        for name, options in FORMATS.items():
            with contextlib.redirect_stdout(sys.stderr):
                cli.main(["export", "shipped", f"{folder}/{name}", *options])
            content[name] = Path(folder, name).read_bytes()
            sizes[name] = len(content[name])
    by_maps, by_image = (
        jax.jit(jax_export.deserialize(bytearray(content[name])).call)
        for name in ("maps.stablehlo", "image.stablehlo")
    )
    session = onnxruntime.InferenceSession(content["policy.onnx"])
    own = jax.jit(stablehlo.from_image(policy.cfg, policy.params, CameraConfig().size)[0])
    points = jax.jit(stablehlo._points)
    observe = jax.jit(lambda *pixels: decision_program.observe(policy.cfg, *pixels, None))
    look = jax.jit(lambda obs: decision_program.dense_maps(policy.cfg, policy.params, obs, False))
    own_by_maps = jax.jit(stablehlo.from_maps(policy.cfg, policy.params)[0])
    worst = dict.fromkeys(FORMATS, 0.0)
    for one in given:
        place = points(one["depth"], one["lens"], one["pose"]).reshape(-1, 3)
        flat = one["depth"].reshape(-1) > 0, one["rgb"].reshape(-1, 3)
        obs = jax.device_get(observe(place, *flat))
        maps = {"colour": obs.colour, "height": obs.height}
        found = {
            "maps.stablehlo": _largest(by_maps(*maps.values()), own_by_maps(*maps.values())),
            "image.stablehlo": _largest(by_image(*one.values()), own(*one.values())),
            "policy.onnx": _largest(session.run(["q"], maps), [look(obs).q]),
        }
        worst = {name: max(worst[name], found[name]) for name in FORMATS}
    lens = dict(zip(("fx", "fy", "cx", "cy"), map(float, one["lens"]), strict=True))
    intrinsics = images.Intrinsics(*CameraConfig().size, **lens)
    calls = {
        "Policy.decide": lambda: policy.decide(one["rgb"], one["depth"], intrinsics, one["pose"]),
        "maps.stablehlo": lambda: by_maps(*maps.values()),
        "image.stablehlo": lambda: by_image(*one.values()),
        "policy.onnx": lambda: session.run(None, maps),
    }
    seconds = medians(calls, repeats)
    times = {name: 1e3 * value for name, value in seconds.items()}
    return {"bytes": sizes, "largest_difference": worst, "ms": times}


def main(arguments: list[str]) -> None:
    """Prints the result."""
    timed("export", arguments, measure, repeats=50)
