"""One physics step of MJX against one of C MuJoCo, as JSON: `csac-jax bench one_step [--states N]`.

States are recorded in C MuJoCo, each at a random substep of a random push or a planned grasp in
settled piles of ten blocks. From each state both engines compute where every body is (kinematics),
then take one step without contacts and one with contacts, the solver started cold. The step with
contacts is repeated with a solver that converges: what then differs is not the solver's.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from csac_jax.scene import model, pool
from csac_jax.scene.layout import Scene
from csac_jax.sim import c_physics, mjx_physics, mjx_step, primitives
from csac_jax.sim.quiet_mjx import mjx
from experiments.bench._options import timed
from experiments.bench.parity import STREAM, TEN, Bench, pile_config

BATCH = 50
SCENES = 128  # settled piles; each is acted on again and again
EFFORT = {  # iterations, line search
    "as_configured": (TEN.sim.iterations, TEN.sim.line_search),
    "converged": (100, 50),
}


@dataclasses.dataclass(frozen=True)
class State:
    """A recorded state."""

    scene: Scene  # sizes and materials; NumPy
    qpos: np.ndarray  # [nq]
    qvel: np.ndarray  # [nv]
    ctrl: np.ndarray  # [nu]


def record(bench: Bench, count: int) -> list[State]:
    """One state of each of `count` primitives, half of them pushes, in settled piles."""
    cfg, world = bench.cfg, bench.world
    settled = pool.settled(cfg, STREAM, SCENES)
    scenes = jax.tree.map(lambda leaf: leaf[np.arange(count) % SCENES], settled)
    height = bench.heights(scenes)
    pushes = bench.push(jax.random.split(jax.random.key(0), count), scenes)
    grasps = bench.oracle(scenes, height)
    odd = np.arange(count) // SCENES % 2 == 1
    action = jax.tree.map(
        lambda a, b: jnp.where(odd.reshape(-1, *[1] * (a.ndim - 1)), a, b), pushes, grasps
    )
    plan = jax.jit(jax.vmap(lambda h, a: primitives.plan(cfg.sim, cfg.heightmap, h, a)))(
        height, action
    )
    joints = jax.device_get(jax.vmap(lambda one: primitives.joint_trajectory(cfg.sim, one))(plan))
    fields = jax.device_get(
        jax.jit(jax.vmap(lambda scene: model.scene_fields(world, scene)))(scenes)
    )
    rng = np.random.default_rng(STREAM)
    states = []
    for i in range(count):
        scene, own_fields, own = jax.tree.map(lambda leaf, i=i: leaf[i], (scenes, fields, joints))
        recorded = c_physics.trajectory(world, own_fields, scene, own)
        at = int(rng.integers(cfg.sim.substeps - 1))
        qpos, qvel = (leaf[at].astype(np.float32) for leaf in (recorded.qpos, recorded.qvel))
        states.append(State(scene, qpos, qvel, own.control[at + 1]))
    return states


def _by_mjx(
    bench: Bench, states: list[State], contacts: bool, effort: tuple[int, int]
) -> np.ndarray:
    """Positions [2, S, bodies, 3] m of all bodies, before and after a step."""
    sim = bench.cfg.sim
    world = model.build(bench.cfg.scene, sim)
    world.model.opt.iterations, world.model.opt.ls_iterations = effort
    if not contacts:
        world.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    physics = mjx_physics.make(world, sim)

    def one(scene: Scene, qpos: jax.Array, qvel: jax.Array, ctrl: jax.Array) -> jax.Array:
        its = mjx_physics.scene_model(physics, scene)
        data = physics.data.replace(qpos=qpos, qvel=qvel, ctrl=ctrl)
        after = mjx_step.step(its, data)
        return jnp.stack([mjx.kinematics(its, data).xpos, mjx.kinematics(its, after).xpos])

    every = jax.jit(jax.vmap(one))
    batches = [states[i : i + BATCH] for i in range(0, len(states), BATCH)]
    rows = []
    for batch in batches:
        leaves = [(s.scene, s.qpos, s.qvel, s.ctrl) for s in batch]
        rows.append(np.asarray(every(*jax.tree.map(lambda *each: np.stack(each), *leaves))))
    return np.concatenate(rows).swapaxes(0, 1)


def _by_c(
    bench: Bench, states: list[State], contacts: bool, effort: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """The same by C MuJoCo, and the number of contacts [S] before the step."""
    world = bench.world
    rows, touching = [], []
    for state in states:
        exact = model.with_blocks(world, jax.device_get(model.scene_fields(world, state.scene)))
        exact.opt.iterations, exact.opt.ls_iterations = effort
        if not contacts:
            exact.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        data = mujoco.MjData(exact)
        data.qpos, data.qvel, data.ctrl = state.qpos, state.qvel, state.ctrl
        mujoco.mj_kinematics(exact, data)
        before = data.xpos.copy()
        mujoco.mj_step(exact, data)
        touching.append(int(np.sum(data.contact.dist < 0.0)))
        mujoco.mj_kinematics(exact, data)
        rows.append((before, data.xpos.copy()))
    return np.array(rows).swapaxes(0, 1), np.array(touching)


def _errors(bench: Bench, ours: np.ndarray, theirs: np.ndarray) -> dict[str, dict[str, float]]:
    """Largest distance of a body between the engines, m, of the blocks and of the robot."""
    distance = np.linalg.norm(ours - theirs, axis=-1)  # [S, bodies]
    is_block = np.isin(np.arange(distance.shape[1]), bench.world.block_bodies)
    levels = (("median", 50), ("p99", 99), ("largest", 100))
    return {
        who: {name: float(np.percentile(distance[:, these].max(axis=1), q)) for name, q in levels}
        for who, these in (("blocks", is_block), ("robot", ~is_block))
    }


def measure(states: int) -> dict[str, Any]:
    """All of it over so many states."""
    bench = Bench(pile_config(TEN.scene.slots, len(TEN.scene.slots)))
    recorded = record(bench, states)
    result: dict[str, Any] = {"states": states}
    free, free_c = (by(bench, recorded, False, EFFORT["as_configured"]) for by in (_by_mjx, _by_c))
    result["kinematics_m"] = _errors(bench, free[0], free_c[0][0])
    result["step_without_contacts_m"] = _errors(bench, free[1], free_c[0][1])
    for name, effort in EFFORT.items():
        after = _by_mjx(bench, recorded, True, effort)
        after_c, touching = _by_c(bench, recorded, True, effort)
        result[f"step_with_contacts_{name}_m"] = _errors(bench, after[1], after_c[1])
    result["contacts_median"] = float(np.median(touching))
    return result


def main(arguments: list[str]) -> None:
    """Prints the result."""
    timed("one_step", arguments, measure, states=1000)
