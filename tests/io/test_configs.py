"""Config to JSON and back."""

import dataclasses
import json
import math
import time
from pathlib import Path
from typing import Any

import pytest

from csac_jax import algorithms, presets
from csac_jax.config import Config, LearnConfig, SimConfig, UniformReplay
from csac_jax.io import configs, renames

FORMATS = Path(__file__).parent / "formats"
SAVED = presets.quick().change(  # as it was when the files there were written
    net={"growth": 32, "rotations": 16},
    policy={"augment": False},
    explore={"decay": 0.998},
    learn={"updates": 2, "learning_rate": 1e-3},
)


def _through_text(cfg: Config) -> dict[str, Any]:
    return json.loads(json.dumps(configs.to_dict(cfg)))


@pytest.mark.parametrize("name", list(presets.PRESETS))
def test_config_survives_json(name: str):
    """Claim: a config comes back equal and hashable, tuples as tuples."""
    cfg = presets.get(name)
    back = configs.from_dict(_through_text(cfg))
    assert back == cfg
    assert hash(back) == hash(cfg)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("learn.bath", 3, "learn.bath: unknown setting"),
        ("learn.batch", "3", "learn.batch: input should be a valid integer"),
        ("learn.batch", 3.0, "learn.batch: input should be a valid integer"),
        ("learn.batch", True, "learn.batch: input should be a valid integer"),
        ("learn.tau", "x", "learn.tau: input should be a valid number"),
        ("learn", 3, "learn: input should be an object"),
        ("scene.slots", ["ball"], r"scene.slots.0: input should be 'box'"),
        ("sim.grasp_phases", [1, 2], "sim.grasp_phases.2: field required"),
        ("replay.sampler", "best", "replay.sampler: 'best' is not one of: uniform, prioritised"),
        ("replay.alpha", 0.5, "replay.alpha: unknown setting"),
        ("learn.tau", 2.0, "learn.tau: must be above 0"),
        ("format", 3, "format: 3 is unknown"),
    ],
)
def test_what_does_not_fit_is_named(path: str, value: Any, message: str):
    """Claim: an unknown key, a wrong type or a value out of range is an error that names the
    setting."""
    values = _through_text(Config())
    *parents, last = path.split(".")
    place = values
    for parent in parents:
        place = place[parent]
    place[last] = value
    with pytest.raises(ValueError, match=message):
        configs.from_dict(values)


def test_missing_settings_take_their_defaults():
    """Claim: a config without a setting, or a whole section, is read with the defaults."""
    values = _through_text(presets.quick())
    del values["cem"]["rounds"], values["camera"]
    assert configs.from_dict(values) == presets.quick()


def test_whole_number_is_a_float():
    """Claim: JSON's 1 is read as 1.0 where a float is wanted."""
    values = _through_text(Config())
    values["learn"]["tau"] = 1
    assert type(configs.from_dict(values).learn.tau) is float


def test_differences_are_named_in_order():
    """Claim: differences are dotted names, in order of definition; equal configs have none."""
    a = Config()
    b = dataclasses.replace(
        a, seed=1, sim=SimConfig(contacts=5), learn=LearnConfig(batch=16, tau=0.1)
    )
    assert configs.differences(a, b) == ["seed", "sim.contacts", "learn.batch", "learn.tau"]
    assert configs.differences(a, Config()) == []


@pytest.mark.parametrize("number", [1, 2])
def test_every_format_is_read(number: int):
    """Claim: a config of every format that was ever written is read: `quick` as it was saved."""
    stored = json.loads((FORMATS / f"format-{number}.json").read_text())
    assert stored.get("format", 1) == number
    assert configs.from_dict(stored) == SAVED


def test_first_configs_of_format_2_are_read():
    """Claim: so is one of format 2 with settings that are constants now, unless its value is
    another that a policy acts by."""
    stored = json.loads((FORMATS / "format-2-first.json").read_text())
    assert configs.from_dict(stored) == SAVED
    stored["target"]["samples"] = 8
    assert configs.from_dict(stored) == SAVED
    stored["reward"]["eta"] = [0.5, 1.0]
    with pytest.raises(ValueError, match=r"^reward\.eta: is \[0\.0, 1\.0\] now"):
        configs.from_dict(stored)
    paper = configs.to_dict(presets.paper())
    paper["net"]["block_layers"] = [6, 12, 24, 16]
    assert configs.from_dict(paper) == presets.paper()
    paper["net"]["block_layers"] = [6, 12, 48, 32]
    with pytest.raises(ValueError, match=r"^net\.block_layers: is \[6, 12, 24, 16\] now"):
        configs.from_dict(paper)


@pytest.mark.parametrize("file", ["format-1.json", "format-2-first.json"])
def test_former_vpg_keeps_what_it_was(file: str):
    """Claim: a stored config of the algorithm `vpg` from before it was changed is one of
    `vpg_episodic`; one of today's keeps its name."""
    stored = json.loads((FORMATS / file).read_text()) | {"algo": "vpg"}
    assert configs.from_dict(stored).algo == "vpg_episodic"
    today = algorithms.configure(presets.quick(), "vpg")
    assert configs.from_dict(_through_text(today)) == today


def test_newest_format_is_stored():
    """Claim: the newest format has a stored file, which is what is written today."""
    stored = json.loads((FORMATS / f"format-{renames.FORMAT}.json").read_text())
    assert stored == _through_text(SAVED)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"learn.target_update": "hard", "learn.copy_every": 7}, {"learn.tau": 1.0}),
        ({"replay.sampler": "uniform"}, {"replay": UniformReplay()}),
        ({"reward.left": 3.0, "reward.lifted": 2.0}, {"reward.lost_block_penalty": 3.0}),
        ({"camera.scale": 0.5}, {"camera.size": (320, 240), "camera.centre": (159.5, 119.5)}),
        ({"scene.drop_extent": 0.2}, {"scene.drop_extent": (0.2, 0.2)}),
        ({"train.max_idle": 10}, {}),
        ({"target.samples": 8}, {}),
    ],
)
def test_format_1_is_translated(changes: dict[str, Any], expected: dict[str, Any]):
    """Claim: settings of format 1 that have another name, form or place today keep their
    meaning."""
    values = json.loads((FORMATS / "format-1.json").read_text())
    for name, value in changes.items():
        section, field = name.split(".")
        values[section][field] = value
    cfg = configs.from_dict(values)
    for name, value in expected.items():
        found: Any = cfg
        for part in name.split("."):
            found = getattr(found, part)
        assert found == value


@pytest.mark.parametrize(
    ("name", "value"), [("sim.timestep", 0.002), ("net.border", True), ("explore.noise_clip", 0.5)]
)
def test_format_1_with_what_is_gone_is_refused(name: str, value: Any):
    """Claim: a constant or gone setting is refused if a file needs another value."""
    values = json.loads((FORMATS / "format-1.json").read_text())
    section, field = name.split(".")
    values[section][field] = value
    with pytest.raises(ValueError, match=rf"^{name}: "):
        configs.from_dict(values)


def _refused(values: Any, message: str) -> None:
    begun = time.monotonic()
    with pytest.raises(ValueError, match=message) as caught:
        configs.from_dict(values)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 200
    assert time.monotonic() - begun < 5.0


def _nested(depth: int) -> Any:
    value: Any = 0
    for _ in range(depth):
        value = [value]
    return value


@pytest.mark.parametrize(
    ("section", "values", "message"),
    [
        ("learn", {"tau": 10**400}, r"learn\.tau: must be finite, not inf"),
        ("learn", {"learning_rate": math.nan}, r"learn\.learning_rate: must be finite|not nan"),
        ("train", {"actions": 10**400}, r"train\.actions: must be at most 9007199254740992"),
        ("net", {"dilations": [1] * 100_000}, r"net\.dilations: at most 64 items, not 100000"),
        ("scene", {"slots": ["box"] * 100_000}, r"scene\.slots: at most 64 items, not 100000"),
        ("learn", {"tau": _nested(500)}, r"learn: "),
        ("learn", {"tau": _nested(100_000)}, "learn: is nested too deeply"),
        ("learn", {f"k{i}": i for i in range(20_000)}, r"learn\.k0: unknown setting"),
        ("net", {"kind": ["small"]}, "net.kind: "),
        ("net", {"kind": "small", "": 1}, "net.: unknown setting"),
        ("learn", {"": "csac"}, "learn.: unknown setting"),
    ],
)
def test_hostile_values_are_one_line(section: str, values: dict[str, Any], message: str):
    """Claim: numbers beyond floats, lists without end, deep nesting and thousands of keys are
    refused at once, in one short line."""
    _refused({"format": renames.FORMAT, section: values}, message)


@pytest.mark.parametrize("number", [1, renames.FORMAT])
def test_thousands_of_sections_are_one_line(number: int):
    """Claim: 20,000 sections are refused as fast as one."""
    _refused(
        {"format": number, **{f"k{i}": {"a": 1} for i in range(20_000)}}, "k0.*: unknown setting"
    )


@pytest.mark.parametrize(
    ("section", "values"),
    [
        ("sim", {"grasp_phases": 5}),
        ("sim", {"push_phases": None}),
        ("explore", {"noise_std": "a", "noise_clip": 1.0}),
        ("camera", {"scale": "a"}),
        ("camera", {"scale": 0.5, "size": 3}),
    ],
)
def test_old_format_with_other_kinds_of_values(section: str, values: dict[str, Any]):
    """Claim: a file of the old format whose values are of other kinds is one line."""
    _refused({section: values}, "old format has a value of another kind")
