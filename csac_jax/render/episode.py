"""One episode as text, picture, video or in a viewer."""

from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import mujoco
import numpy as np

from csac_jax.config import Config, RobotKind
from csac_jax.constants import Outcome, Primitive
from csac_jax.env import Env, State
from csac_jax.evaluation import metrics, rollout
from csac_jax.evaluation.rollout import StepRecord
from csac_jax.render import media, panels, picture, viewer
from csac_jax.render.picture import Viewpoint
from csac_jax.sim import c_physics
from csac_jax.world import blocks, model, scene_state
from csac_jax.world.scene_state import SceneState

VIEWS: dict[RobotKind, Viewpoint] = {
    "hand": Viewpoint(position=(-0.22, -0.5, 0.46), look_at=(0.0, -0.01, 0.05)),
    "ur5": Viewpoint(position=(-0.85, -1.25, 0.85), look_at=(0.19, 0.0, 0.33)),
    "ur5e": Viewpoint(position=(-0.85, -1.25, 0.85), look_at=(0.19, 0.0, 0.33)),
}
STOPPED = {
    "action_cap": "stopped at the action limit",
    "no_change_cap": "stopped since nothing changed any more",
    "physics_diverged": "stopped since physics diverged",
    "failed_grasps": "stopped after failed grasps in a row",
}
HOLD = 20  # pictures of an action's end


class EpisodeRenderer:
    """Renderer of an episode's scene, in colour."""

    def __init__(
        self,
        cfg: Config,
        first: State,
        size: tuple[int, int],
        opengl: str | None,
        views: bool,
        viewpoint: Viewpoint | None = None,
    ) -> None:
        self._cfg, self._height, self._views = cfg, size[1], views
        self._world = model.build(cfg.scene, cfg.sim)
        self._fields = jax.device_get(model.scene_fields(self._world, first.scene))
        self._model = picture.coloured(self._world, self._fields, first.scene)
        self._data = mujoco.MjData(self._model)
        self._viewpoint = (viewpoint or VIEWS[cfg.sim.robot])._replace(size=size)
        self._draw = picture.renderer(self._model, self._viewpoint, opengl)

    def still(self, step: StepRecord, text: str) -> np.ndarray:
        """Draws the scene before an action, the robot at its start: [H, W, 3] uint8."""
        return self._frame(step)(self._start(step), text)

    def motion(self, step: StepRecord, text: str) -> Iterator[np.ndarray]:
        """Draws the action as C MuJoCo runs it; with views, its end HOLD times more."""
        image, frame, action = self._start(step), self._frame(step), text.split(":")[0]
        yield frame(image, action)
        for pose in self.poses(step):
            image = self.draw(pose)
            yield frame(image, action)
        yield from [frame(image, text)] * (HOLD if self._views else 0)

    def poses(self, step: StepRecord) -> np.ndarray:
        """Simulates an action in C MuJoCo; returns qpos [T, ...], a row per picture."""
        recorded = c_physics.trajectory(self._world, self._fields, step.before.scene, step.joints)
        every = max(round(1.0 / (media.FRAMES_PER_SECOND * self._cfg.sim.timestep)), 1)
        return recorded.qpos[::every]

    def film(self, steps: list[StepRecord], seed: int) -> viewer.Film:
        """Simulates the steps of a seed for a viewer."""
        actions = [(line(number, step), self.poses(step)) for number, step in enumerate(steps, 1)]
        return viewer.Film(self._model, actions, seed)

    def show(self, film: viewer.Film, log: Callable[[str], None], another: viewer.Another) -> None:
        """Shows a film in a viewer, see `viewer.play`."""
        viewer.play(film, log, view=self._viewpoint, another=another)

    def _start(self, step: StepRecord) -> np.ndarray:
        scene, pose = step.before.scene, self._data.qpos.copy()
        pose[self._world.robot_qpos] = step.joints.start
        pose[self._world.block_qpos] = np.concatenate([scene.position, scene.quaternion], axis=1)
        return self.draw(pose)

    def _frame(self, step: StepRecord) -> panels.Frame:
        if self._views:
            return panels.frame(self._cfg, step, self._height)
        return lambda scene, text: scene

    def draw(self, pose: np.ndarray) -> np.ndarray:
        """Draws a pose, qpos [...]: [H, W, 3] uint8."""
        self._data.qpos[:] = pose
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        return self._draw(self._data)


def line(number: int, step: StepRecord) -> str:
    """Describes an action and its effect."""
    scene, after, info = step.before.scene, step.after, step.after.info
    x, y, yaw = step.action.pose
    where = f"at x {1e3 * x:+.0f} y {1e3 * y:+.0f} mm, yaw {np.degrees(yaw):.0f} deg"
    if step.action.primitive == Primitive.PUSH:
        text = f"push  {where}: moved {info.moved:.0f} cm2"
    else:
        text = f"grasp {where}: {Outcome(int(info.outcome)).name.lower()}"
    if not step.joints.reachable:
        text += ", out of the robot's reach"
    if info.cleared:
        gone = scene.colour[scene.in_play & ~after.scene.in_play]
        text += f" ({', '.join(blocks.COLOUR_NAMES[colour] for colour in gone)})"
    if info.blocks_lost:
        text += f", {_counted(int(info.blocks_lost), scene)} left the workspace"
    if info.physics_diverged:
        text += ", physics diverged"
    left = _counted(int(after.scene.in_play.sum()), scene)
    return f"{number:3d} {text}; reward {float(step.reward):+.2f}; {left} left"


def summary(env: Env, steps: list[StepRecord]) -> str:
    """Describes how the episode ended, and what became of the blocks."""
    last = steps[-1].after
    if not last.terminated:
        ending = STOPPED[metrics.ENDINGS[rollout.endings(env, last)]]
    elif last.scene.target != scene_state.ANY:
        ending = "the target is taken" if completed(steps) else "the target is lost"
    else:
        none = f"no {_noun(last.scene)} is left within reach"
        ending = "the table is clear" if completed(steps) else none
    actions = f"{len(steps)} action{'s' if len(steps) != 1 else ''}"
    taken, lost = totals(steps)
    fate = f", {_counted(lost, last.scene)} left the workspace" if lost else ""
    return f"{ending} after {actions}: {_counted(taken, last.scene)} taken{fate}"


def completed(steps: list[StepRecord]) -> bool:
    """Returns True if the hand took all wanted blocks."""
    last, (_, lost) = steps[-1].after, totals(steps)
    got = last.reward > 0 if last.scene.target != scene_state.ANY else lost == 0
    return bool(last.terminated and got)


def totals(steps: list[StepRecord]) -> tuple[int, int]:
    """Counts blocks taken from the table, and blocks that left the workspace."""
    infos = [step.after.info for step in steps]
    return sum(int(info.cleared) for info in infos), sum(int(info.blocks_lost) for info in infos)


def _noun(scene: SceneState) -> str:
    return "block" if scene.object_id is None else "object"


def _counted(count: int, scene: SceneState) -> str:
    return f"{count} {_noun(scene)}{'s' if count != 1 else ''}"


def record(
    renderer: EpisodeRenderer, steps: list[StepRecord], png: Path | None, video: Path | None
) -> None:
    """Writes the picture of the first step, and the video of all steps."""
    lines = [line(number, step) for number, step in enumerate(steps, 1)]
    if png is not None:
        media.write_picture(png, renderer.still(steps[0], lines[0]))
    if video is not None:
        motions = map(renderer.motion, steps, lines)
        media.write_video(video, (image for motion in motions for image in motion))
