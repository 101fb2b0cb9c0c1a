"""A trained policy at a real camera: an image in, actions out. It runs without MuJoCo.

    policy = CameraPolicy.load("shipped")
    decision, *others = policy.decide(rgb, depth, intrinsics, camera_pose, top=3)

The workspace is a level square of `heightmap.extent` m on the table, its centre the origin, z up.
docs/robot.md goes from an unboxed camera to the first grasp.
"""

import dataclasses
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from csac_jax import grippers
from csac_jax.agent.actor_critic import Params
from csac_jax.config import Config
from csac_jax.deploy import checks, decision, images
from csac_jax.deploy.checks import CameraReport
from csac_jax.deploy.decision import Decision
from csac_jax.deploy.images import CameraView
from csac_jax.errors import DataWarning, SettingsError
from csac_jax.io import made_for, policy_file
from csac_jax.runtime import cache, short
from csac_jax.section import require
from csac_jax.sim.outcome import BARE
from csac_jax.vision import depth_camera
from csac_jax.vision.heightmap import Observation

MOST_ALTERNATIVES = 64

_supported = jax.jit(depth_camera.supported)
_observe = jax.jit(decision.observe, static_argnums=0)
_batch_maps = jax.jit(decision.batch_maps, static_argnums=(0, 3))
_choose = jax.jit(jax.vmap(decision.choose, (None, 0, 0)), static_argnums=0)
_best_over_yaws = jax.jit(decision.best_over_yaws, static_argnums=0)


class Maps(NamedTuple):
    """The maps that decisions follow from. P = primitives."""

    height: np.ndarray  # [H, W] m, the view from above
    q: np.ndarray  # [P, H, W] best over yaws; -inf where there is nothing to act on


@dataclasses.dataclass(frozen=True, eq=False)
class CameraPolicy:
    """A policy's networks and config, and the pose of its workspace."""

    cfg: Config
    params: Params
    workspace_pose: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(4))  # to robot

    __repr__ = short.text

    @classmethod
    def load(
        cls, source: str | Path = "shipped", workspace_pose: Any = None, gripper: str | None = None
    ) -> "CameraPolicy":
        """Loads a shipped policy, a policy file, or a run's folder, which needs MuJoCo.

        Args: workspace_pose, 4 x 4, workspace to robot frame; the identity by default. gripper, the
        robot's, by name or folder; by default the policy's, of `shipped` the RG2. Another one is a
        warning, except for a policy that knows any; one whose own varies needs it to decide.
        Raises FileNotFoundError, PolicyFileError, CheckpointError or SettingsError.
        """
        path = policy_file.find(source)
        pose = np.eye(4) if workspace_pose is None else images.rigid(workspace_pose, "workspace")
        cfg, params = policy_file.load(path) if path.is_file() else _load_run(path)
        named = (cfg.sim.gripper,) if gripper is None else (gripper, "gripper")
        chosen = grippers.resolve(*named)
        here = cfg.change(sim={"gripper": chosen})
        made_for.warn_if_elsewhere(cfg, here)
        return cls(here, jax.device_put(params), pose)

    def decide(
        self,
        rgb: Any,
        depth: Any,
        intrinsics: Any,
        camera_pose: Any,
        target_mask: Any = None,
        top: int = 1,
    ) -> list[Decision]:
        """Returns the `top` best actions, best first; fewer if there is less to act on.

        Args: rgb [h, w, 3] uint8; depth [h, w] float, m along the optical axis, 0 or NaN where
        it is missing; intrinsics, an `Intrinsics` or a dict of its fields, for both images;
        camera_pose 4 x 4, camera (x right, y down, z forward) to workspace; target_mask [h, w]
        bool, the object to get: a policy that was not trained with targets then only grasps, and
        only that object. Raises SettingsError for arrays of a wrong form, ViewError for an
        image that does not fit the pose. Warns (DataWarning) if colours seem to be BGR.
        """
        check_top(top)
        obs = self.observe(rgb, depth, intrinsics, camera_pose, target_mask)
        return self.decide_each([obs], [top], target_mask is not None)[0]

    def decide_each(
        self, observations: Sequence[Observation], tops: Sequence[int], only_target: bool
    ) -> list[list[Decision]]:
        """Decides about several views at once, each as `decide` with its `top`.

        Args: observations, those of `inspect`; only_target, True if their images have masks.
        """
        cache.enable()
        obs = _stack(observations)
        state = _batch_maps(self.cfg, self.params, obs, only_target)
        decisions: list[list[Decision]] = [[] for _ in observations]
        for number in range(max(tops)):
            batch, state = _choose(self.cfg, state, obs.height)
            batch = jax.device_get(batch)
            for i in np.flatnonzero(batch.valid & (number < np.array(tops))):
                choice = jax.tree.map(lambda leaf, i=i: leaf[i], batch)
                decisions[i].append(decision.from_choice(choice, self.workspace_pose))
            if not batch.valid.any():
                break
        return decisions

    def maps(
        self, rgb: Any, depth: Any, intrinsics: Any, camera_pose: Any, target_mask: Any = None
    ) -> Maps:
        """Returns the maps that decisions about this image follow from."""
        cache.enable()
        obs = self.observe(rgb, depth, intrinsics, camera_pose, target_mask)
        state = _batch_maps(self.cfg, self.params, _stack([obs]), target_mask is not None)
        q = _best_over_yaws(self.cfg, jax.tree.map(lambda leaf: leaf[0], state))
        return Maps(np.asarray(obs.height), np.asarray(q))

    def observe(
        self, rgb: Any, depth: Any, intrinsics: Any, camera_pose: Any, target_mask: Any = None
    ) -> Observation:
        """Returns the view from above that decisions about this image follow from."""
        obs, doubts = self.inspect(rgb, depth, intrinsics, camera_pose, target_mask)
        for doubt in doubts:
            warnings.warn(doubt, DataWarning, stacklevel=3)
        return obs

    def inspect(
        self, rgb: Any, depth: Any, intrinsics: Any, camera_pose: Any, target_mask: Any = None
    ) -> tuple[Observation, list[str]]:
        """Returns the view from above, and what is doubtful about the image, one line each."""
        view = images.make(rgb, depth, intrinsics, camera_pose, target_mask)
        if view.target is None and self.cfg.task.kind == "target":
            raise SettingsError("target_mask: this policy gets a marked object; mark one")
        doubts = checks.fits(view, self.cfg.heightmap)
        return _observe(self.cfg, *_pixels(view)), doubts

    def check(self, rgb: Any, depth: Any, intrinsics: Any, camera_pose: Any) -> CameraReport:
        """Measures the camera by an image of the empty table.

        Raises as `decide`, but a table away from z = 0 is measured.
        """
        view, extent = images.make(rgb, depth, intrinsics, camera_pose), self.cfg.heightmap.extent
        checks.pose(view)
        checks.depth_unit(view, extent)
        table = checks.table(view, extent)
        height = np.asarray(_observe(self.cfg, *_pixels(view)).height)
        seen = checks.seen(view, self.cfg.heightmap)[1].mean()
        covered = np.sum(height > BARE) * 1e4 * self.cfg.heightmap.cell**2
        return CameraReport(**vars(table), seen=float(seen), covered_cm2=float(covered))

    def warm_up(self, width: int, height: int, batches: Sequence[int] = (1,)) -> None:
        """Compiles decisions about images of this size, px, and about batches of these sizes."""
        n = width * height
        pixels = np.zeros((n, 3), np.float32), np.zeros(n, bool), np.zeros((n, 3), np.uint8)
        target = np.zeros(n, bool) if self.cfg.task.kind == "target" else None
        cache.enable()
        obs = _observe(self.cfg, *pixels, target)
        _supported(np.zeros((height, width), np.float32), 1.0)
        for size in batches:
            self.decide_each([obs] * size, [1] * size, target is not None)


def check_top(top: int) -> None:
    """Raises SettingsError for a number of decisions that none can be asked for."""
    require(1 <= top <= MOST_ALTERNATIVES, f"top: must lie in 1 .. {MOST_ALTERNATIVES}, not {top}")


def _stack(observations: Sequence[Observation]) -> Observation:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *observations)


def _pixels(view: CameraView) -> tuple[Any, ...]:
    """Returns points, validity without flying pixels at edges, colours and target flags."""
    target = None if view.target is None else view.target.reshape(-1)
    valid = _supported(view.depth, view.intrinsics.fx).reshape(-1)
    return jax.device_put((view.points.reshape(-1, 3), valid, view.colour.reshape(-1, 3), target))


def _load_run(path: Path) -> tuple[Config, Params]:
    try:
        from csac_jax.evaluation import policies
    except ModuleNotFoundError as error:
        raise SettingsError(
            f"{path} is a run's folder, which needs {error.name}; where that is installed, run: "
            f"csac-jax export {path} policy.safetensors"
        ) from None
    policy = policies.load(path)
    assert isinstance(policy, policies.NetworkPolicy)
    return policy.cfg, policy.params
