"""Draws the pictures of README and docs into docs/pictures: `python -m experiments.pictures`.

`python -m experiments.pictures freeing` draws one of them alone.
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from csac_jax.render import gl

OPENGL = gl.choose()  # before MuJoCo is imported

import jax  # noqa: E402
import mujoco  # noqa: E402
import numpy as np  # noqa: E402
from PIL import Image  # noqa: E402

from csac_jax.config import SceneConfig, SimConfig  # noqa: E402
from csac_jax.env import Env  # noqa: E402
from csac_jax.evaluation import policies, rollout, suites  # noqa: E402
from csac_jax.render import episode, media, picture  # noqa: E402
from csac_jax.render.picture import Viewpoint  # noqa: E402
from csac_jax.runtime import cache  # noqa: E402
from csac_jax.scenes import cases  # noqa: E402
from csac_jax.world import blocks, model  # noqa: E402

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "pictures"
SIZE = (960, 720)  # px
FINER = 2  # pixels drawn per pixel of a still, along each axis: gaps of 1 mm are seen
TOWARDS = np.array([-0.36, -0.7, 0.95])  # from what is shown to the camera
ABOVE = 5.0  # m, where the hand is out of sight
BLOCK = (-0.045, 0.045)  # m, about half of a long block, and a margin

FREEING = 8  # seed of an episode of `enclosed`
ARM = Viewpoint(position=(-0.42, -0.60, 0.48), look_at=(0.05, -0.02, 0.19), size=(720, 480))
BLUE, YELLOW = map(blocks.COLOUR_NAMES.index, ("blue", "yellow"))  # of the others, of the target
BETWEEN = 12  # pictures between two actions

MOVING = (640, 480)  # px, of the scene in the animation
PINWHEEL, PILE = 0, 0  # seeds of its two episodes
FRAME_MS = 80  # of the animation
END_MS = 900  # of an action's last picture, in which its outcome is read


def main(chosen: list[str]) -> None:
    """Draws the chosen pictures, or all."""
    cache.enable()
    animations = {"freeing": freeing, "clearing": clearing}
    for name in chosen or (*cases.names(), *animations):
        if name in animations:
            write_animation(FOLDER / f"{name}.webp", list(animations[name]()))
        else:
            media.write_picture(FOLDER / f"{name}.png", still(name))


def still(name: str) -> np.ndarray:
    """Draws a shipped case without the robot [H, W, 3] uint8, as large as fits."""
    case = cases.load(cases.shipped(name))
    scene = SceneConfig(slots=case.slots, min_blocks=len(case.slots))
    world = model.build(scene, SimConfig())
    fields = jax.device_get(model.scene_fields(world, case.scene))
    shown = picture.coloured(world, fields, case.scene)
    draw = picture.renderer(shown, close_view(case.scene.position), OPENGL)
    data = mujoco.MjData(shown)
    poses = np.concatenate([case.scene.position, case.scene.quaternion], axis=1)
    data.qpos[world.block_qpos], data.qpos[world.robot_qpos[2]] = poses, ABOVE
    mujoco.mj_kinematics(shown, data)
    mujoco.mj_camlight(shown, data)
    return _smaller(draw(data))


def close_view(positions: np.ndarray) -> Viewpoint:
    """Returns the view that blocks at `positions` [N, 3] m fill."""
    middle = 0.5 * (positions.min(axis=0) + positions.max(axis=0))
    corners = np.stack(np.meshgrid(*(BLOCK,) * 3), axis=-1).reshape(-1, 3)
    offsets = (positions[:, None] - middle + corners).reshape(-1, 3)
    back = TOWARDS / np.linalg.norm(TOWARDS)
    right = np.cross([0.0, 0.0, 1.0], back) / np.hypot(*back[:2])
    tangent = np.tan(np.radians(0.5 * picture.FOVY))
    sides = {tangent: np.cross(back, right), tangent * SIZE[0] / SIZE[1]: right}
    needed = [np.abs(offsets @ axis) / tangent + offsets @ back for tangent, axis in sides.items()]
    size = (FINER * SIZE[0], FINER * SIZE[1])
    return Viewpoint(tuple(middle + np.max(needed) * back), tuple(middle), size)


def _smaller(image: np.ndarray) -> np.ndarray:
    height, width, _ = image.shape
    parts = image.reshape(height // FINER, FINER, width // FINER, FINER, 3)
    return np.round(parts.mean(axis=(1, 3))).astype(np.uint8)


def freeing() -> Iterator[tuple[np.ndarray, int]]:
    """Yields pictures and times, ms: an arm pushes blocks apart and takes the yellow one."""
    policy = policies.make("learned+planner", "shipped")
    cfg = suites.standard(policy.cfg, "enclosed")
    prepared = suites.prepare(cfg, "enclosed", 1, FREEING, "c", "ur5e")
    (env,) = prepared.parts.values()
    steps = list(rollout.episode(env, policies.in_world(policy, env.cfg), FREEING))
    print("enclosed", episode.summary(env, steps))
    first, scene = steps[0].before, steps[0].before.scene
    wanted = np.arange(len(scene.colour)) == scene.target
    marked = first.replace(scene=scene.replace(colour=np.where(wanted, YELLOW, BLUE)))
    stage = episode.EpisodeRenderer(env.cfg, marked, ARM.size, OPENGL, False, ARM)
    motions = [stage.poses(step) for step in steps]
    for poses, following in zip(motions, [*motions[1:], None], strict=True):
        yield stage.draw(poses[0]), END_MS
        yield from ((stage.draw(pose), FRAME_MS) for pose in poses[1:-1])
        yield stage.draw(poses[-1]), END_MS
        if following is not None:
            moves = np.linspace(poses[-1], following[0], BETWEEN + 2)[1:-1]
            yield from ((stage.draw(pose), FRAME_MS) for pose in moves)


def clearing() -> Iterator[tuple[np.ndarray, int]]:
    """Yields pictures and times, ms: the pinwheel, then the pile."""
    yield from pinwheel()
    yield from pile()


def pinwheel() -> Iterator[tuple[np.ndarray, int]]:
    """Yields pictures and times, ms: `shipped` takes the pinwheel apart."""
    return in_motion("shipped", str(cases.shipped("pinwheel")), PINWHEEL, every=2)


def pile() -> Iterator[tuple[np.ndarray, int]]:
    """Yields pictures and times, ms: `shipped_clutter` clears thirty blocks."""
    return in_motion("shipped_clutter", "random30", PILE, every=4, hold=3 * FRAME_MS)


def in_motion(
    source: str, suite: str, seed: int, every: int, hold: int = END_MS
) -> Iterator[tuple[np.ndarray, int]]:
    """Yields pictures [H, W, 3] uint8 of an episode and times, ms; `hold` for a motion's end."""
    policy = policies.load(source)
    cfg = suites.standard(policy.cfg, suite).change(task={"kind": "clear"})
    prepared = suites.prepare(cfg, suite, 1, seed, "c")
    (env,) = prepared.parts.values()
    steps = list(rollout.episode(env, policies.in_world(policy, env.cfg), seed))
    print(suite, episode.summary(env, steps))
    yield from _pictures(env, steps, every, hold)


def _pictures(env: Env, steps: list[Any], every: int, hold: int) -> Iterator[Any]:
    stage = episode.EpisodeRenderer(env.cfg, steps[0].before, MOVING, OPENGL, views=True)
    for number, step in enumerate(steps, 1):
        frames = list(stage.motion(step, episode.line(number, step)))
        yield from ((frame, FRAME_MS) for frame in frames[: -episode.HOLD : every])
        yield frames[-1], hold


def write_animation(path: Path, pictures: list[tuple[np.ndarray, int]]) -> None:
    """Writes an animated WebP of pictures [H, W, 3] uint8 and their times, ms."""
    first, *others = [Image.fromarray(image) for image, _ in pictures]
    durations = [duration for _, duration in pictures]
    first.save(
        path, save_all=True, append_images=others, duration=durations, loop=0, quality=70, method=4
    )


if __name__ == "__main__":
    main(sys.argv[1:])
