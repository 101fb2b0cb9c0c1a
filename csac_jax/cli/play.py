"""`csac-jax play`: one episode, shown."""

import dataclasses
import time
from pathlib import Path
from typing import Any, Literal

from csac_jax import presets
from csac_jax.cli import guards, output, parsing, stored
from csac_jax.cli.failures import BadArgumentsError, as_bad_arguments


@dataclasses.dataclass(frozen=True)
class PlayOptions:
    """Runs one episode and says what every action did. Draws it if asked to, with no display."""

    scene: str = "random"
    """What lies on the table: random (dropped blocks), a shipped case by name, or a case file."""
    robot: Literal["hand", "ur5"] = "hand"
    """What moves the gripper: nothing, it floats; or the arm."""
    policy: str = "oracle"
    """What acts: oracle (reads the blocks' poses), random (a random place above a block), shipped
    (learned, comes with the package), the folder of a run or a policy file."""
    physics: Literal["c", "mjx"] = "c"
    """What moves the blocks: C MuJoCo or MJX. The motion in a video is always C MuJoCo's."""
    video: Path | None = None
    """File to write a video to: .mp4, .mkv, .mov, .gif or .webp."""
    png: Path | None = None
    """File to write a picture of the first moment to: .png, .jpg, .webp or .gif."""
    size: tuple[int, int] = (640, 480)
    """Width and height of picture and video, px, even numbers."""
    views: bool = True
    """Show height map and action next to the scene; of a learned policy also Q of both primitives,
    best over yaws, and the candidates of its search."""
    seed: int = 0
    """Number that the scene and the policy's noise follow from."""
    json: Path | None = None
    """File to write the result to, as JSON."""


def run(arguments: list[str]) -> int:
    """Runs the episode; returns the exit code."""
    options = parsing.parse(PlayOptions, arguments, "play")
    _check(options)
    drawn, opengl = options.png is not None or options.video is not None, None
    if drawn:
        from csac_jax.render import gl

        opengl = gl.choose()  # before MuJoCo is imported
    begun = time.time()
    env, steps = _play(options, _policy(options))
    from csac_jax.render import episode

    print(episode.summary(env.cfg, steps))
    if drawn:
        stage = episode.Stage(env.cfg, steps[0].before, options.size, opengl, options.views)
        episode.record(stage, steps, options.png, options.video)
    taken, lost = episode.totals(steps)
    result = {
        "scene": options.scene,
        "policy": options.policy,
        "renderer": (opengl or "rays") if drawn else None,
        "actions": len(steps),
        "cleared": taken,
        "blocks_lost": lost,
        "completed": episode.completed(steps),
        "seconds": round(time.time() - begun, 1),
    }
    output.write_result(options.json, result, env.cfg)
    return 0


def _check(options: PlayOptions) -> None:
    guards.check_seed(options.seed)
    if not all(side % 2 == 0 and 16 <= side <= 4096 for side in options.size):
        raise BadArgumentsError("--size: both numbers must be even and lie in 16 .. 4096 px")
    if options.png is not None or options.video is not None:
        _check_formats(options.png, options.video)


def _check_formats(png: Path | None, video: Path | None) -> None:
    from csac_jax.render import media

    with as_bad_arguments(ValueError):
        if png is not None:
            media.check_suffix(png, media.PICTURES)
        if video is not None:
            media.check_suffix(video, media.VIDEOS)
    if video is not None and media.needs_ffmpeg(video):
        guards.check_extra("--video", "imageio_ffmpeg", "video")


def _policy(options: PlayOptions) -> Any:
    """The policy; without networks it has the config of `quick`."""
    from csac_jax.evaluation import policies

    without_networks = {"oracle": policies.OraclePolicy, "random": policies.RandomPolicy}
    if options.policy in without_networks:
        return without_networks[options.policy](presets.quick())
    return stored.policy(options.policy)


def _play(options: PlayOptions, policy: Any) -> tuple[Any, list[Any]]:
    """The environment and the records of the episode's steps, each printed as it happens."""
    from csac_jax.evaluation import rollout, suites
    from csac_jax.render import episode
    from csac_jax.runtime import cache

    cache.enable()
    cfg = rollout.configured(policy.cfg, options.physics, options.robot)
    with as_bad_arguments(ValueError):
        suite = (
            suites.IN_DISTRIBUTION if options.scene == "random" else str(_case_file(options.scene))
        )
        (env,) = suites.environments(cfg, suite, 1, options.seed).values()
    # Quarter turns only, so that a case is recognised.
    env = dataclasses.replace(env, any_yaw=options.scene == "random")
    steps: list[Any] = []
    for step in rollout.episode(env, policy.replace(cfg=env.cfg), options.seed):
        steps.append(step)
        print(episode.line(len(steps), step), flush=True)
    return env, steps


def _case_file(scene: str) -> Path:
    """File of a shipped case by name, or the user's own. Raises ValueError if there is neither."""
    from csac_jax.scene import cases

    if scene in cases.names():
        return cases.shipped(scene)
    if Path(scene).is_file():
        return Path(scene)
    raise ValueError(
        f"--scene: '{scene}' is neither a case file nor one of: random, {', '.join(cases.names())}"
    )
