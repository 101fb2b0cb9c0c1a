"""A script: depth images by MuJoCo's renderer; the display is chosen on import."""

import sys

import mujoco
import numpy as np


def main(model_path: str, pose_path: str, out_path: str) -> None:
    """Reads model, qpos, pose [3, 3] (position, forward, up), focal, size; writes [H, W] m."""
    model, given = mujoco.MjModel.from_binary_path(model_path), np.load(pose_path)
    width, height = map(int, given["size"])
    model.vis.global_.fovy = np.degrees(2.0 * np.arctan(0.5 * height / given["focal"]))
    model.vis.map.znear, model.vis.map.zfar = 0.05 / model.stat.extent, 20.0 / model.stat.extent
    data = mujoco.MjData(model)
    data.qpos[:] = given["qpos"]
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, height, width) as renderer:
        renderer.update_scene(data)
        for eye in renderer.scene.camera:
            eye.pos[:], eye.forward[:], eye.up[:] = given["pose"]
        renderer.enable_depth_rendering()
        np.save(out_path, renderer.render())


if __name__ == "__main__":
    main(*sys.argv[1:])
