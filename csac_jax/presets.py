"""Named configs. A preset is a function; `register` adds one of your own."""

from collections.abc import Callable

from csac_jax.algorithms import unknown
from csac_jax.config import Config, SceneConfig

TEN_BLOCKS = Config().change(
    scene={
        "slots": (
            *("box", "box", "arch", "prism", "box"),
            *("cylinder", "half_cylinder", "box", "box", "box"),
        ),
        "min_blocks": 10,
    },
    task={"max_actions": 25},
    sim={"geom_pairs": 24, "contacts": 80},
)
PROTOCOL = TEN_BLOCKS.change(
    scene={"pool": 256},
    task={"kind": "target"},
    sim={"physics": "c"},
    reward={"push_effect": "renewed"},
    replay={"capacity": 2500},
    train={"scenes": 1, "actions": 2500, "learning_starts": 32, "chunk": 50, "save_every": 10},
)
"""The paper's sec. 4.3: a target named at random among ten blocks, a new one after each success,
and another scene where none is left or the actions are spent; 2,500 actions in one scene at a time.

C's physics are the fastest for one scene. The paper does not say after how many actions a scene is
reset in training; 25 is ours. Pushes are labelled by the critic of now (ours): early ones would
stay "worse" for ever.
"""
SMALL_NET = {
    "stride": 4,
    "subcells": 4,
    "dilations": (1, 2, 1),
    "stem": 32,
    "growth": 32,
    "head": 48,
}


def quick() -> Config:
    """Learns to clear five blocks on a 2-core CPU; what was measured is in experiments/results.

    Blocks of one shape are alike in size, density and friction. Discount and the end of the Beta
    law are not the literature's; neither is shown to be needed. Two cores can afford few passes: a
    large step of the critic follows each step of all scenes, and exploration ends after some 500
    actions. The actor learns on a part of the batch, and the net's features lie 28 mm apart, not
    14; its maps' cells still 14, and its layers see as far. It has eight yaws, not sixteen; greedy
    decisions are means over mirror images. What it costs: docs/benchmarks/speed-cpu.md.
    """
    return Config().change(
        preset="quick",
        scene={"size_jitter": (0.0, 0.0), "density": (600.0, 600.0), "friction": (0.8, 0.8)},
        sim={"physics": "auto"},
        net=SMALL_NET | {"subcells": 2, "growth": 24, "rotations": 8},
        policy={"augment": True},
        target={"gamma": 0.2},
        explore={"decay": 0.995},
        learn={"actor_batch": 8, "updates": 1, "learning_rate": 4e-3},
        replay={"end": (1.0, 4.0)},
    )


def fast() -> Config:
    """Ten blocks of all eight shapes, most scenes packed, 4,096 side by side, for one GPU.

    Updates are many and small, and what is drawn from the replay is shifted, as in `paper_small`. A
    failed grasp costs more than a poor push, half of the random primitives are pushes, and blocks
    that leave cost. Physics is Warp's where it is installed, hence meshes are of one size.
    What it learns so, and otherwise: docs/benchmarks/learning-ablations.md.
    """
    packed = {"pool": 4096, "arranged": 0.75, "drop_extent": (0.1, 0.25), "size_jitter": (0.1, 0.0)}
    length = {"actions": 655360, "learning_starts": 4096, "chunk": 2, "save_every": 20}
    return TEN_BLOCKS.change(
        preset="fast",
        scene=packed,
        sim={"physics": "auto"},
        net=SMALL_NET,
        target={"gamma": 0.2},
        reward={"grasp_levels": (-1.5, -1.5, -1.5, -1.0, 1.0), "lost_block_penalty": 3.0},
        explore={"epsilon_primitive": (0.5, 0.2), "push_fraction": 0.5, "decay": 0.9998},
        learn={"batch": 64, "updates": 96, "augment_shift": 8, "critics": 2, "loss": "squared"},
        replay={"capacity": 65536, "end": (1.0, 4.0)},
        train={"scenes": 4096, **length},
    )


def objects() -> Config:
    """Learns to clear six objects of many shapes on two CPU cores.

    The shapes are our own, of the families and seeds that train. They lie in piles and apart. The
    tips go lower than for blocks, which low and hollow things need (`csac-jax bench grasp_depth`).
    The net is that of `quick` with wider layers, the rewards are those of `fast`.
    """
    return quick().change(
        preset="objects",
        scene={
            "slots": ("object",) * 6,
            "min_blocks": 6,
            "objects": "made:1:700",
            "pool": 512,
            "drop_extent": (0.1, 0.3),
            "density": SceneConfig.density,
            "friction": SceneConfig.friction,
        },
        task={"max_actions": 20},
        sim={"clearance": 0.004, "contacts": 128},
        net={"growth": SMALL_NET["growth"]},
        reward={"grasp_levels": (-1.5, -1.5, -1.5, -1.0, 1.0), "lost_block_penalty": 3.0},
        explore={"decay": 0.9995},
        learn={"augment_shift": 8, "updates": 2, "learning_rate": 1e-3},
        replay={"capacity": 16384},
        train={"actions": 24000, "learning_starts": 128, "chunk": 20, "save_every": 10},
    )


def objects_target() -> Config:
    """The same for one object at a time, marked among the others."""
    return objects().change(preset="objects_target", task={"kind": "target"})


def grippers() -> Config:
    """Learns to clear ten blocks with any gripper: its opening and its fingers differ in every
    episode, and the net sees them. Made for a start from a policy of blocks, `--init shipped`.
    """
    return TEN_BLOCKS.change(
        preset="grippers",
        scene={"pool": 512, "drop_extent": (0.1, 0.25), "size_jitter": (0.1, 0.0)},
        sim={"physics": "auto", "gripper": "varied"},
        net=SMALL_NET | {"subcells": 2, "gripper": True},
        target={"gamma": 0.2},
        reward={"grasp_levels": (-1.5, -1.5, -1.5, -1.0, 1.0), "lost_block_penalty": 3.0},
        explore={"epsilon_primitive": (0.2, 0.1), "epsilon_place": (0.2, 0.0), "decay": 0.9995},
        learn={"actor_batch": 8, "augment_shift": 8, "updates": 1, "learning_rate": 5e-4},
        replay={"capacity": 16384, "end": (1.0, 4.0)},
        train={"actions": 6080, "learning_starts": 128, "chunk": 20, "save_every": 10},
    )


def paper() -> Config:
    """The target protocol of the paper, for one GPU, with DenseNet-121 on maps of 224 cells.

    `--task.kind clear` is sec. 4.2's, the table cleared, by which the recorded runs were made.

    Adam 1e-4, gamma 0.5 and primitives at random from 0.5 down to 0.1 as in VPG; one update per
    action; places are explored by action noise alone, and nothing is augmented. Where the paper is
    silent: tau of SD3, two pixels per cell and two transitions per update, as many as in VPG, one
    of them for the actor. Ours is that cells with nothing to act on are left out.
    Result: experiments/results/paper.
    """
    rates = {"learning_rate": 1e-4, "actor_learning_rate": 1e-4, "lr_final_fraction": 1.0}
    updates = {"batch": 2, "actor_batch": 1, "updates": 1, "augment": False, "tau": 0.005}
    return PROTOCOL.change(
        preset="paper",
        heightmap={"size": 224},
        net={"kind": "densenet121", "norm": "batch", "head": 64, "margin": 0.4286, "zoom": 2},
        target={"gamma": 0.5},
        explore={"epsilon_place": (0.0, 0.0), "decay": 0.9998, "push_fraction": 0.5},
        learn={**rates, **updates},
        train={"learning_starts": 8},
    )


def paper_small() -> Config:
    """The protocol of `paper`, a target at a time, with the small net on maps of 64 cells.

    Also ours: batches of 32, and with them Adam 1e-3; one update an action, and shifts of what is
    drawn from the replay, so that 2,500 actions are not learned by heart; the squared error of
    Algorithm 1 line 21; discount 0.2; SD3's twin critics; random places at first, and exploration
    that ends after some 1,000 actions. Meshes are of one size, which
    `sim.physics warp` needs. What each is worth: docs/benchmarks/learning-ablations.md;
    results: experiments/results/paper_small.
    """
    return PROTOCOL.change(
        preset="paper_small",
        scene={"size_jitter": (0.1, 0.0)},
        net=SMALL_NET | {"stem": 48, "growth": 64, "head": 96},
        target={"gamma": 0.2},
        learn={"updates": 1, "augment_shift": 8, "critics": 2, "loss": "squared"},
    )


def smoke() -> Config:
    """The whole pipeline in 64 actions, for tests: all is small, none left out, nothing learned."""
    return Config().change(
        preset="smoke",
        scene={"slots": ("box", "box", "prism"), "min_blocks": 2, "pool": 8, "settle_time": 1.0},
        sim={"grasp_phases": (20, 15, 20), "geom_pairs": 6, "contacts": 16},
        heightmap={"size": 32},
        net={"rotations": 4, "growth": 4, "dilations": (1, 2), "stem": 4, "head": 4},
        cem={"candidates": 16, "elites": 4, "rounds": 2},
        learn={"batch": 8, "updates": 1},
        replay={"capacity": 64},
        train={"scenes": 2, "actions": 64, "learning_starts": 8, "chunk": 4, "save_every": 2},
    )


Preset = Callable[[], Config]

PRESETS: dict[str, Preset] = {
    preset.__name__: preset
    for preset in (smoke, quick, fast, objects, objects_target, grippers, paper, paper_small)
}


def register(name: str, preset: Preset) -> None:
    """Makes `preset`, a function that returns a config, known as `name` to API and commands.
    Raises ValueError if the name is taken."""
    if name in PRESETS:
        raise ValueError(f"preset '{name}' exists; choose another name")
    PRESETS[name] = preset


def get(name: str) -> Config:
    """The preset `name`. Raises ValueError for an unknown name."""
    if name not in PRESETS:
        raise ValueError(unknown("preset", name, PRESETS))
    return PRESETS[name]().change(preset=name)
