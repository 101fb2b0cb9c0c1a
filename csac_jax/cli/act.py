"""`csac-jax act`: one camera image in, actions out."""

import dataclasses
from pathlib import Path
from typing import Any

from csac_jax.cli import output, parsing
from csac_jax.cli.robot_options import RobotOptions, naming_the_option
from csac_jax.errors import FailedError
from csac_jax.section import require


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActOptions(RobotOptions):
    """Decides where to grasp or push in a camera's image. Needs no simulator."""

    rgb: Path
    """Colour image."""
    depth: Path
    """Depth image of the same size: a PNG of 16 bits in mm, or an .npy of float32 in m."""
    intrinsics: Path
    """JSON of both images' camera: width, height, fx, fy, cx, cy in px, and maybe distortion."""
    pose: Path
    """JSON with the 4 x 4 matrix from camera (x right, y down, z forward) to workspace, m."""
    mask: Path | None = None
    """Image or .npy that is not 0 at the object to get. A policy that was not trained with targets
    then only grasps, and only that object."""
    top: int = 1
    """Number of actions, best first."""
    check: bool = False
    """Checks pose and intrinsics by an image of the empty table, and decides nothing."""
    json: Path | None = None
    """File to write the result to, as JSON."""
    png: Path | None = None
    """File to write a picture to: the image with the actions drawn in it, and the Q maps."""


@naming_the_option()
def run(arguments: list[str]) -> int:
    """Decides and prints; returns the exit code."""
    options = parsing.parse(ActOptions, arguments, "act")
    both = options.check and options.record is not None
    require(not both, "--record: --check decides nothing; leave one of them out")
    if options.png is not None:
        from csac_jax.render import media

        media.check_suffix(options.png, media.PICTURES)
    from csac_jax.deploy import image_files

    policy = options.load()
    files = options.rgb, options.depth, options.intrinsics, options.pose
    image = image_files.read_image(*files)
    return (_check if options.check else _decide)(options, policy, image)


def _decide(options: ActOptions, policy: Any, image: tuple[Any, Any, Any, Any]) -> int:
    from csac_jax.deploy import image_files, images
    from csac_jax.render import decision_picture, media

    mask = None if options.mask is None else image_files.read_mask(options.mask)
    recorder = options.recorder()
    decisions = policy.decide(*image, mask, options.top)
    options.warn(policy)
    for number, action in enumerate(decisions, 1):
        print(f"{number:2d} {decision_picture.line(action)}")
    if not decisions:
        print("nothing to act on")
    if options.png is not None:
        view, maps = images.make(*image, mask), policy.maps(*image, mask)
        drawing = decision_picture.picture(policy.cfg, view, decisions, maps)
        media.write_picture(options.png, drawing)
    result: dict[str, Any] = {"decisions": [action.to_dict() for action in decisions]}
    if recorder is not None:
        result["id"] = recorder.add((*image, mask), decisions)
        print(f"recorded as {options.record / result['id']}")
    output.write_result(options.json, result, policy.cfg)
    return 0


def _check(options: ActOptions, policy: Any, image: tuple[Any, ...]) -> int:
    report = policy.check(*image)
    print(
        f"table      {report.height_mm:+.1f} mm from z = 0, tilted by {report.tilt_deg:.2f} degrees"
    )
    print(f"           {report.worst_mm:.1f} mm at the worst corner of the workspace")
    print(f"noise      {report.noise_mm:.1f} mm, of points on the table")
    print(f"seen       {report.seen:.0%} of the workspace")
    print(f"covered    {report.covered_cm2:.0f} cm^2 are higher than 1 cm")
    output.write_result(options.json, {**vars(report), "faults": report.faults}, policy.cfg)
    if report.faults:
        raise FailedError("; ".join(report.faults))
    print("pose and intrinsics fit")
    return 0
