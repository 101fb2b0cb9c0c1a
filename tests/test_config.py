"""A config that cannot work is refused as it is built, by the name of the setting."""

import dataclasses
import math
import re

import jax
import pytest
from tyro import _docstrings

from csac_jax import algorithms, presets, section
from csac_jax.config import Config
from csac_jax.io import configs

NOT_FINITE = [math.inf, math.nan, 10**400]


def _config(settings: dict) -> Config:
    """Returns `quick` with settings by their dotted names."""
    sections = {}
    for name, value in settings.items():
        section, _, field = name.rpartition(".")
        sections.setdefault(section, {})[field] = value
    own = sections.pop("", {})
    return presets.quick().change(**own, **sections)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("scene.slots", [("box", "ball", "box", "box", "box"), ("box",) * 65]),
        ("scene.min_blocks", [0, 6]),
        ("scene.tray", [-0.1]),
        ("scene.packed_fraction", [-0.1, 1.1]),
        ("scene.certified_fraction", [0.0, 1.1]),
        ("scene.size_jitter", [(-0.1, 0.0), (0.3, 0.0), (0.0, 0.3)]),
        ("scene.density", [(50.0, 900.0), (900.0, 450.0), (450.0, 4000.0)]),
        ("scene.friction", [(0.05, 1.0), (1.0, 0.5), (0.5, 2.5)]),
        ("scene.drop_extent", [(0.04, 0.2), (0.2, 0.1), (0.2, 0.5)]),
        ("cem.candidates", [3]),
        *(("policy.place", ["best"]), ("policy.primitive", ["push"])),
        *(("target.value", ["mean"]), ("reward.push_label", ["depth"])),
        *(("reward.lost_block_penalty", [-1.0]), ("learn.loss", ["mse"])),
        *(("learn.critics", [0, 3]), ("task.kind", ["stack"])),
        ("sim.physics", ["bullet"]),
        ("sim.down_force", [0.0, -1.0, math.nan]),
        ("sim.grasp_phases", [(0, 110, 80)]),
        ("camera.focal", [(7000.0, 7000.0)]),
        ("sensor.depth_noise", [(-0.1, 0.0), (0.2, 0.0), (0.0, 0.2)]),
        ("sensor.pose_noise", [(-0.1, 0.0), (0.0, 0.3)]),
        ("sensor.grey", [-0.1, 1.1]),
        ("sensor.kind", ["d400"]),
        ("sensor.dropped", [1.0]),
        ("heightmap.size", [8, 20, 60]),
        ("heightmap.view", ["side"]),
        ("heightmap.extent", [0.05, 1.1]),
        ("net.rotations", [2, 5, 202]),
        ("net.dilations", [(), (1, 0)]),
        ("net.stride", [3]),
        ("net.subpixel", [3]),
        ("policy.retry_temperature", [-0.1, 11.0]),
        ("policy.height_bonus", [-0.1, 101.0]),
        ("target.gamma", [-0.1, 1.0]),
        ("reward.grasp_levels", [(-0.4, -0.5, -0.25, 0.0, 1.0), (-1.0, -0.5, -0.25, 0.0, -0.1)]),
        ("explore.epsilon_primitive", [(-0.1, 0.1), (0.5, 1.1)]),
        ("explore.push_fraction", [-0.1]),
        ("explore.epsilon_decay", [0.0, 1.1]),
        ("explore.noise_std", [-0.1]),
        ("learn.learning_rate", [0.0, *NOT_FINITE]),
        ("learn.actor_learning_rate", NOT_FINITE),
        ("reward.success_bonus", NOT_FINITE),
        ("learn.lr_final_fraction", [0.0, 1.1]),
        ("learn.augment_shift", [-1, 65]),
        ("learn.tau", [0.0, 1.1]),
        ("replay.capacity", [0, 1, 2**30 + 1, float("nan")]),
        ("replay.end", [(0.0, 1.0)]),
        ("replay.sampler", ["best"]),
        ("net.kind", ["resnet"]),
        ("seed", [-1, 2**31]),
    ],
)
def test_values_out_of_range(name: str, values: list):
    """Claim: a value out of range, infinite, larger than a float can be, or none of the choices, is
    refused in one short line that names section and setting."""
    section, _, field = name.rpartition(".")
    for value in values:
        with pytest.raises(ValueError, match=rf"^{section}.*\b{field}\b") as refused:
            _config({name: value})
        assert "\n" not in str(refused.value)
        assert len(str(refused.value)) < 150


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"train.learning_starts": 31}, "learn.batch: 32 transitions cannot be drawn"),
        ({"replay.capacity": 31}, "replay.capacity: must hold"),
        ({"replay.capacity": 40, "train.scenes": 48}, "replay.capacity: must hold"),
        ({"sim.physics": "warp", "scene.size_jitter": (0.0, 0.1)}, "scene.size_jitter: the second"),
        ({"scene.slots": ()}, "scene.slots: at least one"),
        ({"camera.size": (8192, 480)}, "camera.size: must be at most 4096"),
        ({"camera.size": (320, 240)}, "camera.centre: "),
        ({"camera.focal": (618.0, 300.0)}, "camera.focal: "),
        ({"camera.position": (0.0, 0.0, 0.7)}, "camera.position: "),
        ({"sensor.pose_noise": (0.01, 0.0)}, "sensor.pose_noise: must be 0"),
        ({"net.subpixel": 4, "net.stride": 2}, "net.subpixel: at most net.stride"),
        ({"heightmap.size": 2**31}, "heightmap.size: must be at most 1024"),
        ({"heightmap.size": 1024, "net.rotations": 32}, "heightmap.size: its square times net"),
        ({"net.growth": 10**9}, "net.growth: must be at most 1024"),
        ({"learn.actor_batch": 33}, "learn.actor_batch: must not exceed learn.batch"),
        ({"policy.primitive": "grasp"}, "explore.push_fraction: must be 0"),
        (
            {"reward.push_label": "current_critic", "target.bootstrap": "continuing"},
            "reward.push_label: current_critic needs target.bootstrap episodic",
        ),
        ({"learn.bath": 3}, "learn.bath: unknown setting"),
        ({"net.norm": "batch"}, "net.norm: unknown setting"),
        ({"net.kind": "densenet121", "net.stem": 16}, "net.stem: unknown setting"),
        (
            {"net.kind": "densenet121", "net.norm": "layer"},
            "net.norm: 'layer' is not one of: group",
        ),
        ({"sensor.kind": "d415"}, "sensor.kind: must be none where"),
        ({"sensor.intrinsics_noise": (0.0, 0.01)}, "sensor.intrinsics_noise: "),
        ({"scene.tray": 0.44}, "scene.tray: with its walls 0.46 m, "),
        ({"scene.tray": 0.2}, "scene.tray: at least scene.drop_extent, 0.248 m"),
        ({"scene.tray": 0.3, "scene.packed_fraction": 0.5}, "scene.packed_fraction: must be 0"),
        (
            {"reward.outcome_source": "sensors", "reward.lost_block_penalty": 1.0},
            "reward.lost_block_penalty: must be 0 where",
        ),
        (
            {"scene.slots": ("object",), "scene.min_blocks": 1},
            "scene.objects: slots of kind object need a library",
        ),
        ({"bath": 3}, "bath: unknown setting"),
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
        {"sim.physics": "warp", "scene.size_jitter": (0.1, 0.0)},
        {"sim.physics": "warp", "scene.slots": ("box",) * 5, "scene.size_jitter": (0.1, 0.1)},
        {"sensor.pose_noise": (0.01, 0.0), "heightmap.view": "oblique"},
        {"policy.primitive": "grasp", "explore.push_fraction": 0.0},
        {"net.kind": "densenet121", "net.norm": "batch"},
    ],
)
def test_settings_that_go_together(settings: dict):
    """Claim: no more than that is refused."""
    assert _config(settings) != presets.quick()


def test_traced_settings_are_not_checked():
    """Claim: a section may hold traced numbers, out of range or not, so that a sweep passes them as
    arguments."""

    def inside(tau: jax.Array) -> jax.Array:
        return presets.quick().change(learn={"tau": tau}).learn.tau * 2.0

    assert jax.jit(inside)(3.0) == 6.0
    with pytest.raises(ValueError, match=r"^learn\.tau: "):
        inside(3.0)


def _fields() -> dict[str, tuple[type, dataclasses.Field]]:
    """The class and the field of every setting, those of all alternatives, by dotted names."""
    named = {}
    for name, default in vars(Config()).items():
        if isinstance(default, section.Section):
            _, kinds = section.ALTERNATIVES.get(name, ("", (type(default),)))
            for kind in kinds:
                named |= {
                    f"{name}.{field.name}": (kind, field) for field in dataclasses.fields(kind)
                }
        elif name != "parts":  # a record
            named[name] = Config, Config.__dataclass_fields__[name]
    return named


def test_at_most_105_settings():
    """Claim: there are at most 105 settings, those of all alternatives counted."""
    assert len(_fields()) <= 105


def test_settings_that_no_preset_turns_say_whom_they_are_for():
    """Claim: the text of a setting that no preset and no algorithm turns, or of its section, ends
    with whom it is for; there are at most 24."""
    turned = {"preset", "algo"}
    for preset in map(presets.get, presets.PRESETS):
        for algo in algorithms.ALGORITHMS:
            turned |= set(configs.differences(Config(), algorithms.configure(preset, algo)))
    kept = {name: of for name, of in _fields().items() if name not in turned}
    assert 10 <= len(kept) <= 24
    for name, (kind, field) in kept.items():
        text = _docstrings.get_field_docstring(kind, field.name, ()) or ""
        assert re.search(r"\bfor [\w` ,]+\)", f"{text} {kind.__doc__}"), name
