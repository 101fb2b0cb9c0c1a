"""Named configs. A preset is a function; `register` adds one of your own."""

import dataclasses
from collections.abc import Callable

from csac_jax.algorithms import unknown
from csac_jax.config import (
    BetaReplay,
    CEMConfig,
    Config,
    DenseNet121,
    ExploreConfig,
    HeightmapConfig,
    LearnConfig,
    RewardConfig,
    SceneConfig,
    SimConfig,
    SlotKind,
    SmallNet,
    TargetConfig,
    TaskConfig,
    TrainConfig,
)

BOX: SlotKind = "box"
TEN_BLOCKS: tuple[SlotKind, ...] = (
    *(BOX, BOX, "arch", "prism", BOX),
    *("cylinder", "half_cylinder", BOX, BOX, BOX),
)


def quick() -> Config:
    """Learns to clear five blocks on a 2-core CPU; what was measured is in experiments/results.

    Blocks of one shape are alike in size, density and friction. Its discount and the end of its
    Beta law, (1, 4), are away from the literature's defaults; neither is shown to be needed. What
    it costs: docs/benchmarks/speed-cpu.md. The actor learns on a part of the batch, which spares
    passes; the net's features lie 28 mm apart, not 14, for cheaper passes, its maps' cells still
    14, and its layers see as far.
    """
    alike = SceneConfig(size_jitter=(0.0, 0.0), density=(600.0, 600.0), friction=(0.8, 0.8))
    return Config(
        preset="quick",
        scene=alike,
        sim=SimConfig(physics="auto"),
        net=SmallNet(stride=4, subcells=2, dilations=(1, 2, 1), stem=32, growth=32, head=48),
        target=TargetConfig(gamma=0.2),
        learn=LearnConfig(actor_batch=8),
        replay=BetaReplay(end=(1.0, 4.0)),
    )


def fast() -> Config:
    """Ten blocks of all eight shapes, three quarters of the scenes packed, 2,048 side by side, for
    one GPU.

    Updates are many and small, and what is drawn from the replay is shifted, as in `paper_small`. A
    failed grasp costs more than a push that is not worth it, half of the random primitives are
    pushes, and blocks that leave cost. Physics is Warp's where it is installed, hence meshes are of
    one size. What it learns so, and otherwise: docs/benchmarks/learning-ablations.md.
    """
    return Config(
        preset="fast",
        scene=SceneConfig(
            slots=TEN_BLOCKS,
            min_blocks=10,
            pool=4096,
            arranged=0.75,
            drop_extent=(0.1, 0.25),
            size_jitter=(0.1, 0.0),
        ),
        task=TaskConfig(max_actions=25),
        sim=SimConfig(physics="auto", geom_pairs=24, contacts=80),
        net=SmallNet(stride=4, subcells=4, dilations=(1, 2, 1), stem=48, growth=64, head=96),
        target=TargetConfig(gamma=0.2),
        reward=RewardConfig(grasp_levels=(-1.5, -1.5, -1.5, -1.0, 1.0), lost_block_penalty=3.0),
        explore=ExploreConfig(epsilon_primitive=(0.5, 0.2), push_fraction=0.5, decay=0.9999),
        learn=LearnConfig(batch=64, updates=64, augment_shift=8, critics=2, loss="squared"),
        replay=BetaReplay(capacity=65536, end=(1.0, 4.0)),
        train=TrainConfig(
            scenes=2048, actions=163840, learning_starts=4096, chunk=2, save_every=20
        ),
    )


def paper() -> Config:
    """The protocol of the paper, for one GPU: DenseNet-121 on maps of 224 cells, one scene, 2,500
    actions, ten blocks.

    Adam 1e-4, gamma 0.5 and primitives at random from 0.5 down to 0.1 as in VPG; one update per
    action; places are explored by action noise alone, and nothing is augmented. Where the paper is
    silent: tau of SD3, two pixels per cell and two transitions per update, as many as in VPG, one
    of them for the actor. Ours is that cells with nothing to act on are left out. Physics is
    C's, the fastest for one scene. Result: experiments/results/paper.
    """
    return Config(
        preset="paper",
        scene=SceneConfig(slots=TEN_BLOCKS, min_blocks=10, pool=256),
        task=TaskConfig(max_actions=25),
        sim=SimConfig(physics="c", geom_pairs=24, contacts=80),
        heightmap=HeightmapConfig(size=224),
        net=DenseNet121(norm="batch", head=64, margin=0.4286, zoom=2),
        target=TargetConfig(gamma=0.5),
        explore=ExploreConfig(epsilon_place=(0.0, 0.0), decay=0.9998, push_fraction=0.5),
        learn=LearnConfig(
            learning_rate=1e-4,
            actor_learning_rate=1e-4,
            lr_final_fraction=1.0,
            batch=2,
            actor_batch=1,
            updates=1,
            augment=False,
            tau=0.005,
        ),
        replay=BetaReplay(capacity=2500),
        train=TrainConfig(scenes=1, actions=2500, learning_starts=8, chunk=50, save_every=10),
    )


def paper_small() -> Config:
    """The protocol of `paper` with the small net on maps of 64 cells: one scene of ten blocks,
    2,500 actions.

    Ours, beside the net: batches of 32, and with them Adam 1e-3; no more than one update an action,
    and shifts of what is drawn from the replay, lest 2,500 actions be learned by heart; the squared
    error of Algorithm 1 line 21; discount 0.2; SD3's twin critics; random places at first and
    exploration that ends after some 1,000 actions, as in `quick`. Meshes are of one size, which
    `sim.physics warp` needs. What each is worth: docs/benchmarks/learning-ablations.md;
    results: experiments/results/paper_small.
    """
    whole = paper()
    return dataclasses.replace(
        whole,
        preset="paper_small",
        scene=dataclasses.replace(whole.scene, size_jitter=(0.1, 0.0)),
        heightmap=HeightmapConfig(),
        net=SmallNet(stride=4, subcells=4, dilations=(1, 2, 1), stem=48, growth=64, head=96),
        target=TargetConfig(gamma=0.2),
        explore=ExploreConfig(),
        learn=LearnConfig(batch=32, updates=1, augment_shift=8, critics=2, loss="squared"),
        train=dataclasses.replace(whole.train, learning_starts=32),
    )


def smoke() -> Config:
    """The whole pipeline in 64 actions, for tests: everything small, nothing left out, nothing
    learned."""
    return Config(
        preset="smoke",
        scene=SceneConfig(slots=("box", "box", "prism"), min_blocks=2, pool=8, settle_time=1.0),
        sim=SimConfig(grasp_phases=(20, 15, 20), geom_pairs=6, contacts=16),
        heightmap=HeightmapConfig(size=32),
        net=SmallNet(rotations=4, growth=4, dilations=(1, 2), stem=4, head=4),
        cem=CEMConfig(candidates=16, elites=4, rounds=2),
        target=TargetConfig(samples=8),
        learn=LearnConfig(batch=8, updates=1),
        replay=BetaReplay(capacity=64),
        train=TrainConfig(scenes=2, actions=64, learning_starts=8, chunk=4, save_every=2),
    )


Preset = Callable[[], Config]

PRESETS: dict[str, Preset] = {
    "smoke": smoke,
    "quick": quick,
    "fast": fast,
    "paper": paper,
    "paper_small": paper_small,
}


def register(name: str, preset: Preset) -> None:
    """Makes `preset`, a function that returns a config, known as `name` to API and commands.

    Raises ValueError if the name is taken.
    """
    if name in PRESETS:
        raise ValueError(f"preset '{name}' exists; choose another name")
    PRESETS[name] = preset


def get(name: str) -> Config:
    """The preset `name`. Raises ValueError for an unknown name."""
    if name not in PRESETS:
        raise ValueError(unknown("preset", name, PRESETS))
    return dataclasses.replace(PRESETS[name](), preset=name)
