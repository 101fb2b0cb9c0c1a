"""Config to JSON and back."""

import dataclasses
import json
from typing import Any

import pytest

from csac_jax import presets
from csac_jax.config import Config, LearnConfig, SimConfig
from csac_jax.io import config_json


def _through_text(cfg: Config) -> dict[str, Any]:
    return json.loads(json.dumps(config_json.to_dict(cfg)))


@pytest.mark.parametrize("name", list(presets.PRESETS))
def test_config_survives_json(name: str):
    """Claim: a config comes back equal and hashable, tuples as tuples."""
    cfg = presets.get(name)
    back = config_json.from_dict(_through_text(cfg))
    assert back == cfg
    assert hash(back) == hash(cfg)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("learn.bath", 3, "learn.bath: unknown setting"),
        ("learn.batch", "3", "learn.batch: must be of type int"),
        ("learn.batch", 3.0, "learn.batch: must be of type int"),
        ("learn.batch", True, "learn.batch: must be of type int"),
        ("learn.tau", "x", "learn.tau: must be a number"),
        ("learn", 3, "learn: must be an object"),
        ("scene.slots", ["ball"], r"scene.slots\[0\]: must be one of"),
        ("sim.grasp_phases", [1, 2], "sim.grasp_phases: must be a list of 3"),
        ("replay.sampler", "best", "replay.sampler: must be one of"),
        ("learn.tau", 2.0, "learn.tau: must lie in"),
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
        config_json.from_dict(values)


def test_missing_setting_is_named():
    """Claim: a missing key is an error: no default is put in its place."""
    values = _through_text(Config())
    del values["cem"]["rounds"]
    with pytest.raises(ValueError, match=r"cem\.rounds: setting is missing"):
        config_json.from_dict(values)


def test_whole_number_is_a_float():
    """Claim: JSON's 1 is read as 1.0 where a float is wanted."""
    values = _through_text(Config())
    values["learn"]["huber"] = 1
    assert type(config_json.from_dict(values).learn.huber) is float


def test_differences_are_named_in_order():
    """Claim: differences are dotted names, in order of definition; equal configs have none."""
    a = Config()
    b = dataclasses.replace(
        a, seed=1, sim=SimConfig(iterations=5), learn=LearnConfig(batch=16, tau=0.1)
    )
    assert config_json.differences(a, b) == ["seed", "sim.iterations", "learn.batch", "learn.tau"]
    assert config_json.differences(a, Config()) == []
