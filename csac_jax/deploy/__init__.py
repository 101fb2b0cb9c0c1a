"""A trained policy at a real camera: an image in, actions out. It runs without MuJoCo.

    policy = Policy.load("shipped")
    decision, *others = policy.decide(rgb, depth, intrinsics, camera_pose, top=3)

The workspace is a level square of `heightmap.extent` m on the table, its centre the origin, z up.
docs/robot.md goes from an unboxed camera to the first grasp.
"""

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from csac_jax import grippers
from csac_jax.agent.actor_critic import Params
from csac_jax.agent.maps import DenseMaps
from csac_jax.config import Config
from csac_jax.deploy import checks, decision, images, program
from csac_jax.deploy.checks import Report
from csac_jax.deploy.decision import Decision
from csac_jax.deploy.images import View
from csac_jax.errors import SettingsError
from csac_jax.io import policy_file
from csac_jax.runtime import cache
from csac_jax.sim.outcome import BARE
from csac_jax.vision import depth_camera
from csac_jax.vision.heightmap import Observation

MOST_ALTERNATIVES = 64

_supported = jax.jit(depth_camera.supported)
_observe = jax.jit(program.observe, static_argnums=0)
_dense_maps = jax.jit(program.dense_maps, static_argnums=(0, 3))
_choose = jax.jit(program.choose, static_argnums=0)
_best_over_yaws = jax.jit(program.best_over_yaws, static_argnums=0)


class Maps(NamedTuple):
    """What decisions follow from. P = primitives."""

    height: np.ndarray  # [H, W] m, the view from above
    q: np.ndarray  # [P, H, W] best over yaws; -inf where there is nothing to act on


@dataclasses.dataclass(frozen=True, eq=False)
class Policy:
    """A policy's networks and config, and where its workspace is."""

    cfg: Config
    params: Params
    workspace_pose: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(4))  # to robot

    @classmethod
    def load(
        cls, source: str | Path = "shipped", workspace_pose: Any = None, gripper: str | None = None
    ) -> "Policy":
        """The policy `shipped`, of a policy file, or of a run's folder, which needs MuJoCo.

        Args: workspace_pose, 4 x 4, workspace to robot frame; the identity by default. gripper, the
        robot's, by name or folder; by default the one that the policy was trained with. One for
        any gripper needs to know it before it decides.
        Raises FileNotFoundError, PolicyFileError, CheckpointError or SettingsError.
        """
        path = policy_file.find(source)
        pose = np.eye(4) if workspace_pose is None else images.rigid(workspace_pose, "workspace")
        cfg, params = policy_file.load(path) if path.is_file() else _of_run(path)
        known = grippers.resolve(cfg.sim.gripper if gripper is None else gripper)
        cfg = cfg.change(sim={"gripper": known})
        return cls(cfg, jax.device_put(params), pose)

    def decide(
        self,
        rgb: Any,
        depth: Any,
        intrinsics: Any,
        camera_pose: Any,
        target_mask: Any = None,
        top: int = 1,
    ) -> list[Decision]:
        """The `top` best actions, best first; fewer or none where there is nothing to act on.

        Args: rgb [h, w, 3] uint8; depth [h, w] float, m along the optical axis, 0 or NaN where
        there is none; intrinsics, an `Intrinsics` or a dict of its fields, for both images;
        camera_pose 4 x 4, camera (x right, y down, z forward) to workspace; target_mask [h, w]
        bool, the object to get. Raises SettingsError for arrays of a wrong form, ViewError for an
        image that does not fit the pose. Warns (DataWarning) of colours that seem to be BGR.
        """
        if not 1 <= top <= MOST_ALTERNATIVES:
            raise SettingsError(f"top: must lie in 1 .. {MOST_ALTERNATIVES}, not {top}")
        obs, state = self._see(rgb, depth, intrinsics, camera_pose, target_mask)
        decisions: list[Decision] = []
        for _ in range(top):
            choice, state = _choose(self.cfg, state, obs.height)
            if not choice.valid:
                break
            decisions.append(decision.of(jax.device_get(choice), self.workspace_pose))
        return decisions

    def maps(
        self, rgb: Any, depth: Any, intrinsics: Any, camera_pose: Any, target_mask: Any = None
    ) -> Maps:
        """The maps that the decisions about the same image follow from."""
        obs, state = self._see(rgb, depth, intrinsics, camera_pose, target_mask)
        return Maps(np.asarray(obs.height), np.asarray(_best_over_yaws(self.cfg, state)))

    def observe(
        self, rgb: Any, depth: Any, intrinsics: Any, camera_pose: Any, target_mask: Any = None
    ) -> Observation:
        """The view from above that decisions about the same image follow from."""
        view = self._checked_view(rgb, depth, intrinsics, camera_pose, target_mask)
        return _observe(self.cfg, *_pixels(view))

    def check(self, rgb: Any, depth: Any, intrinsics: Any, camera_pose: Any) -> Report:
        """What one image of the empty table says of the camera. Raises as `decide`, but measures a
        table that is not at z = 0."""
        view = images.make(rgb, depth, intrinsics, camera_pose)
        checks.pose(view)
        checks.depth_unit(view, self.cfg.heightmap.extent)
        found = checks.table(view, self.cfg.heightmap.extent)
        _, has_depth = checks.seen(view, self.cfg.heightmap)
        height = np.asarray(_observe(self.cfg, *_pixels(view)).height)
        return Report(
            height_mm=1e3 * found.height,
            tilt_deg=found.tilt_deg,
            worst_mm=1e3 * found.worst(self.cfg.heightmap.extent),
            noise_mm=1e3 * found.noise,
            seen=float(has_depth.mean()),
            covered_cm2=float(np.sum(height > BARE) * 1e4 * self.cfg.heightmap.cell**2),
        )

    def warm_up(self, width: int, height: int) -> None:
        """Compiles what decisions about images of this size need, px."""
        n, rows = width * height, (self.cfg.heightmap.size,) * 2
        pixels = np.zeros((n, 3), np.float32), np.zeros(n, bool), np.zeros((n, 3), np.uint8)
        target = np.zeros(n, bool) if self.cfg.task.kind == "target" else None
        cache.enable()
        obs = _observe(self.cfg, *pixels, target)
        _supported(np.zeros((height, width), np.float32), 1.0)
        state = _dense_maps(self.cfg, self.params, obs, target is not None)
        jax.block_until_ready(_choose(self.cfg, state, jax.numpy.zeros(rows)))

    def _see(self, *given: Any) -> tuple[Observation, DenseMaps]:
        """The observation and the dense maps of an image that decisions may be taken from."""
        cache.enable()
        obs, has_mask = self.observe(*given), given[-1] is not None
        return obs, _dense_maps(self.cfg, self.params, obs, has_mask)

    def _checked_view(self, *given: Any) -> View:
        """A view that decisions may be taken from."""
        view, extent = images.make(*given), self.cfg.heightmap.extent
        if view.target is None and self.cfg.task.kind == "target":
            raise SettingsError("target_mask: this policy gets a marked object; mark one")
        checks.pose(view)
        checks.depth_unit(view, extent)
        checks.table_height(checks.table(view, extent), extent)
        checks.coverage(view, self.cfg.heightmap)
        checks.colours(view, extent)
        return view


def _pixels(view: View) -> tuple[Any, ...]:
    """Points, which are valid, colours and target flags of a view's pixels, as `observe` takes.
    Pixels that fly, as depth cameras have them at edges, are not valid."""
    target = None if view.target is None else view.target.reshape(-1)
    valid = _supported(view.depth, view.intrinsics.fx).reshape(-1)
    flat = view.points.reshape(-1, 3), valid, view.colour.reshape(-1, 3), target
    return jax.device_put(flat)


def _of_run(path: Path) -> tuple[Config, Params]:
    """Config and networks of a run's newest sound checkpoint."""
    try:
        from csac_jax.evaluation import policies
    except ModuleNotFoundError as error:
        raise SettingsError(
            f"{path} is a run's folder, which needs {error.name}; where that is installed, run: "
            f"csac-jax export {path} policy.safetensors"
        ) from None
    policy = policies.load(path)
    assert isinstance(policy, policies.LearnedPolicy)
    return policy.cfg, policy.params
