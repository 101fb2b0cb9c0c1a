"""`csac-jax act`: one camera image in, actions out."""

import dataclasses
from pathlib import Path
from typing import Any

import tyro

from csac_jax.cli import output, parsing
from csac_jax.errors import FailedError, SettingsError


@dataclasses.dataclass(frozen=True)
class ActOptions:
    """Decides where to grasp or push in a camera's image. Needs no simulator."""

    policy: tyro.conf.Positional[str]
    """A policy file, one that comes with the package, such as shipped, or a run's folder."""
    rgb: Path
    """Colour image."""
    depth: Path
    """Depth image of the same size: a PNG of 16 bits in mm, or an .npy of float32 in m."""
    intrinsics: Path
    """JSON of both images' camera: width, height, fx, fy, cx, cy in px, and maybe distortion."""
    pose: Path
    """JSON with the 4 x 4 matrix from camera (x right, y down, z forward) to workspace, m."""
    mask: Path | None = None
    """Image or .npy that is not 0 at the object to get."""
    workspace: Path | None = None
    """JSON with the 4 x 4 matrix from workspace to robot, for the waypoints' tool poses."""
    gripper: str | None = None
    """The robot's gripper, by name or folder; by default that of the training."""
    top: int = 1
    """Number of actions, best first."""
    check: bool = False
    """Checks pose and intrinsics by an image of the empty table, and decides nothing."""
    record: Path | None = None
    """Folder that stores the image and the decisions, for finetune."""
    json: Path | None = None
    """File to write the result to, as JSON."""
    png: Path | None = None
    """File to write a picture to: the image with the actions drawn in it, and the Q maps."""


def run(arguments: list[str]) -> int:
    """Decides and prints; returns the exit code."""
    options = parsing.parse(ActOptions, arguments, "act")
    if options.check and options.record is not None:
        raise SettingsError("--record: --check decides nothing; leave one of them out")
    if options.png is not None:
        from csac_jax.render import media

        media.check_suffix(options.png, media.PICTURES)
    from csac_jax import deploy
    from csac_jax.deploy import image_files

    workspace = None if options.workspace is None else image_files.read_pose(options.workspace)
    policy = deploy.CameraPolicy.load(options.policy, workspace, options.gripper)
    image = (
        image_files.read_rgb(options.rgb),
        image_files.read_depth(options.depth),
        image_files.read_intrinsics(options.intrinsics),
        image_files.read_pose(options.pose),
    )
    return (_check if options.check else _decide)(options, policy, image)


def _decide(options: ActOptions, policy: Any, image: tuple[Any, Any, Any, Any]) -> int:
    from csac_jax.deploy import image_files, images, record
    from csac_jax.render import decision_picture, media

    mask = None if options.mask is None else image_files.read_mask(options.mask)
    recorder = None if options.record is None else record.Recorder(options.record, options.policy)
    decisions = policy.decide(*image, mask, options.top)
    for number, action in enumerate(decisions, 1):
        print(f"{number:2d} {decision_picture.line(action)}")
    if not decisions:
        print("nothing to act on")
    if options.png is not None:
        view, maps = images.make(*image, target_mask=mask), policy.maps(*image, mask)
        drawing = decision_picture.picture(policy.cfg, view, decisions, maps)
        media.write_picture(options.png, drawing)
    result: dict[str, Any] = {"decisions": [action.to_dict() for action in decisions]}
    if recorder is not None:
        result["id"] = recorder.add((*image, mask), decisions)
        print(f"recorded as {options.record / result['id']}")
    output.write_result(options.json, result, policy.cfg)
    return 0


def _check(options: ActOptions, policy: Any, image: tuple[Any, ...]) -> int:
    from csac_jax.deploy import checks

    report = policy.check(*image)
    print(
        f"table      {report.height_mm:+.1f} mm from z = 0, tilted by {report.tilt_deg:.2f} degrees"
    )
    print(f"           {report.worst_mm:.1f} mm at the worst corner of the workspace")
    print(f"noise      {report.noise_mm:.1f} mm, of points on the table")
    print(f"seen       {report.seen:.0%} of the workspace")
    print(f"covered    {report.covered_cm2:.0f} cm^2 are higher than 1 cm")
    faults = checks.faults(report)
    output.write_result(options.json, {**report._asdict(), "faults": faults}, policy.cfg)
    if faults:
        raise FailedError("; ".join(faults))
    print("pose and intrinsics fit")
    return 0
