"""Random actions: is every block accounted for, how often does physics fail? Prints JSON.

`csac-jax bench soak [--actions N] [--scenes E]`. Half of the actions are pushes. Scenes hold ten
blocks of all shapes and are replaced as in training. At the end random grasps run again with twice
as many contacts, and again with all blocks a micrometre away, which shows what chaos changes.
"""

import dataclasses
import functools
import json
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from csac_jax import env as environment
from csac_jax.agent import maps, policy
from csac_jax.config import Config
from csac_jax.constants import Primitive
from csac_jax.env import Env, State
from csac_jax.nets import networks
from csac_jax.runtime import provenance
from csac_jax.sim.primitives import Action
from experiments.bench._options import read
from experiments.bench.parity import TEN, pile_config

NUDGE = 1e-6  # m
CHUNK = 10  # actions per scene in one call of the compiled program


@struct.dataclass
class Tally:
    """Counts over all actions so far."""

    actions: jax.Array
    physics_diverged: jax.Array  # scenes that were quarantined
    not_finite: jax.Array  # NaN or infinity in a state that counts as healthy
    unaccounted: jax.Array  # actions after which in play + cleared + lost is not what it was
    cleared: jax.Array
    blocks_lost: jax.Array
    contact_overflow: jax.Array  # substeps with every contact slot in use


def _random(key: jax.Array, frames: maps.Frames, state: State) -> Action:
    """A random primitive at a random place with something to act on."""
    key_primitive, key_place = jax.random.split(key)
    primitive = jax.random.bernoulli(key_primitive).astype(jnp.int32)
    places = policy.random_places(key_place, frames, maps.actionable_cells(frames, state.obs))
    return Action(primitive=primitive, pose=maps.denormalise(frames, places[primitive]))


def _step(
    env: Env, frames: maps.Frames, key: jax.Array, state: State, tally: Tally
) -> tuple[State, Tally]:
    count = state.actions.shape[0]
    key_act, key_reset = jax.random.split(key)
    keys = jax.vmap(jax.random.fold_in, (None, 0))
    action = jax.vmap(_random, (0, None, 0))(keys(key_act, jnp.arange(count)), frames, state)
    after = jax.vmap(env.step)(state, action)
    info = after.info
    finite = jax.vmap(
        lambda one: jnp.all(
            jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(one)])
        )
    )
    before, now = jnp.sum(state.scene.in_play, axis=1), jnp.sum(after.scene.in_play, axis=1)
    missing = before != now + info.cleared + info.blocks_lost

    def total(values: jax.Array) -> jax.Array:
        return jnp.sum(values, dtype=jnp.int32)

    tally = Tally(
        actions=tally.actions + count,
        physics_diverged=tally.physics_diverged + total(info.physics_diverged),
        not_finite=tally.not_finite
        + total(~finite((after.scene, after.obs)) & ~info.physics_diverged),
        unaccounted=tally.unaccounted + total(missing & ~info.physics_diverged),
        cleared=tally.cleared + total(info.cleared),
        blocks_lost=tally.blocks_lost + total(info.blocks_lost),
        contact_overflow=tally.contact_overflow + total(info.contact_overflow),
    )
    fresh = jax.vmap(env.reset)(keys(key_reset, jnp.arange(count)))
    return jax.tree.map(
        lambda new, old: jax.vmap(jnp.where)(after.done, new, old), fresh, after
    ), tally


def _doubled(cfg: Config) -> Config:
    sim = dataclasses.replace(
        cfg.sim, geom_pairs=2 * cfg.sim.geom_pairs, contacts=2 * cfg.sim.contacts
    )
    return dataclasses.replace(cfg, sim=sim)


def soak(actions: int, scenes: int) -> dict[str, Any]:
    """At least `actions` random actions in `scenes` scenes side by side."""
    cfg = pile_config(TEN.scene.slots, len(TEN.scene.slots))
    env, frames = environment.make_env(cfg), maps.frames(cfg, networks.make(cfg.net))
    key = jax.random.key(0)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(key, scenes))

    @functools.partial(jax.jit, donate_argnums=(1, 2))
    def chunk(key: jax.Array, state: State, tally: Tally) -> tuple[State, Tally]:
        def body(carry, i):
            return _step(env, frames, jax.random.fold_in(key, i), *carry), None

        return jax.lax.scan(body, (state, tally), jnp.arange(CHUNK))[0]

    tally = Tally(*(jnp.int32(0) for _ in dataclasses.fields(Tally)))
    state, tally = chunk(
        jax.random.fold_in(key, 2**20), state, tally
    )  # compiles; its actions count too
    begun, number = time.perf_counter(), 0
    while int(tally.actions) < actions:
        state, tally = chunk(jax.random.fold_in(key, number), state, tally)
        number += 1
    seconds = time.perf_counter() - begun
    counts = {field.name: int(getattr(tally, field.name)) for field in dataclasses.fields(Tally)}
    return {
        **counts,
        "scenes": scenes,
        "quarantine_rate": counts["physics_diverged"] / counts["actions"],
        "saturated_substeps_share": counts["contact_overflow"]
        / counts["actions"]
        / cfg.sim.substeps,
        "actions_per_second": number * CHUNK * scenes / seconds if number else None,
        "outcomes_equal": _caps(cfg, env, frames, state),
    }


def _caps(cfg: Config, env: Env, frames: maps.Frames, state: State) -> dict[str, Any]:
    """Share of random grasps that end as with the config's caps: with caps twice as wide, and, as
    the floor that chaos sets, with every block NUDGE away."""
    count = state.actions.shape[0]
    keys = jax.random.split(jax.random.key(1), count)
    action = jax.jit(jax.vmap(_random, (0, None, 0)), static_argnums=1)(keys, frames, state)
    action = action.replace(primitive=jnp.full_like(action.primitive, Primitive.GRASP))
    step = jax.jit(jax.vmap(env.step))
    moved = state.replace(scene=state.scene.replace(position=state.scene.position + NUDGE))
    doubled = jax.jit(jax.vmap(environment.make_env(_doubled(cfg)).step))
    ends = {
        "as_it_is": step(state, action),
        "nudged": step(moved, action),
        "doubled_caps": doubled(state, action),
    }
    judged = {name: np.asarray(end.info.outcome) for name, end in ends.items()}
    equal = {
        name: float(np.mean(judged[name] == judged["as_it_is"]))
        for name in ("doubled_caps", "nudged")
    }
    return {**equal, "nudge_m": NUDGE, "grasps": count}


def main(arguments: list[str]) -> None:
    """Prints the result."""
    options = read("soak", arguments, actions=100_000, scenes=1024)
    print(json.dumps(soak(options["actions"], options["scenes"]) | provenance.record(), indent=2))
