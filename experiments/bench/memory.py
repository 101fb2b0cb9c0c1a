"""Memory that a run is predicted to take beside what its program takes, as JSON.

csac-jax bench memory [--record FILE] [NAME ...]

A name is a preset's or one of `CONFIGS`; without any, all of these, ten small ones that differ in
scenes, map, yaws, batch, blocks, net and ring. Each training step is compiled, not run, and XLA
says what it holds: the state that goes in, results, temporaries. On an accelerator the program is
run as well, on zeros, and the device's own peak stands beside it (`peak_bytes_in_use`, of all
configs so far: give one preset at a time there).

With --record each config is written to FILE when it is done, and one that is there already is not
compiled again: what was measured stays, with its commit, and is compared with what is predicted
now.
"""

import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import presets
from csac_jax.agent import actor_critic
from csac_jax.cli.errors import BadArgumentsError
from csac_jax.config import Config
from csac_jax.env import Env
from csac_jax.runtime import provenance
from csac_jax.scene import layout, model
from csac_jax.sim import physics
from csac_jax.training import memory, step
from experiments.bench import _options


def _smoke(**sections: dict[str, Any]) -> Config:
    """The preset `smoke` with other values in some sections."""
    cfg = presets.smoke()
    parts: dict[str, Any] = {
        name: dataclasses.replace(getattr(cfg, name), **new) for name, new in sections.items()
    }
    return dataclasses.replace(cfg, **parts)


def _on_mjx(cfg: Config) -> Config:
    """The config on MJX, whatever would be chosen here: what is predicted is its memory."""
    return dataclasses.replace(cfg, sim=dataclasses.replace(cfg.sim, physics="mjx"))


_NET = {"rotations": 16, "growth": 24, "stem": 16, "head": 32, "dilations": (1, 2, 4, 1)}


def _boxes(count: int, **sections: dict[str, Any]) -> Config:
    """`smoke` with boxes alone, which compile in half the time."""
    return _smoke(**{"scene": {"slots": ("box",) * count, "min_blocks": count}, **sections})


CONFIGS: dict[str, Config] = {
    "smoke": _smoke(),
    "64 scenes": _smoke(train={"scenes": 64, "learning_starts": 64}),
    "map of 64 cells": _boxes(3, heightmap={"size": 64}),
    "16 yaws": _boxes(3, net={"rotations": 16}),
    "batch of 64": _boxes(3, learn={"batch": 64}, train={"learning_starts": 64}),
    "6 boxes, 48 contacts, 32 scenes": _boxes(
        6, sim={"contacts": 48, "geom_pairs": 12}, train={"scenes": 32, "learning_starts": 32}
    ),
    "net of quick": _boxes(3, net=_NET),
    "learner of quick": _boxes(
        3,
        heightmap={"size": 64},
        net=_NET,
        learn={"batch": 32, "updates": 2},
        train={"scenes": 8, "learning_starts": 64},
    ),
    "ring of 4096, 64 cells": _boxes(3, heightmap={"size": 64}, replay={"capacity": 4096}),
    "two critics, no actor, 56 cells": _boxes(
        3, heightmap={"size": 56}, learn={"critics": 2, "actor": False}
    ),
}


def _program(cfg: Config) -> step.Program:
    """The program of a config with a single scene in its pool: nothing needs to settle."""
    world = model.build(cfg.scene, cfg.sim)
    blank = jax.tree.map(lambda leaf: np.asarray(leaf)[None], layout.parked(cfg.scene.slots))
    return step.Program(cfg, Env(cfg, physics.make(world, cfg.sim), blank), actor_critic.make(cfg))


def measure(cfg: Config) -> dict[str, Any]:
    """Bytes of one config, predicted and measured."""
    return judged(cfg, _measured(cfg))


def judged(cfg: Config, row: dict[str, Any]) -> dict[str, Any]:
    """What was measured of a config beside what is predicted of it now."""
    predicted = memory.predict(cfg)
    total = sum(predicted.values())
    return {
        **row,
        "predicted_bytes": total,
        "predicted_over_measured": total / row["measured_bytes"],
        "predicted_parts": predicted,
        "predicted_stages": memory.stages(cfg),
    }


def _measured(cfg: Config) -> dict[str, Any]:
    """What XLA holds for one training step of a config."""
    program = _program(cfg)
    state = jax.eval_shape(lambda: step.init(program))
    begun = time.perf_counter()
    compiled = step.compile_chunk(program, 1).lower(state).compile(_compiler_options())
    stats = compiled.memory_analysis()
    new = stats.output_size_in_bytes - stats.alias_size_in_bytes
    return {
        "measured_bytes": stats.argument_size_in_bytes + new + stats.temp_size_in_bytes,
        "measured_parts": {
            "state": stats.argument_size_in_bytes,
            "results": new,
            "temporaries": stats.temp_size_in_bytes,
        },
        "device_peak_bytes": _device_peak(compiled, state),
        "compile_seconds": time.perf_counter() - begun,
        "commit": provenance.commit(),
    }


def _compiler_options() -> dict[str, Any]:
    """Without LLVM's optimisations on a CPU, where nothing runs: buffers are laid out before LLVM
    has a say."""
    return {"xla_backend_optimization_level": 0} if jax.default_backend() == "cpu" else {}


def _device_peak(compiled: Any, state: Any) -> int | None:
    """Most bytes that the device held in this process after one step from a state of zeros; None on
    a CPU."""
    if jax.default_backend() == "cpu":
        return None

    def zeros(leaf: Any) -> jax.Array:
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return (
                jax.random.key(0)
                if leaf.shape == ()
                else jax.random.split(jax.random.key(0), leaf.shape)
            )
        return jnp.zeros(leaf.shape, leaf.dtype)

    jax.block_until_ready(compiled(jax.tree.map(zeros, state)))
    return (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use")


def main(arguments: list[str]) -> None:
    """Prints the result, and on stderr how far it is."""
    parser = _options.Parser(prog="bench memory", allow_abbrev=False)
    parser.add_argument("--record", type=Path)
    parser.add_argument("names", nargs="*")
    options = parser.parse_args(arguments)
    known = CONFIGS | {name: _on_mjx(presets.get(name)) for name in presets.PRESETS}
    if not known.keys() >= set(options.names):
        raise BadArgumentsError(
            f"bench memory: give names of: {', '.join(known)}; or none, for ten small configs"
        )
    path = options.record
    rows = _recorded(path) if path and path.exists() else {}
    for name in options.names or CONFIGS:
        rows[name] = judged(known[name], rows[name] if name in rows else _measured(known[name]))
        print(
            f"{name}: predicted / measured {rows[name]['predicted_over_measured']:.3f}",
            file=sys.stderr,
            flush=True,
        )
        if path:
            path.write_text(_text(rows))
    print(_text(rows), end="")


def _recorded(path: Path) -> dict[str, Any]:
    """The rows that a file written with --record holds."""
    try:
        return json.loads(path.read_text())["configs"]
    except (OSError, ValueError, KeyError, TypeError):
        raise BadArgumentsError(
            f"bench memory: {path} is no record of it; give another --record"
        ) from None


def _text(rows: dict[str, Any]) -> str:
    """The rows as JSON, with what made them and how far the worst one is off."""
    worst = max(abs(row["predicted_over_measured"] - 1.0) for row in rows.values())
    return (
        json.dumps({"configs": rows, "worst_error": worst} | provenance.record(), indent=2) + "\n"
    )
