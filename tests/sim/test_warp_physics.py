"""Warp beside C MuJoCo, where Warp is installed; without a GPU it runs on the CPU, slowly."""

import functools
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from csac_jax import presets
from csac_jax.baselines import oracle
from csac_jax.config import Config, PhysicsKind, SlotKind
from csac_jax.constants import Outcome
from csac_jax.errors import SceneError
from csac_jax.robot import primitives
from csac_jax.robot.primitives import JointTrajectory
from csac_jax.scenes import pool
from csac_jax.sim import physics as simulation, warp_physics
from csac_jax.sim.outcome import Trace, grasp_outcome
from csac_jax.vision import observe
from csac_jax.world import model, scene_state
from csac_jax.world.scene_state import SceneState
from tests.sim.conftest import (
    CASES,
    CONFIG,
    HAS_WARP,
    TWO_OBJECTS,
    WARP,
    bar,
    grasped_bar,
    stack,
    thrown_objects,
)

SCENES = 4
SLOTS: tuple[SlotKind, ...] = ("box", "arch", "prism", "cylinder")
PRESSED = {"touched": 5e-3, "spinning": 1e-2, "dropped": 3e-2, "kicked": 1e-3}
"""Cases in which small differences grow, as a block is pressed or flies metres away, m."""


def needs_warp(test: Any) -> Any:
    """Marks of a test that runs Warp."""
    return functools.reduce(lambda marked, mark: mark(marked), (*WARP.marks, pytest.mark.mjx), test)


def _config(slots: tuple[SlotKind, ...] = CONFIG.scene.slots) -> Config:
    """Of Warp's physics, with meshes of one size."""
    scene = {"slots": slots, "min_blocks": len(slots), "size_jitter": (0.1, 0.0)}
    return presets.get("quick").change(scene=scene, sim={"physics": "warp"})


class Ran(NamedTuple):
    """Inputs of primitives, and their results on Warp and in C; leaves [E, ...]."""

    scene: SceneState
    joints: JointTrajectory
    warp: tuple[SceneState, Trace]
    c: tuple[SceneState, Trace]


def test_bad_worlds_are_refused(monkeypatch: pytest.MonkeyPatch):
    """Claim: physics on Warp without Warp names the extra to install; a config of meshes of several
    sizes is refused, one of boxes alone is not."""
    monkeypatch.setitem(sys.modules, "warp", None)  # importing it raises ImportError
    cfg = _config(SLOTS)
    with pytest.raises(SceneError, match=r"pip install 'csac-jax\[warp\]'"):
        warp_physics.make(model.build(cfg.scene, cfg.sim), cfg.sim)
    with pytest.raises(ValueError, match=r"scene\.size_jitter: the second must be 0"):
        cfg.change(scene={"size_jitter": (0.1, 0.1)})
    boxes = {"slots": ("box", "arch"), "min_blocks": 2, "size_jitter": (0.1, 0.1)}
    assert cfg.change(scene=boxes).sim.physics == "warp"


@pytest.fixture(scope="module", autouse=True)
def own_step() -> Iterator[float]:
    """Warp's own longest step, s. Its steps are as long as C's, so that states can be compared."""
    with pytest.MonkeyPatch.context() as patch:
        own = 0.0
        if HAS_WARP:
            from csac_jax.sim import warp_action

            own = warp_action.STEP
            patch.setattr(warp_action, "STEP", CONFIG.sim.timestep)
        yield own


@pytest.fixture(scope="module")
def run_on_warp() -> Any:
    """One primitive of one scene of `_config` on Warp."""
    return _physics("warp").run


@pytest.fixture(scope="module")
def ran(run_on_warp: Any) -> Ran:
    """The scripted cases of this folder, in a world of a mesh and of boxes."""
    cfg = _config()
    scenes, actions = map(stack, zip(*CASES.values(), strict=True))
    scenes = jax.tree.map(np.asarray, jax.vmap(lambda scene: scene_state.park(scene, True))(scenes))
    height = jax.jit(jax.vmap(lambda scene: observe.observe(cfg, scene).height))(scenes)
    plan = jax.vmap(functools.partial(primitives.plan, cfg.sim, cfg.heightmap))(height, actions)
    joints = jax.vmap(functools.partial(primitives.joint_trajectory, cfg.sim))(plan)
    run_in_c = _physics("c").run
    runs = [jax.jit(jax.vmap(run))(scenes, joints) for run in (run_on_warp, run_in_c)]
    return jax.tree.map(np.asarray, Ran(scenes, joints, *runs))


@needs_warp
def test_scripted_primitives_go_as_in_c(ran: Ran):
    """Claim: blocks lie where C MuJoCo leaves them, within 0.1 mm if none was pressed aside or
    thrown, and every trace says the same."""
    (after, trace), (after_c, trace_c) = ran.warp, ran.c
    names = list(CASES)
    apart = np.linalg.norm(after.position - after_c.position, axis=2).max(axis=1)
    for name, distance in zip(names, apart, strict=True):
        assert name == "nan" or distance < PRESSED.get(name, 1e-4), name
    well = np.array(names) != "nan"
    for leaf in ("touched", "held"):
        np.testing.assert_array_equal(getattr(trace, leaf)[well], getattr(trace_c, leaf)[well])
    for leaf in ("held_rise", "rise", "gap_closed", "gap_end"):
        got, wanted = getattr(trace, leaf)[well], getattr(trace_c, leaf)[well]
        np.testing.assert_allclose(got, wanted, atol=1e-3, err_msg=leaf)
    assert trace_c.touched.any()
    assert trace_c.held.any()
    assert not trace.contact_overflow.any()


@needs_warp
def test_what_was_prepared_ahead_is_used(ran: Ran, monkeypatch: pytest.MonkeyPatch):
    """Claim: scenes that a thread has prepared are not prepared again, and go alike."""
    from csac_jax.sim import warp_action

    physics = _physics("warp")
    scenes = len(ran.joints.reachable)
    with ThreadPoolExecutor(1) as thread:
        thread.submit(simulation.prepare, physics, scenes).result()
    monkeypatch.setattr(warp_action, "Batch", None)
    after, trace = jax.jit(jax.vmap(physics.run))(ran.scene, ran.joints)
    is_far = np.array(list(CASES)) == "kicked"  # metres away, by rounding
    for rows, atol in ((~is_far, 1e-6), (is_far, 1e-3)):
        np.testing.assert_allclose(after.position[rows], ran.warp[0].position[rows], atol=atol)
    np.testing.assert_array_equal(trace.touched, ran.warp[1].touched)


@needs_warp
def test_a_started_primitive_ends_like_one_that_is_run(ran: Ran):
    """Claim: primitives in the background of other work end as without it, but for what the order
    of contacts changes, which depends on timing."""
    physics: Any = _physics("warp")

    @jax.jit
    def overlapped(work: jax.Array) -> tuple[Any, jax.Array]:
        tokens = jax.vmap(physics.start)(ran.scene, ran.joints)
        work = jax.lax.fori_loop(0, 50, lambda _, w: jnp.tanh(w @ w), work + tokens[0])
        finish = jax.vmap(physics.finish, (0, 0, None))
        return finish(ran.scene, tokens, work[0, 0]), work

    (after, trace), work = overlapped(jnp.eye(512))
    assert np.isfinite(work).all()
    apart = np.abs(after.position - ran.warp[0].position).max(axis=(1, 2))
    for name, distance in zip(CASES, apart, strict=True):
        assert name == "nan" or distance < PRESSED.get(name, 1e-5), name
    np.testing.assert_array_equal(trace.touched, ran.warp[1].touched)


@needs_warp
def test_nested_vmap_is_a_loop(ran: Ran, run_on_warp: Any):
    """Claim: seeds of scenes are one batch, with the results of scenes one by one."""
    scenes, joints = _at(ran.scene, np.array([[4, 5], [4, 6]])), _at(ran.joints, [4, 5])
    nested = jax.jit(jax.vmap(jax.vmap(run_on_warp), in_axes=(0, None)))(scenes, joints)
    one = jax.jit(run_on_warp)
    close = functools.partial(np.testing.assert_allclose, atol=1e-4)
    for seed in range(2):
        for row in range(2):
            alone = one(_at(scenes, (seed, row)), _at(joints, row))
            jax.tree.map(close, _at(nested, (seed, row)), alone)


@needs_warp
def test_scenes_have_their_own_blocks(ran: Ran, run_on_warp: Any):
    """Claim: sizes, masses and frictions are those of each scene."""
    rows = [0, 0, 4, 4]  # a cube that slides while nothing is grasped, a cube that is lifted
    scenes, joints = jax.tree.map(lambda leaf: leaf[rows].copy(), (ran.scene, ran.joints))
    scenes.velocity[:2, 0, 0] = -0.6
    scenes.friction[1] = 3.0
    scenes.density[3] *= 3.0
    scenes.half_size[3, 0] *= 1.15
    scenes.position[3, 0, 2] *= 1.15
    after, trace = jax.jit(jax.vmap(run_on_warp))(scenes, joints)
    after_c, trace_c = jax.jit(jax.vmap(_physics("c").run))(scenes, joints)
    np.testing.assert_allclose(after.position, after_c.position, atol=5e-4)
    np.testing.assert_allclose(trace.gap_end, trace_c.gap_end, atol=5e-4)
    ends = np.asarray(after_c.position)[:, 0, 0]
    assert ends[1] - ends[0] > 5e-3  # the more friction, the nearer
    assert trace_c.gap_end[3] - trace_c.gap_end[2] > 5e-3


@needs_warp
def test_nothing_is_left_from_another_action(ran: Ran, run_on_warp: Any):
    """Claim: a compiled program gives what its arguments say, whatever ran before it."""
    run = jax.jit(jax.vmap(run_on_warp))
    names = list(CASES)
    first = [names.index("lifted"), names.index("nan")]
    second = [names.index("push"), names.index("nothing")]
    before = _at((ran.scene, ran.joints), first)
    between = _at((ran.scene, ran.joints), second)
    results = [jax.tree.map(np.array, run(*each)) for each in (before, between, before)]
    close = functools.partial(np.testing.assert_allclose, atol=1e-5)
    jax.tree.map(close, results[0], results[2])
    jax.tree.map(close, results[1], _at(ran.warp, second))


@needs_warp
def test_grasps_go_as_in_c():
    """Claim: the planner's grasps of blocks of four kinds end on Warp as they do in C MuJoCo."""
    outcome, position, trace = _end(_config(SLOTS))
    outcome_c, position_c, _ = _end(_config(SLOTS).change(sim={"physics": "c"}))
    assert (outcome_c == Outcome.LIFTED).all()
    np.testing.assert_array_equal(outcome, outcome_c)
    assert not trace.contact_overflow.any()
    assert np.median(np.linalg.norm(position - position_c, axis=2)) < 1e-3


@needs_warp
def test_longer_steps_end_alike(ran: Ran, own_step: float, monkeypatch: pytest.MonkeyPatch):
    """Claim: Warp's own steps, a fifth fewer, leave blocks within 3 mm of C's; traces agree."""
    monkeypatch.setattr("csac_jax.sim.warp_action.STEP", own_step)
    physics: Any = _physics("warp")
    assert physics.simulator.substeps == 150
    well = np.array(list(CASES)) != "nan"
    scene, joints = _at((ran.scene, ran.joints), well)
    after, trace = jax.jit(jax.vmap(physics.run))(scene, joints)
    after_c, trace_c = _at(ran.c, well)
    for leaf in ("touched", "held"):
        np.testing.assert_array_equal(getattr(trace, leaf), getattr(trace_c, leaf))
    for leaf in ("gap_closed", "gap_end"):
        np.testing.assert_allclose(getattr(trace, leaf), getattr(trace_c, leaf), atol=2e-3)
    apart = np.linalg.norm(after.position - after_c.position, axis=2).max(axis=1)
    assert np.median(apart) < 3e-3


def test_set_points_keep_their_times():
    """Claim: set-points read at other times lie on the same lines and end at the same place."""
    control = np.cumsum(np.ones((190, 2), np.float32), axis=0)  # those of a steady motion
    found = warp_physics._resampled(jnp.asarray(control), 130)
    wanted = np.arange(1, 131)[:, None] * (190 / 130) * np.ones(2)
    np.testing.assert_allclose(found, wanted, rtol=1e-6)
    same = warp_physics._resampled(jnp.asarray(control), 190)
    np.testing.assert_array_equal(same, control)


def _physics(kind: PhysicsKind, cfg: Config | None = None) -> simulation.Physics:
    cfg = cfg or _config()
    sim = cfg.change(sim={"physics": kind}).sim
    return simulation.make(model.build(cfg.scene, sim), sim)


def _at(tree: Any, index: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[index], tree)


def _end(cfg: Config) -> tuple[np.ndarray, np.ndarray, Trace]:
    """Outcomes [E], ends [E, N, 3] m and traces of the planner's grasps in settled scenes."""
    scenes = pool.settled(cfg, 77, SCENES)
    height = jax.vmap(lambda scene: observe.observe(cfg, scene).height)(scenes)
    action = jax.vmap(functools.partial(oracle.grasp, cfg))(scenes, height)
    physics = simulation.make(model.build(cfg.scene, cfg.sim), cfg.sim)
    run = functools.partial(simulation.execute, physics, cfg)
    after, trace, plan = jax.jit(jax.vmap(run))(scenes, height, action)
    rise = plan.start[:, 2] - jnp.min(plan.control[:, :, 2], axis=1)
    outcome = jax.vmap(grasp_outcome)(trace, plan.surface, rise)
    return np.asarray(outcome), np.asarray(after.position), jax.tree.map(np.asarray, trace)


@needs_warp
def test_objects_go_as_in_c():
    """Claim: every scene has its own objects, which turn, land and meet as in C, within 1 mm."""
    cfg = TWO_OBJECTS.change(sim={"physics": "warp"})
    scene, joints = thrown_objects(cfg)
    warp, c = _physics("warp", cfg), _physics("c", cfg)
    (after, trace), (after_c, _) = (jax.jit(jax.vmap(one.run))(scene, joints) for one in (warp, c))
    assert not trace.contact_overflow.any()
    changed = np.abs(np.asarray(after_c.velocity[:, :, 3:]) - scene.velocity[:, :, 3:])
    assert (changed.max(axis=(1, 2)) > 1.0).all()  # rad/s: each met something
    np.testing.assert_allclose(after.position, after_c.position, atol=1e-3)
    turned = np.abs(np.sum(np.asarray(after.quaternion) * np.asarray(after_c.quaternion), axis=2))
    np.testing.assert_allclose(turned, 1.0, atol=1e-3)


@needs_warp
def test_held_objects_hang_as_in_c(tmp_path: Path):
    """Claim: a bar hangs where it hangs in C for a second, within 0.5 mm."""
    sim = {"physics": "warp", "grasp_phases": (60, 50, 250)}
    cfg = presets.get("quick").change(scene=bar(tmp_path), sim=sim)
    scene, joints = grasped_bar(cfg)
    (after, trace), (after_c, _) = (
        jax.jit(_physics(kind, cfg).run)(scene, joints) for kind in ("warp", "c")
    )
    assert trace.held.all()
    np.testing.assert_allclose(after.position, after_c.position, atol=5e-4)


@needs_warp
def test_many_objects_fit_on_warp():
    """Claim: Warp takes scenes of more objects than its dense matrices hold."""
    scene = {"slots": ("object",) * 10, "min_blocks": 10, "objects": "procedural:0:12"}
    cfg = presets.get("objects").change(scene=scene, sim={"physics": "warp"})
    world = model.build(cfg.scene, cfg.sim)
    from csac_jax.sim import warp_action

    placed, _ = warp_action._put(world.model, cfg.sim, 1, warp_action.fields(world, cfg.sim))
    assert placed.nv == 66
    assert placed.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert placed.opt.iterations == warp_action.CONE_EFFORT
