"""Two small problems of known best policy, played through the real training step: pictures in place
of physics.

Blocks of one size lie on a 4 x 4 grid. A block's colour says what an action on it does, so that all
is in the picture.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from csac_jax import algorithms
from csac_jax.config import (
    BetaReplay,
    CEMConfig,
    Config,
    ExploreConfig,
    HeightmapConfig,
    LearnConfig,
    SmallNet,
    TargetConfig,
    TaskConfig,
    TrainConfig,
)
from csac_jax.constants import CHANGE_AREA, Outcome, Primitive
from csac_jax.env import Info, State
from csac_jax.robot.primitives import Action
from csac_jax.vision.heightmap import Observation
from tests.sections import with_constants

GRID = 4  # places per side
HEIGHT = 0.05  # m, of a block
GOOD, DUD, LOCKED, LATCH = range(4)  # kinds of block
COLOURS = np.array([[0.9, 0.1, 0.1], [0.1, 0.1, 0.9], [0.9, 0.9, 0.1], [0.1, 0.9, 0.1]], np.float32)
TABLE = np.array([0.3, 0.3, 0.3], np.float32)


@struct.dataclass
class Layout:
    """Blocks of a scene. N = blocks."""

    place: jax.Array  # [N] int32, row * GRID + column
    kind: jax.Array  # [N] int32


@dataclasses.dataclass(frozen=True)
class Toy:
    """One scene: a good grasp ends the episode; a push of the latch turns the locked block into a
    good one.

    Has the same `reset` and `step` as the environment.
    """

    cfg: Config
    kinds: tuple[int, ...]  # of the blocks of a fresh scene

    def reset(self, key: jax.Array) -> State:
        """Blocks in places of their own, each as likely as any other."""
        place = jax.random.permutation(key, GRID * GRID)[: len(self.kinds)]
        layout = Layout(place.astype(jnp.int32), jnp.asarray(self.kinds, jnp.int32))
        no, none, zero = jnp.zeros((), bool), jnp.zeros((), jnp.int32), jnp.zeros(())
        info = Info(none, none, zero, zero, none, none, none, no, no)
        return State(layout, self.observe(layout), zero, no, no, none, none, none, info)

    def observe(self, layout: Layout) -> Observation:
        """The picture of a scene."""
        size = self.cfg.heightmap.size
        cell = jnp.arange(size, dtype=jnp.int32) // (size // GRID)
        number = cell[:, None, None] * GRID + cell[None, :, None]
        there = number == layout.place[None, None]  # [H, W, N]
        colour = there.astype(jnp.float32) @ jnp.asarray(COLOURS)[layout.kind]
        taken = jnp.any(there, axis=-1)
        return Observation(
            colour=jnp.where(taken[..., None], colour, jnp.asarray(TABLE)[None, None]),
            height=jnp.where(taken, HEIGHT, 0.0),
            target=jnp.ones((size, size), bool),
        )

    def auto_reset(self, key: jax.Array, state: State) -> State:
        """A new problem, whatever came of the last one."""
        return self.reset(key)

    def step(self, state: State, action: Action) -> State:
        """Applies an action to the block at its place, if there is one."""
        extent = self.cfg.heightmap.extent
        col, row = jnp.clip((action.pose[:2] / extent + 0.5) * GRID, 0, GRID - 1).astype(jnp.int32)
        layout = state.scene
        hit = layout.place == row * GRID + col  # [N]
        kind = jnp.where(hit, layout.kind, -1)
        grasped = action.primitive == Primitive.GRASP
        lifted = grasped & jnp.any(kind == GOOD)
        outcome = jnp.where(jnp.any(hit), jnp.int32(Outcome.TOUCHED), jnp.int32(Outcome.EMPTY))
        outcome = jnp.where(lifted, jnp.int32(Outcome.LIFTED), outcome)
        opened = ~grasped & jnp.any(kind == LATCH) & jnp.any(layout.kind == LOCKED)
        layout = layout.replace(kind=jnp.where(opened & (layout.kind == LOCKED), GOOD, layout.kind))
        actions = state.actions + 1
        return state.replace(
            scene=layout,
            obs=self.observe(layout),
            terminated=lifted,
            truncated=(actions >= self.cfg.task.max_actions) & ~lifted,
            actions=actions,
            steps_without_change=jnp.where(lifted | opened, 0, state.steps_without_change + 1),
            info=state.info.replace(
                outcome=jnp.where(grasped, outcome, jnp.int32(Outcome.NOTHING)),
                moved=jnp.where(opened, 2.0 * CHANGE_AREA, 0.0),
                cleared=lifted.astype(jnp.int32),
            ),
        )


def bandit(cfg: Config) -> Toy:
    """One good block among duds: the first grasp can end the episode."""
    return Toy(cfg, (GOOD, DUD, DUD))


def two_step(cfg: Config) -> Toy:
    """One block that can be grasped only after a push of another."""
    return Toy(cfg, (LOCKED, LATCH, DUD))


def config(algo: str, actions: int, max_actions: int, push: float | None = None) -> Config:
    """A small config of an algorithm; `push` replaces what any push earns, before Gamma = 0.5."""
    net = SmallNet(rotations=4, growth=8, dilations=(1,), stem=8, head=16)
    small = Config(
        heightmap=HeightmapConfig(size=16),
        net=with_constants(net, pad_fraction=0.25),
        cem=CEMConfig(candidates=16, rounds=2),
        target=with_constants(TargetConfig(), samples=16),
        explore=ExploreConfig(push_fraction=0.5, epsilon_place=(0.5, 0.1)),
        learn=LearnConfig(learning_rate=5e-3, batch=32, updates_per_step=2, tau=0.1),
        replay=BetaReplay(capacity=1024),
        task=TaskConfig(max_actions=max_actions),
        train=TrainConfig(scenes=8, actions=actions, learning_starts=64),
    )
    cfg = algorithms.configure(small, algo)
    if push is None:
        return cfg
    return cfg.change(reward={"push_levels": (push, push)})
