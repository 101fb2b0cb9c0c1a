"""Cost of objects against blocks, as JSON: `csac-jax bench objects [--scenes N] [--repeats N]
[--warp]`.

An action, with the observation after it, and an observation alone, of ten blocks of the preset
`fast`, of ten of our own shapes, and of ten of those of few and of many convex parts. C MuJoCo, or
Warp with room for three times as many contacts of objects; one grasp above a block in each of
`scenes` poured scenes side by side. Calls alternate and the median counts. `overflows` counts the
substeps that may have lost contacts.
"""

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from csac_jax import presets
from csac_jax.config import Config, PhysicsKind
from csac_jax.env import Env
from csac_jax.objects import library, shapes
from csac_jax.robot.primitives import Action
from csac_jax.scenes import pool
from csac_jax.sim import physics
from csac_jax.vision import observe
from csac_jax.world import model, object_slots
from experiments.bench._options import timed
from experiments.bench._timing import medians

SHAPES = 200
PARTS = ((1, 1), (2, 3), (4, 6), (7, 10))  # fewest and most convex parts of an object, a row each
SETTLED = 64  # scenes, then the same again


def _configs(folder: Path, kind: PhysicsKind) -> dict[str, Config]:
    blocks = presets.get("fast").change(scene={"packed_fraction": 0.0}, sim={"physics": kind})
    held: dict[str, Any] = {"slots": ("object",) * 10, "split": "all"}
    roomy = blocks.change(sim={"contacts": 3 * blocks.sim.contacts})
    configs = {
        "blocks": blocks,
        "objects": roomy.change(scene={**held, "objects": f"procedural:0:{SHAPES}"}),
    }
    made = shapes.draw(0, SHAPES)
    for low, high in PARTS:
        path = folder / f"{low}_to_{high}"
        library.save(path, [one for one in made if low <= len(one.parts) <= high])
        name = f"objects_of_{low}_to_{high}_parts"
        configs[name] = roomy.change(scene={**held, "objects": str(path)})
    return configs


def _calls(cfg: Config, scenes: int) -> dict[str, Callable[[], Any]]:
    """Returns calls of an action and of an observation in settled scenes."""
    few = pool.settled(cfg, 1, min(scenes, SETTLED), poured=True)
    settled = jax.tree.map(lambda leaf: np.resize(leaf, (scenes, *leaf.shape[1:])), few)
    env = Env(cfg, physics.make(model.build(cfg.scene, cfg.sim), cfg.sim), settled)
    states = jax.jit(jax.vmap(env.reset_to))(settled)
    x, y = np.asarray(states.scene.position)[:, 0, :2].T
    actions, step = Action.grasp(x, y, 0.0), jax.jit(jax.vmap(env.step))
    look = jax.jit(jax.vmap(lambda scene: observe.observe(cfg, scene)))
    return {"action": lambda: step(states, actions), "observation": lambda: look(states.scene)}


def measure(scenes: int, repeats: int, warp: bool) -> dict[str, Any]:
    """Measures milliseconds a scene, and their ratio to those of blocks."""
    with tempfile.TemporaryDirectory() as folder:
        configs = _configs(Path(folder), "warp" if warp else "c")
        calls = {}
        for kind, cfg in configs.items():
            calls |= {f"{kind} {name}": call for name, call in _calls(cfg, scenes).items()}
            print(f"{kind}: {scenes} scenes at rest", file=sys.stderr, flush=True)
        seconds = medians(calls, repeats)
        after = {kind: calls[f"{kind} action"]() for kind in configs}
        lost = {kind: int(state.info.contact_overflow.sum()) for kind, state in after.items()}
        parts = {
            kind: float(object_slots.table(cfg.scene).present.sum(axis=1).mean())
            for kind, cfg in configs.items()
            if cfg.scene.has_objects
        }
    each = {name: 1e3 * value / scenes for name, value in seconds.items()}
    blocks = {name: each[f"blocks {name.split()[1]}"] for name in each}
    ratios = {name: each[name] / blocks[name] for name in each if not name.startswith("blocks")}
    result: dict[str, Any] = {"scenes": scenes, "milliseconds": each, "over_blocks": ratios}
    return result | {"mean_parts": parts, "overflows": lost}


def main(arguments: list[str]) -> None:
    """Prints the result."""
    timed("objects", arguments, measure, scenes=8, repeats=7, warp=False)
