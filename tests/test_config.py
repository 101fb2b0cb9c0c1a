"""A config that cannot work is refused as it is built, by the name of the setting. Nets, replay,
sensor, camera and algorithms have tables of their own beside their tests."""

import dataclasses
import re

import pytest

from csac_jax import presets
from csac_jax.config import Config

BOXES = ("box",) * 3


def _config(settings: dict) -> Config:
    """`quick` with settings by their dotted names."""
    cfg, sections = presets.quick(), {}
    for name, value in settings.items():
        section, _, field = name.rpartition(".")
        sections.setdefault(section, {})[field] = value
    own = sections.pop("", {})
    return dataclasses.replace(
        cfg,
        **own,
        **{
            name: dataclasses.replace(getattr(cfg, name), **each) for name, each in sections.items()
        },
    )


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("scene.slots", [("box", "ball", "box", "box", "box")]),
        ("scene.min_blocks", [0, 6]),
        ("scene.pool", [0]),
        ("scene.arranged", [-0.1, 1.1]),
        ("scene.size_jitter", [-0.1, 0.3]),
        ("scene.mesh_size_jitter", [-0.1, 0.3]),
        ("scene.density", [(50.0, 900.0), (900.0, 450.0), (450.0, 4000.0)]),
        ("scene.friction", [(0.05, 1.0), (1.0, 0.5), (0.5, 2.5)]),
        ("scene.drop_extent", [(0.04, 0.2), (0.2, 0.1), (0.2, 0.5)]),
        ("scene.drop_height", [0.04, 1.1]),
        ("scene.settle_time", [0.4, 21.0]),
        ("task.kind", ["stack"]),
        ("task.max_actions", [0]),
        ("task.max_steps_without_change", [0]),
        ("sim.physics", ["bullet"]),
        ("sim.robot", ["ur10"]),
        ("sim.timestep", [0.0004, 0.011]),
        ("sim.grasp_phases", [(0, 110, 80)]),
        ("sim.push_phases", [(50, 140, 0), (50, 90, 51)]),
        ("sim.iterations", [0]),
        ("sim.line_search", [0]),
        ("sim.geom_pairs", [0]),
        ("sim.contacts", [0]),
        ("sim.approach", [0.01, 0.4]),
        ("sim.grasp_depth", [0.0, 0.06]),
        ("sim.clearance", [0.0, 0.06]),
        ("sim.push_length", [0.0, 0.4]),
        ("sim.push_depth", [0.0, 0.06]),
        ("sim.window", [0.0, 0.2]),
        ("camera.scale", [0.0125]),
        ("camera.focal", [(7000.0, 7000.0)]),
        ("sensor.depth_floor", [-0.1, 0.2]),
        ("sensor.depth_square", [0.2]),
        ("sensor.dropped", [-0.1]),
        ("sensor.position", [-0.1, 0.2]),
        ("sensor.rotation", [-0.1, 0.3]),
        ("sensor.colour", [-0.1, 0.6]),
        ("heightmap.size", [8, 20]),
        ("heightmap.extent", [0.05, 1.1]),
        ("heightmap.view", ["side"]),
        ("net.rotations", [2, 5]),
        ("net.growth", [3]),
        ("net.stem", [3]),
        ("net.head", [3]),
        ("net.dilations", [(), (1, 0)]),
        ("net.margin", [-0.125, 0.625]),
        ("net.dtype", ["float16"]),
        ("net.zoom", [0]),
        ("net.output_stride", [0]),
        ("net.block_growth", [0]),
        ("cem.rounds", [0]),
        ("cem.std", [0.001, 2.1]),
        ("cem.std_min", [0.0]),
        ("target.gamma", [-0.1]),
        ("target.samples", [0]),
        ("target.std", [0.0]),
        ("target.clip", [0.0]),
        ("target.inverse_temperature", [-1.0]),
        ("reward.dead_band", [-0.1]),
        ("reward.nothing", [-0.4]),
        ("reward.lifted", [-0.1]),
        ("explore.epsilon_primitive_start", [-0.1, 1.1]),
        ("explore.epsilon_primitive_end", [-0.1, 1.1]),
        ("explore.epsilon_place_start", [-0.1, 1.1]),
        ("explore.epsilon_place_end", [-0.1, 1.1]),
        ("explore.push_fraction", [-0.1]),
        ("explore.decay", [0.0, 1.1]),
        ("explore.noise_std", [-0.1]),
        ("explore.noise_clip", [0.0]),
        ("learn.learning_rate", [0.0]),
        ("learn.actor_learning_rate", [0.0]),
        ("learn.actor_batch", [-1]),
        ("learn.lr_final_fraction", [0.0, 1.1]),
        ("learn.augment_shift", [-1, 65]),
        ("learn.augment_turn", [-0.1, 3.2]),
        ("learn.batch", [0]),
        ("learn.updates", [0]),
        ("learn.tau", [1.1]),
        ("learn.gradient_clip", [0.0]),
        ("learn.huber", [0.0]),
        ("replay.rank_by", ["age"]),
        ("train.scenes", [0]),
        ("train.actions", [0]),
        ("train.learning_starts", [0]),
        ("train.chunk", [0]),
        ("train.save_every", [0]),
        ("seed", [-1, 2**31]),
    ],
)
def test_values_out_of_range(name: str, values: list):
    """Claim: a value out of range, or none of the choices, is refused in one line that names
    section and setting."""
    section, _, field = name.rpartition(".")
    for value in values:
        with pytest.raises(ValueError, match=rf"^{section}.*\b{field}\b") as refused:
            _config({name: value})
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"train.learning_starts": 31},
            "learn.batch: 32 transitions cannot be drawn after train.learning_starts = 31",
        ),
        ({"replay.capacity": 31}, "replay.capacity: must hold"),
        ({"replay.capacity": 40, "train.scenes": 48}, "replay.capacity: must hold"),
        (
            {"sim.physics": "warp", "scene.mesh_size_jitter": 0.1},
            "scene.mesh_size_jitter: must be 0",
        ),
        (
            {
                "sim.physics": "warp",
                "train.scenes": 4097,
                "replay.capacity": 4097,
                "scene.slots": BOXES,
                "scene.min_blocks": 3,
            },
            "train.scenes: at most 4096",
        ),
        ({"scene.slots": ()}, "scene.slots: at least one"),
        ({"camera.size": (8192, 480)}, "camera.size: must lie"),
        (
            {"sensor.position": 0.01, "sensor.rotation": 0.01},
            "sensor.position, sensor.rotation: must be 0",
        ),
        ({"sensor.position": 0.01}, "sensor.position, sensor.rotation: must be 0"),
    ],
)
def test_settings_that_do_not_go_together(settings: dict, message: str):
    """Claim: settings that exclude one another are refused by the name of one of them, with what it
    takes."""
    with pytest.raises(ValueError, match=rf"^{re.escape(message)}"):
        _config(settings)


@pytest.mark.parametrize(
    "settings",
    [
        {"sim.physics": "warp", "scene.mesh_size_jitter": 0.0},
        {
            "sim.physics": "warp",
            "scene.mesh_size_jitter": 0.1,
            "scene.slots": BOXES,
            "scene.min_blocks": 3,
        },
        {"sim.physics": "warp", "train.scenes": 4096},
        {"sim.physics": "mjx", "train.scenes": 4097, "replay.capacity": 4097},
        {"sensor.position": 0.01, "heightmap.view": "oblique"},
        {"policy.primitive": "grasp", "explore.push_fraction": 0.0},
        {"net.kind": "densenet121", "net.norm": "batch", "net.weights": "x", "net.margin": 0.0},
    ],
)
def test_settings_that_go_together(settings: dict):
    """Claim: no more than that is refused."""
    assert _config(settings) != presets.quick()
