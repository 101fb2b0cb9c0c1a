"""Takes one image with an Intel RealSense, as files that `csac-jax act` reads.

    python examples/09_realsense.py shot    # rgb.png, depth.npy, intrinsics.json in `shot`

Needs: pip install pyrealsense2. It was tested with a fake camera, never with a real one.
"""

import importlib
import json
import sys
from pathlib import Path

import imageio.v2 as imageio
import numpy as np

SIZE, RATE = (640, 480), 30  # px, images per second
SETTLE = 30  # images until the exposure stands


def main(folder: str) -> None:
    """Writes colours, depth in m aligned to them, and the lens."""
    rs, out = importlib.import_module("pyrealsense2"), Path(folder)
    config, pipeline = rs.config(), rs.pipeline()
    config.enable_stream(rs.stream.color, *SIZE, rs.format.rgb8, RATE)
    config.enable_stream(rs.stream.depth, *SIZE, rs.format.z16, RATE)
    device = pipeline.start(config).get_device()
    scale = device.first_depth_sensor().get_depth_scale()  # m per count
    align = rs.align(rs.stream.color)
    for _ in range(SETTLE):
        frames = align.process(pipeline.wait_for_frames())
    colour, depth = frames.get_color_frame(), np.asarray(frames.get_depth_frame().get_data())
    lens = colour.profile.as_video_stream_profile().intrinsics
    intrinsics = {"width": lens.width, "height": lens.height, "fx": lens.fx, "fy": lens.fy}
    intrinsics |= {"cx": lens.ppx, "cy": lens.ppy, "distortion": list(lens.coeffs)}
    out.mkdir(parents=True, exist_ok=True)
    imageio.imwrite(out / "rgb.png", np.asarray(colour.get_data()))
    np.save(out / "depth.npy", (depth * scale).astype(np.float32))
    (out / "intrinsics.json").write_text(json.dumps(intrinsics))
    pipeline.stop()


if __name__ == "__main__":
    if sys.argv[1:] in ([], ["-h"], ["--help"]):
        print(__doc__)
        sys.exit(not sys.argv[1:])
    main(*sys.argv[1:])
