"""Options that commands at a real robot share."""

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import tyro

from csac_jax.errors import SettingsError
from csac_jax.section import require


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicyOptions:
    """A policy and the robot's gripper."""

    policy: tyro.conf.Positional[str]
    """A policy file, one that comes with the package, such as shipped, or a run's folder."""
    gripper: str | None = None
    """The robot's gripper, by name or folder; by default the policy's, of `shipped` the RG2."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RobotOptions(PolicyOptions):
    """A policy in a robot's workspace, and its record."""

    workspace: Path | None = None
    """JSON with the 4 x 4 matrix from workspace to robot, for the waypoints' tool poses."""
    record: Path | None = None
    """Folder of one robot that stores images, decisions and outcomes, for finetune."""

    def load(self) -> Any:
        """Loads the policy."""
        from csac_jax.deploy import CameraPolicy, image_files

        workspace = None if self.workspace is None else image_files.read_pose(self.workspace)
        return CameraPolicy.load(self.policy, workspace, self.gripper)

    def warn(self, policy: Any) -> None:
        """Warns of a policy that was not trained on images of a camera."""
        from csac_jax.io import made_for

        camera = {"heightmap": {"view": "oblique"}, "sensor": {"kind": "d415"}}
        made_for.warn_if_elsewhere(policy.cfg, policy.cfg.change(**camera))

    def recorder(self) -> Any:
        """Opens the record, if there is one."""
        from csac_jax.deploy.record import Recorder

        return None if self.record is None else Recorder(self.record, self.policy)


@contextlib.contextmanager
def naming_the_option() -> Iterator[None]:
    """Puts the option's name into errors about the robot's gripper."""
    try:
        yield
    except SettingsError as error:
        if str(error).startswith("gripper:"):
            raise SettingsError(f"--{error}") from None
        raise


def check_size(size: tuple[int, int]) -> None:
    """Raises SettingsError for a bad size of images, px."""
    fits = all(16 <= side <= 4096 for side in size)
    require(fits, "--size: both numbers must lie in 16 .. 4096 px")
