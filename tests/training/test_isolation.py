"""Scenes of the compiled training step do not affect one another: 64 scenes, one of them bad."""

import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax import presets
from csac_jax.training import programs
from csac_jax.training.step import TrainState
from csac_jax.training.transitions import StepMetrics

# minutes of compilation; tests/test_env.py has the small version
pytestmark = [pytest.mark.mjx, pytest.mark.slow]

SCENES = 64
CFG = presets.smoke().change(
    sim={"grasp_phases": (4, 3, 4)},
    replay={"capacity": 2 * SCENES},
    train={"scenes": SCENES, "learning_starts": SCENES},
)
BAD = (np.nan, np.inf, 1e6)
LEAVES = {
    "scene": "position quaternion velocity half_size density friction colour target",
    "obs": "height colour",
}


class Run(NamedTuple):
    """One training step."""

    state: TrainState
    metrics: StepMetrics


@pytest.fixture(scope="module")
def chunk() -> Iterator[Any]:
    with jax.debug_key_reuse(True):
        program = programs.make(CFG)
        state = programs.init(program)
        compiled = programs.compile_chunk(program, 1).lower(state).compile()

        def run(state: TrainState) -> Run:
            after, metrics = jax.device_get(compiled(jax.tree.map(jnp.copy, state)))
            return Run(after, jax.tree.map(lambda leaf: leaf[0], metrics))

        yield state, run, run(state)


def _written(
    state: TrainState, part: str, leaf: str, scene: int, entry: int, value: float
) -> TrainState:
    """Writes `value`, cast to the leaf's dtype, into one entry of one leaf of one scene."""
    tree = getattr(state.scenes, part)
    array = np.array(getattr(tree, leaf))
    flat = array.reshape(SCENES, -1)
    with np.errstate(invalid="ignore"):
        old, new = flat[scene, entry], np.asarray(value).astype(array.dtype)
        flat[scene, entry] = ~old if array.dtype == bool else new
    changed = dataclasses.replace(tree, **{leaf: jnp.asarray(array)})
    return dataclasses.replace(state, scenes=dataclasses.replace(state.scenes, **{part: changed}))


def _assert_equal(ours: Any, theirs: Any, what: str = "") -> None:
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_array_equal(one, other, err_msg=what)


def _rows(tree: Any, keep: np.ndarray) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[keep], tree)


def _assert_others_same(good: Run, bad: Run, scene: int, what: str = "") -> np.ndarray:
    """Returns which scenes are not `scene`, after a comparison of their states."""
    others = np.arange(SCENES) != scene
    _assert_equal(_rows(good.state.scenes, others), _rows(bad.state.scenes, others), what)
    return others


def _assert_isolated(good: Run, bad: Run, scene: int, what: str) -> None:
    others = _assert_others_same(good, bad, scene, what)
    state, metrics = bad
    np.testing.assert_array_equal(metrics.physics_diverged, ~others, err_msg=what)
    assert (metrics.truncated[scene], metrics.terminated[scene]) == (True, False), what
    assert (metrics.cleared[scene], metrics.blocks_lost[scene]) == (0, 0), what
    stored = np.arange(int(state.replay.size))
    _assert_equal(_rows(good.state.replay.items, others), _rows(state.replay.items, stored), what)
    for leaf in jax.tree.leaves((state.scenes, state.learner, state.replay, metrics)):
        leaf = np.asarray(leaf)
        assert leaf.dtype.kind != "f" or np.isfinite(leaf).all(), what


def _entries(state: TrainState, part: str, leaf: str) -> int:
    return int(np.prod(np.shape(getattr(getattr(state.scenes, part), leaf))[1:]))


def test_good_scenes_are_none_of_them_ill(chunk):
    """Claim: without a bad entry physics diverges in no scene and every transition is stored."""
    *_, good = chunk
    assert not good.metrics.physics_diverged.any()
    assert good.state.replay.size == SCENES
    assert good.metrics.learned


def test_bad_entry_stays_in_its_scene(chunk):
    """Claim: NaN, infinity or 1e6 in any entry of a scene, or of its view (48 places), leaves the
    other 63 the same, bit for bit; it is counted and replaced, and no transition of it is
    stored."""
    state, run, good = chunk
    count = 0
    for part, leaf in [(key, leaf) for key in LEAVES for leaf in LEAVES[key].split()]:
        entries = _entries(state, part, leaf)
        for entry in range(0, entries, max(entries // 48, 1)):
            for value in BAD:
                scene = count % SCENES
                what = f"{part}.{leaf}[{scene}, {entry}] = {value}"
                bad = run(_written(state, part, leaf, scene, entry, value))
                _assert_isolated(good, bad, scene, what)
                count += 1
    assert count > 400


def test_block_out_of_place_stays_in_its_scene(chunk):
    """Claim: a block marked as in play where it is parked makes physics diverge there, one
    marked as parked where it lies is taken away; nothing changes elsewhere."""
    state, run, good = chunk
    seen = set()
    for scene in range(8):
        for entry in range(_entries(state, "scene", "in_play")):
            was = bool(state.scenes.scene.in_play[scene, entry])
            bad = run(_written(state, "scene", "in_play", scene, entry, 1.0))
            others = _assert_others_same(good, bad, scene)
            np.testing.assert_array_equal(bad.metrics.physics_diverged, ~others & (not was))
            seen.add(was)
    assert seen == {False, True}


@pytest.mark.parametrize("leaf", ["actions", "steps_without_change"])
def test_bad_counter_stays_in_its_scene(chunk, leaf: str):
    """Claim: a counter gone wild cuts its own episode off, and changes nothing elsewhere."""
    state, run, good = chunk
    scene = 5
    wild = jnp.asarray(getattr(state.scenes, leaf)).at[scene].set(1_000_000)
    bad = run(dataclasses.replace(state, scenes=dataclasses.replace(state.scenes, **{leaf: wild})))
    _assert_others_same(good, bad, scene)
    assert not bad.metrics.physics_diverged.any()
    assert bad.state.scenes.actions[scene] <= 1
