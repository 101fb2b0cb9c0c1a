"""`csac-jax eval`: a policy, measured."""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import tyro

from csac_jax.cli import guards, output, parsing, stored
from csac_jax.cli.errors import BadArgumentsError, as_bad_arguments
from csac_jax.config import Config


@dataclasses.dataclass(frozen=True)
class EvalOptions:
    """Measures a policy in scenes that training never saw."""

    source: tyro.conf.Positional[str]
    """Folder of the run, a policy file, or shipped for the policy that comes with the package."""
    policy: Literal["learned", "random", "oracle"] = "learned"
    """What acts: the networks; a random place with a block under it; or one that reads the blocks'
    poses."""
    suite: str = "own"
    """Scenes: own (dropped like the training's), random10, random30 (with --physics c on a CPU),
    cases, target (needs a policy of that task), generated, or a case file."""
    physics: Literal["mjx", "c"] = "mjx"
    """What moves the blocks: MJX as in training, or C MuJoCo, the reference."""
    robot: Literal["hand", "ur5"] = "hand"
    """What moves the gripper: nothing, it floats as in training; or the arm."""
    episodes: int = 50
    """Episodes of every part of the suite, each with a fresh scene where the part has several."""
    seed: int = 0
    """Number that scenes and noise follow from; whatever it is, the scenes are none that training
    draws from."""
    json: Path | None = None
    """File to write the result to, as JSON."""


def run(arguments: list[str]) -> int:
    """Measures and prints; returns the exit code."""
    options = parsing.parse(EvalOptions, arguments, "eval")
    if options.episodes < 1:
        raise BadArgumentsError("--episodes: at least 1")
    guards.check_seed(options.seed)
    cfg, networks = stored.policy(options.source)
    cfg = dataclasses.replace(
        cfg, sim=dataclasses.replace(cfg.sim, physics=options.physics, robot=options.robot)
    )
    begun = time.time()
    parts = _evaluate(options, cfg, networks)
    seconds = round(time.time() - begun, 1)
    for part, summary in parts.items():
        print_summary(
            f"{options.policy} in {options.episodes} episodes of {part}, seed {options.seed}",
            summary,
        )
    asked = {name: getattr(options, name) for name in ("policy", "suite", "seed")}
    one = next(iter(parts.values())) if len(parts) == 1 else {"parts": parts}
    output.write_result(options.json, {**asked, "seconds": seconds, **one}, cfg)
    return 0


def print_summary(title: str, summary: dict[str, Any]) -> None:
    """Prints every metric, and a dash for one without cases."""
    from rich.console import Console
    from rich.table import Table

    table = Table("metric", "value", "95 % interval", "n", title=title)
    for name, entry in {**summary, **summary.get("failures", {})}.items():
        if "value" in entry:
            shown = (
                ("-", "-")
                if entry["n"] == 0
                else (output.percent(entry["value"]), output.interval(entry))
            )
            table.add_row(name, *shown, str(entry["n"]))
    console = Console()
    console.print(table)
    for name in ("outcomes", "counts"):
        console.print(
            f"{name}: " + ", ".join(f"{key} {count}" for key, count in summary[name].items()),
            highlight=False,
        )


def _evaluate(
    options: EvalOptions, cfg: Config, networks: Callable[[], Any]
) -> dict[str, dict[str, Any]]:
    """Metrics of every part of the suite."""
    from csac_jax.evaluation import metrics, rollout, suites
    from csac_jax.runtime import cache

    cache.enable()
    with as_bad_arguments(ValueError):
        parts = suites.environments(
            cfg, options.suite, options.episodes, options.seed, options.policy
        )
    params = networks() if options.policy == "learned" else None
    return {
        name: metrics.summarise(
            rollout.rollout(env.cfg, env, options.policy, params, options.episodes, options.seed)
        )
        for name, env in parts.items()
    }
