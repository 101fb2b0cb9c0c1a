"""What a policy saw and chose, drawn beside the scene: height map, Q maps, the search's candidates,
the action."""

import numpy as np

from csac_jax.config import Config
from csac_jax.constants import Primitive
from csac_jax.evaluation.rollout import StepRecord
from csac_jax.render import canvas
from csac_jax.scene.model import MAX_OPENING

CLOUDS = {Primitive.PUSH: (90, 200, 250), Primitive.GRASP: (255, 120, 220)}
CHOSEN = (255, 60, 40)
TITLE = (255, 255, 255)
TALLEST = 0.12  # m; higher surfaces are drawn as high as that
TEXT_LINES = 2


def beside(cfg: Config, scene: np.ndarray, step: StepRecord, text: str) -> np.ndarray:
    """The picture of a scene [H, W, 3] with the views of a step to its right, H px wide, and a
    line of text below.

    A learned policy: Q of pushes and of grasps, best over yaws, above; below them the height map
    with candidates and action, and what is what. Any other policy: the height map with its action.
    """
    height = scene.shape[0]
    if step.debug is None:
        views = _height_map(cfg, step, height)
    else:
        half = height // 2
        pushes, grasps = (_q_map(step, primitive, half) for primitive in Primitive)
        below = [_height_map(cfg, step, height - half), _legend(step, height - half, height - half)]
        views = np.concatenate(
            [
                np.concatenate([pushes, grasps], axis=1),
                _cut(np.concatenate(below, axis=1), 2 * half),
            ]
        )
    whole = np.concatenate([scene, views], axis=1)
    below_text = canvas.strip(text, whole.shape[1], TEXT_LINES, _scale(height))
    whole = np.concatenate([whole, below_text])
    return np.ascontiguousarray(
        np.pad(whole, [(0, side % 2) for side in whole.shape[:2]] + [(0, 0)])
    )  # videos want even sides


def _cut(image: np.ndarray, width: int) -> np.ndarray:
    """The picture in this width, cut or filled with black at its right."""
    return np.pad(image[:, :width], ((0, 0), (0, max(width - image.shape[1], 0)), (0, 0)))


def _scale(height: int) -> int:
    """Pixels per pixel of a letter."""
    return max(height // 240, 1)


def _upright(values: np.ndarray) -> np.ndarray:
    """A map [H, W, ...] with y upwards: its rows begin at the lowest y."""
    return values[::-1]


def _q_map(step: StepRecord, primitive: Primitive, side: int) -> np.ndarray:
    """Q of a primitive, both in the same colours."""
    debug = step.debug
    assert debug is not None
    every = np.asarray(debug.q)
    there = every[np.isfinite(every)]
    low, high = (there.min(), there.max()) if there.size else (0.0, 1.0)
    own = every[primitive][np.isfinite(every[primitive])]
    image = canvas.enlarge(canvas.colours(_upright(every[primitive]), low, high), side, side)
    best = f"BEST {own.max():+.2f}" if own.size else "NOWHERE"
    canvas.write(image, (2, 2), f"{primitive.name} VALUES, {best}", _scale(2 * side), TITLE)
    return image


def _height_map(cfg: Config, step: StepRecord, side: int) -> np.ndarray:
    """The height map in grey, candidates as dots, the action as a hand or an arrow."""
    shade = np.clip(np.asarray(step.before.obs.height) / TALLEST, 0.0, 1.0)
    grey = np.repeat((40 + 200 * shade).round().astype(np.uint8)[..., None], 3, axis=2)
    image = canvas.enlarge(_upright(grey), side, side)
    pose = np.asarray(step.action.pose, float)
    width = max(side / 160.0, 1.0)
    if step.debug is not None:
        for primitive in Primitive:
            xy = np.asarray(step.debug.candidates)[primitive, :, :2]
            canvas.dots(image, _pixels(cfg, xy, side), width, CLOUDS[primitive])
    _action(cfg, image, int(step.action.primitive), pose, side, 1.5 * width)
    return image


def _pixels(cfg: Config, xy: np.ndarray, side: int) -> np.ndarray:
    """Rows and columns [..., 2] of places [..., 2] m in a map of this side, y upwards."""
    share = np.asarray(xy) / cfg.heightmap.extent + 0.5
    return np.stack([1.0 - share[..., 1], share[..., 0]], axis=-1) * side - 0.5


def _action(
    cfg: Config, image: np.ndarray, primitive: int, pose: np.ndarray, side: int, width: float
) -> None:
    """A push as an arrow as long as it goes; a grasp as the open fingers and the line they close
    along."""
    centre, yaw = pose[:2], pose[2]
    along, across = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])

    def place(xy: np.ndarray) -> np.ndarray:
        return _pixels(cfg, xy, side)

    if primitive == Primitive.PUSH:
        canvas.arrow(
            image, place(centre), place(centre + cfg.sim.push_length * along), width, CHOSEN
        )
        return
    tips = [centre + sign * 0.5 * MAX_OPENING * along for sign in (-1.0, 1.0)]
    canvas.line(image, place(tips[0]), place(tips[1]), 0.5 * width, CHOSEN)
    for tip in tips:
        canvas.line(
            image, place(tip - 0.012 * across), place(tip + 0.012 * across), 2.0 * width, CHOSEN
        )


def _legend(step: StepRecord, height: int, width: int) -> np.ndarray:
    """What the colours mean and what the action is worth."""
    image, scale = np.zeros((height, width, 3), np.uint8), _scale(2 * height)
    debug = step.debug
    assert debug is not None
    lines = [
        ("HEIGHT MAP, FROM ABOVE", TITLE),
        ("CANDIDATES, PUSH", CLOUDS[Primitive.PUSH]),
        ("CANDIDATES, GRASP", CLOUDS[Primitive.GRASP]),
        ("CHOSEN", CHOSEN),
        (f"BEST GRASP {float(debug.best_grasp):+.2f}", TITLE),
    ]
    for number, (text, colour) in enumerate(lines):
        canvas.write(
            image, (3 + number * (canvas.LINE + 2) * scale, 2 * scale), text, scale, colour
        )
    return image
