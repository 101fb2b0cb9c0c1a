"""`csac-jax play`: one episode, shown."""

import dataclasses
import functools
import time
from pathlib import Path
from typing import Any, Literal

import tyro

from csac_jax import presets
from csac_jax.cli import output, settings
from csac_jax.cli.failures import check_extra, check_seed
from csac_jax.errors import SettingsError
from csac_jax.render import gl
from csac_jax.section import require


@dataclasses.dataclass(frozen=True)
class PlayOptions:
    """Runs one episode and prints the effect of every action."""

    scene: str = "random"
    """Dropped blocks (random), a shipped case, a case file; or a suite of one part, such as
    blocked, enclosed or tray, whose scenes need pushes, or pile, objects_packed or objects10."""
    objects: str | None = None
    """Library of suites of objects: a folder, or procedural:SEED:COUNT."""
    robot: Literal["hand", "ur5", "ur5e"] = "hand"
    """`hand`: the gripper floats; or the arm that moves it."""
    policy: str = "oracle"
    """Policy: oracle (reads the poses), planner (simulates many actions), geometric, random, one
    that a module of --import registers, a shipped one, a run or a policy file. The last three
    with +planner at the end: physics chooses among what the networks propose."""
    physics: Literal["c", "mjx"] = "c"
    """C MuJoCo or MJX. The motion in a video is always C MuJoCo's."""
    video: Path | None = None
    """File to write a video to: .mp4, .mkv, .mov, .gif or .webp."""
    png: Path | None = None
    """File to write a picture of the first moment to: .png, .jpg, .webp or .gif."""
    size: tuple[int, int] = (640, 480)
    """Width and height of picture and video, px, even numbers."""
    views: bool = True
    """Show height map, action and, of a learned policy, Q and the candidates of its search."""
    viewer: tyro.conf.FlagCreatePairsOff[bool] = False
    """Show it in 3-D: in a window, or without a display in the browser (extra `viewer`)."""
    seed: int = 0
    """Seed of the scene and of the policy's noise."""
    json: Path | None = None
    """File to write the result to, as JSON."""


def run(arguments: list[str]) -> int:
    """Runs the episode; returns the exit code."""
    options, view = settings.parse_view(PlayOptions, "play", arguments)
    _check(options)
    drawn, opengl = options.png is not None or options.video is not None, None
    if drawn:
        opengl = gl.choose()  # before MuJoCo is imported
    begun = time.time()
    policy = _policy(options)
    env, steps = _play(options, policy, view)
    from csac_jax.render import episode

    def renderer(env: Any, steps: list[Any]) -> episode.EpisodeRenderer:
        first = steps[0].before
        return episode.EpisodeRenderer(env.cfg, first, options.size, opengl, options.views)

    def another(seed: int) -> Any:
        played = _play(dataclasses.replace(options, seed=seed), policy, view)
        return renderer(*played).film(played[1], seed)

    if drawn or options.viewer:
        stage = renderer(env, steps)
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
    if options.viewer:
        log = functools.partial(print, flush=True)
        stage.show(stage.film(steps, options.seed), log, another)
    return 0


def _check(options: PlayOptions) -> None:
    check_seed(options.seed)
    fits = all(side % 2 == 0 and 16 <= side <= 4096 for side in options.size)
    require(fits, "--size: both numbers must be even and lie in 16 .. 4096 px")
    if options.viewer and not gl.has_display():
        check_extra("--viewer: there is no display here, and its page", "viser", "viewer")
    if options.png is None and options.video is None:
        return
    from csac_jax.render import media

    if options.png is not None:
        media.check_suffix(options.png, media.PICTURES)
    if options.video is not None:
        media.check_suffix(options.video, media.VIDEOS)
        if media.needs_ffmpeg(options.video):
            check_extra("--video", "imageio_ffmpeg", "video")


def _policy(options: PlayOptions) -> Any:
    """Returns the policy; one without networks has the config of `quick`, and the scene's task."""
    from csac_jax.evaluation import policies, suites

    if options.policy not in policies.BASELINES:
        source = options.policy.removesuffix("+planner")
        return policies.make("learned" if source == options.policy else "learned+planner", source)
    has_target = options.scene in suites.SUITES and suites.SUITES[options.scene].target
    task = {"kind": "target"} if has_target else {}
    return policies.BASELINES[options.policy](presets.quick().change(task=task))


def _play(options: PlayOptions, policy: Any, view: dict[str, Any]) -> tuple[Any, list[Any]]:
    """Returns the environment and the records of the episode's steps; prints each at once, and how
    it ended.

    `view` holds changes of the policy's config.
    """
    from csac_jax.evaluation import policies, rollout, suites
    from csac_jax.render import episode
    from csac_jax.runtime import cache

    cache.enable()
    world = (options.seed, options.physics, options.robot, options.objects)
    suite = _suite(options.scene)
    cfg = suites.standard(policy.cfg, suite).change(**view)
    prepared = suites.prepare(cfg, suite, 1, *world, split="all")
    env, *others = prepared.parts.values()
    require(not others, f"--scene: {options.scene} has several parts; give a suite of one part")
    # Quarter turns only, so that a case is recognised.
    env = dataclasses.replace(env, any_yaw=options.scene == "random")
    policies.warn_if_elsewhere(policy, env.cfg)
    steps: list[Any] = []
    for step in rollout.episode(env, policies.in_world(policy, env.cfg), options.seed):
        steps.append(step)
        print(episode.line(len(steps), step), flush=True)
    print(episode.summary(env, steps), flush=True)
    return env, steps


def _suite(scene: str) -> str:
    """Returns the suite with these scenes. Raises SettingsError if there is none."""
    from csac_jax.evaluation import suites
    from csac_jax.scenes import cases

    if scene == "random":
        return suites.IN_DISTRIBUTION
    if scene in suites.SUITES:
        return scene
    if scene in cases.names():
        return str(cases.shipped(scene))
    if Path(scene).is_file():
        return scene
    known = ", ".join(dict.fromkeys(("random", *cases.names(), *suites.SUITES)))
    raise SettingsError(f"--scene: '{scene}' is neither a case file nor one of: {known}")
