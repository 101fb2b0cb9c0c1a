"""The table of algorithms, and what config refuses."""

import ast
import dataclasses
import re
from pathlib import Path

import pytest

from csac_jax import algorithms, presets
from csac_jax.config import Config
from csac_jax.io import configs

DOC = Path(__file__).parents[1] / "docs/paper.md"
NAMES = list(algorithms.ALGORITHMS)
SECTIONS = [field.name for field in dataclasses.fields(Config)]


@pytest.mark.parametrize("preset", list(presets.PRESETS))
def test_presets_are_csac_beta(preset):
    """Claim: a preset is CSAC-beta as it stands: to ask for that by name changes nothing."""
    cfg = presets.get(preset)
    assert algorithms.configure(cfg, "csac_beta") == cfg
    assert cfg.algo == "csac_beta"


@pytest.mark.parametrize("name", NAMES)
def test_algorithms_are_idempotent_and_survive_json(name):
    """Claim: to configure twice is to configure once; a config names its algorithm and comes back
    from JSON."""
    cfg = algorithms.configure(presets.quick(), name)
    assert cfg.algo == name
    assert algorithms.configure(cfg, name) == cfg
    assert configs.from_dict(configs.to_dict(cfg)) == cfg


@pytest.mark.parametrize("name", NAMES)
def test_sizes_stay_the_presets(name):
    """Claim: an algorithm changes nothing of scenes, physics, maps, nets, lengths, batches, rates
    and random places."""
    before, after = presets.quick(), algorithms.configure(presets.quick(), name)
    for section in ("scene", "sim", "heightmap", "net", "cem", "train"):
        assert getattr(before, section) == getattr(after, section)
    for field in ("batch", "updates_per_step", "learning_rate", "lr_final_fraction", "augment"):
        assert getattr(before.learn, field) == getattr(after.learn, field)
    for field in ("epsilon_place", "epsilon_decay"):
        assert getattr(before.explore, field) == getattr(after.explore, field)
    assert before.replay.capacity == after.replay.capacity


@pytest.mark.parametrize("preset", list(presets.PRESETS))
def test_vpg_as_its_authors_have_it(preset):
    """Claim: VPG bootstraps as in its code and replays opposite outcomes, by the power law; all
    baselines have the critics and the loss of the preset, as the CSAC family has."""
    cfg, own = presets.get(preset), algorithms.configure(presets.get(preset), "vpg")
    assert (own.target.bootstrap, own.replay.sampler) == ("continuing", "opposite")
    assert own.replay.law == (1.0, 2.0)
    for name in ("csac", "csac_per", "vpg", "reactive", "grasp_only"):
        learn = algorithms.configure(cfg, name).learn
        assert (learn.critics, learn.loss) == (cfg.learn.critics, cfg.learn.loss)


def _shown(cfg: Config, dotted: str) -> str:
    section, name = dotted.split(".")
    part = getattr(cfg, section)
    if name not in {field.name for field in dataclasses.fields(part)}:
        return ""
    value = getattr(part, name)
    return " ".join(f"{x:g}" for x in value) if isinstance(value, tuple) else str(value)


def table() -> list[str]:
    """Returns the rows of docs/paper.md: the settings of each algorithm on the preset `quick`."""
    variants = [algorithms.configure(presets.quick(), name) for name in NAMES]
    flat = [configs.differences(variants[0], cfg) for cfg in variants]
    names = {name for row in flat for name in row if "." in name}
    ordered = [name for row in flat for name in row if name in names]
    ordered = sorted(dict.fromkeys(ordered), key=lambda name: SECTIONS.index(name.split(".")[0]))
    head = ["| setting | " + " | ".join(NAMES) + " |", "|---" * (len(NAMES) + 1) + "|"]
    return head + [
        f"| `{name}` | " + " | ".join(_shown(cfg, name) for cfg in variants) + " |"
        for name in ordered
    ]


def test_document_has_the_table():
    """Claim: the table of docs/paper.md is what the functions do to `quick`, every setting that
    differs."""
    assert "\n".join(table()) in DOC.read_text()


def test_names_in_the_document_exist():
    """Claim: every function and test that docs/paper.md names is there."""
    named = re.findall(r"`([\w/]+\.py)(?:::(\w+))?`", DOC.read_text().replace("`tests/", "`"))
    assert len(named) > 50
    for file, function in named:
        folder = "tests" if Path(file).name.startswith("test_") else "csac_jax"
        tree = ast.parse((DOC.parents[1] / folder / file).read_text())
        names = {
            node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef)
        }
        assert not function or function in names, f"{file}::{function}"
