"""One episode to look at: a line per action, a picture, a video."""

from collections.abc import Iterator
from pathlib import Path

import jax
import mujoco
import numpy as np

from csac_jax.config import Config, RobotKind
from csac_jax.constants import Outcome, Primitive
from csac_jax.env import State
from csac_jax.evaluation.rollout import Moment
from csac_jax.render import media, panels, picture
from csac_jax.render.picture import View
from csac_jax.scene import blocks, layout, model
from csac_jax.sim import c_physics

VIEWS: dict[RobotKind, View] = {
    "hand": View(position=(-0.45, -0.45, 0.45), look_at=(0.0, 0.0, 0.04)),
    "ur5": View(position=(-0.75, -1.05, 0.75), look_at=(0.15, 0.0, 0.25)),
}


class Stage:
    """The model of an episode's scene, coloured, and what draws it."""

    def __init__(
        self,
        cfg: Config,
        first: State,
        size: tuple[int, int],
        opengl: str | None,
        views: bool = False,
    ) -> None:
        self._cfg, self._height = cfg, size[1]
        self._views = views  # whether panels show what the policy saw
        self._world = model.build(cfg.scene, cfg.sim)
        self._fields = jax.device_get(model.scene_fields(self._world, first.scene))
        self._model = model.with_blocks(self._world, self._fields)
        colours = blocks.COLOURS[first.scene.colour[self._world.parts.slot]]
        self._model.geom_rgba[self._world.block_geoms, :3] = colours
        self._data = mujoco.MjData(self._model)
        self._every = max(round(1.0 / (media.FRAMES_PER_SECOND * cfg.sim.timestep)), 1)
        seen = VIEWS[cfg.sim.robot]
        self._draw = picture.renderer(self._model, View(seen.position, seen.look_at, size), opengl)

    def still(self, moment: Moment, text: str = "") -> np.ndarray:
        """The scene before an action, the robot where that action starts: [H, W, 3] uint8."""
        return self._frame(moment)(self._still(moment), text)

    def _still(self, moment: Moment) -> np.ndarray:
        scene, pose = moment.before.scene, self._data.qpos
        pose[self._world.robot_qpos] = moment.drive.start
        pose[self._world.block_qpos] = np.concatenate([scene.position, scene.quaternion], axis=1)
        return self._picture()

    def motion(self, moment: Moment, text: str = "") -> Iterator[np.ndarray]:
        """The action as it runs in C MuJoCo; a still picture where the robot cannot follow the
        plan.

        With views, `text` below it: what is done at first; for HOLD pictures more at the end, what
        came of it too.
        """
        shown, frame, begun = self._still(moment), self._frame(moment), text.split(":")[0]
        yield frame(shown, begun)
        film = c_physics.film(self._world, self._fields, moment.before.scene, moment.drive)
        for pose in film.qpos[:: self._every]:
            self._data.qpos[:] = pose
            shown = self._picture()
            yield frame(shown, begun)
        yield from [frame(shown, text)] * (HOLD if self._views else 0)

    def _frame(self, moment: Moment) -> panels.Frame:
        if self._views:
            return panels.frame(self._cfg, moment, self._height)
        return lambda scene, text: scene

    def _picture(self) -> np.ndarray:
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        return self._draw(self._data)


HOLD = 20  # pictures that an action's outcome is shown for


def line(number: int, moment: Moment) -> str:
    """What an action did, in words."""
    before, after, info = moment.before, moment.after, moment.after.info
    x, y, yaw = moment.action.pose
    where = f"at x {1e3 * x:+.0f} y {1e3 * y:+.0f} mm, yaw {np.degrees(yaw):.0f} deg"
    if moment.action.primitive == Primitive.PUSH:
        done = f"push  {where}: moved {info.moved:.0f} cm2"
    else:
        done = f"grasp {where}: {Outcome(int(info.outcome)).name.lower()}"
    if not moment.drive.reachable:
        done += ", out of the robot's reach"
    gone = np.flatnonzero(before.scene.in_play & ~after.scene.in_play)
    names = [blocks.COLOUR_NAMES[before.scene.colour[slot]] for slot in gone]
    if info.cleared:
        done += f" ({', '.join(names)})"
    lost = f", {info.blocks_lost} left the square" if info.blocks_lost else ""
    physics_diverged = ", physics failed" if info.physics_diverged else ""
    worth = f"reward {float(moment.reward):+.2f}"
    return f"{number:3d} {done}{lost}{physics_diverged}; {worth}; {int(after.scene.in_play.sum())} blocks left"


def summary(moments: list[Moment]) -> str:
    """How the episode ended."""
    last = moments[-1].after
    taken = sum(int(moment.after.info.cleared) for moment in moments)
    if last.terminated:
        how = "the target is taken" if last.scene.target != layout.ANY else "the table is clear"
    else:
        how = "physics failed" if last.info.physics_diverged else "cut off"
    return f"{how} after {len(moments)} actions, {taken} blocks taken"


def record(stage: Stage, moments: list[Moment], png: Path | None, video: Path | None) -> None:
    """Writes the picture of the first moment, and the video of them all."""
    lines = [line(number, moment) for number, moment in enumerate(moments, 1)]
    if png is not None:
        media.write_picture(png, stage.still(moments[0], lines[0]))
    if video is not None:
        told = zip(moments, lines, strict=True)
        media.write_video(
            video, (frame for moment, text in told for frame in stage.motion(moment, text))
        )
