"""A script: an image of two blocks by MuJoCo's renderer; OpenGL is chosen before the import."""

import sys
from typing import Any

import numpy as np

from csac_jax import presets
from csac_jax.config import CameraConfig, Config
from csac_jax.render import gl
from tests.sections import scaled

CFG = Config().change(sim={"physics": "c", "robot": "ur5"}, scene=presets.smoke().scene)
EYE = scaled(CameraConfig(), 0.5)


def scene() -> Any:
    """A cube and, half under it, a prism; leaves NumPy."""
    from csac_jax.world import scene_state

    empty = scene_state.parked(CFG.scene.slots)
    kinds = CFG.scene.slots.index("box"), CFG.scene.slots.index("prism")
    empty.position[kinds, :] = [[0.05, 0.06, 0.04], [-0.08, -0.05, 0.0243]]
    empty.quaternion[kinds, :] = [[0.9, 0.1, 0.3, 0.3], [0.9, 0.0, 0.0, 0.435]]
    empty.quaternion[kinds, :] /= np.linalg.norm(empty.quaternion[kinds, :], axis=1)[:, None]
    in_play = np.isin(np.arange(len(empty.in_play)), kinds)
    return empty.replace(in_play=in_play)


def eye() -> Any:
    """A camera whose axis is not in the middle, with pixels that are not square."""
    from csac_jax.vision import camera

    made = camera.make(EYE)
    return made.replace(focal=made.focal * np.float32([1.1, 0.9]), centre=made.centre + 12.0)


def main(out_path: str) -> None:
    """Writes colour and depth; exits with 3 where there is no OpenGL."""
    if gl.choose() is None:
        sys.exit(3)
    from csac_jax.world import model
    from experiments.bench._rgbd import RgbdRenderer

    studio = RgbdRenderer(model.build(CFG.scene, CFG.sim), scene(), EYE.size)
    colour, depth = studio.image(scene(), eye())
    studio.close()
    np.savez(out_path, colour=colour, depth=depth)


if __name__ == "__main__":
    main(*sys.argv[1:])
