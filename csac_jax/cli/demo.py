"""`csac-jax demo`: a video of an arm that pushes blocks apart and takes them."""

import dataclasses
from pathlib import Path

from csac_jax.cli import parsing, play
from csac_jax.cli.parsing import PROGRAM

EPISODE = "--scene blocked --seed 7 --robot ur5e --policy shipped+planner"
"""Options of `play`. No training saw the scene, and hardly any grasp lifts one of its blocks."""


@dataclasses.dataclass(frozen=True)
class DemoOptions:
    """Writes a video of an arm that pushes blocks apart and takes them: networks propose actions,
    and physics chooses. It takes about a minute on two cores."""

    out: Path = Path("demo.webp")
    """File to write: .webp or .gif; .mp4, .mkv or .mov with the extra `video`."""


def run(arguments: list[str]) -> int:
    """Plays the episode and says how to see more; returns the exit code."""
    out = parsing.parse(DemoOptions, arguments, "demo").out
    print(f"{PROGRAM} play {EPISODE} --video {out}", flush=True)
    code = play.run([*EPISODE.split(), f"--video={out}"])
    print(f"wrote {out.absolute()}; open it in a browser")
    print(f"more: {PROGRAM} play --help, {PROGRAM} policies, {PROGRAM} train quick")
    return code
