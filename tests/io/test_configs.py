"""Config to JSON and back, and configs in files, against the presets and `Config.change`."""

import functools
import json
import re
import time
import tomllib
from pathlib import Path
from typing import Any

import pytest

import csac_jax
from csac_jax import algorithms, presets
from csac_jax.config import BetaReplay, Config, DenseNet121
from csac_jax.errors import SettingsError
from csac_jax.io import configs, files, renames
from csac_jax.sweeps import grid, runner

STORED = Path(__file__).parent / "formats" / "format-2.json"
SAVED = presets.quick().change(  # as it was when that file was written
    net={"growth": 32, "rotations": 16},
    policy={"augment": False},
    explore={"epsilon_place": (0.5, 0.0), "epsilon_decay": 0.998},
    learn={"updates_per_step": 2, "learning_rate": 1e-3, "augment_shift": 0},
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


def test_format_is_stored():
    """Claim: the format has a stored file, with the first names of its settings. It is read, and is
    written today under the names of today."""
    stored = json.loads(STORED.read_text())
    today = renames.current(stored)
    for section, former in renames.FIXED.items():
        assert former & today[section].keys()
        today[section] = {k: v for k, v in today[section].items() if k not in former}
    assert today == _through_text(SAVED) != stored
    assert configs.from_dict(stored) == SAVED


def test_missing_and_gone_settings():
    """Claim: a config without a setting, or a whole section, is read with the defaults, as is one
    from before trays and the limit of the force; one with a setting that is gone without it; JSON's
    1 is 1.0 where a float is wanted."""
    values = _through_text(presets.quick())
    del values["cem"]["rounds"], values["camera"], values["scene"]["tray"]
    for name in ("opening", "down_force", "approach", "pad_friction", "grip_force"):
        del values["sim"][name]
    values["target"]["samples"] = 8
    values["heightmap"]["view"] = "both"  # acts on maps from above
    values["learn"]["tau"] = 1
    assert configs.from_dict(values) == presets.quick().change(learn={"tau": 1.0})
    assert type(configs.from_dict(values).learn.tau) is float


def test_old_names_are_read(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Claim: settings, values and metrics by the names of `renames` are those of today: in stored
    configs, in a user's file, in a stored sweep and in `--vary`."""
    monkeypatch.setattr(renames, "SETTINGS", {"scene.packed": "task.kind", "learn.huber": None})
    texts = {"one": "target", "all:": "cl"}
    monkeypatch.setattr(renames, "VALUES", {"task.kind": texts})
    values = _through_text(presets.smoke())
    del values["task"]["kind"]
    values["scene"]["packed"] = "one"
    values["learn"]["huber"] = 3
    wanted = presets.smoke().change(task={"kind": "target"})
    assert configs.from_dict(values) == wanted
    path = tmp_path / "my.toml"
    path.write_text('preset = "smoke"\n[scene]\npacked = "one"\n[learn]\nhuber = 2\n')
    assert configs.load_config(path) == wanted
    (point, other) = grid.points(["scene.packed=one,all:ear"], lambda flags: presets.smoke())
    assert (point.values, other.values) == ({"task.kind": "target"}, {"task.kind": "clear"})
    plan = runner.SweepPlan(2, [point._replace(cfg=wanted, name="x")])
    older = plan._replace(points=[plan.points[0]._replace(values={"scene.packed": "one"})])
    (tmp_path / files.SWEEP_PLAN).write_text(runner.plan_text(older))
    assert runner.read_plan(tmp_path) == plan
    assert files.renamed({"a": {"ill": 1}}) == {"a": {"physics_diverged": 1}}


def test_former_settings_have_their_constants():
    """Claim: a stored config or a user's file may hold a former setting at the value of today, and
    is refused by its name with another value, or where the section never had it. A record's value
    is read."""
    stored = {"net": {"kind": "small", "stride": 4, "margin": 0.125}}
    dense = {"net": {"kind": "densenet121", "zoom": 2, "pad_fraction": 0.4286}}
    number = {"format": configs.FORMAT}
    wanted = Config().change(net={"stride": 4})
    assert configs.from_dict(number | stored) == wanted
    assert configs.from_dict(number | dense).net == DenseNet121()
    rest = {
        "cem": {"candidates": 16, "elites": 4, "start": "both"},
        "replay": {"start": [0.5, 0.5]},
    }
    assert configs.from_dict(number | rest) == Config().change(cem={"candidates": 16})
    for section, values, message in (
        ("net", {"margin": 0.5}, r"net\.pad_fraction: must be 0\.125, not 0\.5"),
        ("net", {"zoom": 2}, r"net\.upsample: unknown setting"),
        ("cem", {"elites": 4}, r"cem\.elites: must be 6, not 4"),
        ("replay", {"rank_by": "reward"}, r"replay\.rank_by: must be 'error', not 'reward'"),
        ("replay", {"middle": [1, 2]}, r"replay\.middle: must be \[1\.0, 1\.0\], not \[1, 2\]"),
        ("replay", {"sampler": "uniform", "middle": [1, 1]}, r"replay\.middle: unknown setting"),
    ):
        with pytest.raises(SettingsError, match=f"^{message}$"):
            configs.from_dict(number | stored | {section: stored.get(section, {}) | values})
    settings = configs.recorded(number | {"cem": {"start": "actor"}})
    assert (settings["cem.start"], settings["cem.elites"]) == ("actor", 6)


def _nested(depth: int) -> Any:
    return functools.reduce(lambda value, _: [value], range(depth), 0)


@pytest.mark.parametrize(
    ("section", "values", "message"),
    [
        ("learn", {"bath": 3}, r"learn\.bath: unknown setting"),
        ("learn", {"batch": "3"}, r"learn\.batch: input should be a valid integer"),
        ("learn", {"tau": 2.0}, r"learn\.tau: must be at most 1, not 2\.0"),
        ("scene", {"slots": ["ball"]}, r"scene\.slots\.0: input should be 'box'"),
        ("sim", {"grasp_phases": [1, 2]}, r"sim\.grasp_phases\.2: field required"),
        ("replay", {"sampler": "uniform", "end": [1, 2]}, r"replay\.end: unknown setting"),
        ("format", 1, "format: 1 is unknown, this version reads 2; use the csac-jax that wrote"),
        ("learn", {"tau": 10**400}, r"learn\.tau: must be at most 1, not inf"),
        ("net", {"dilations": [1] * 100_000}, r"net\.dilations: at most 64 items, not 100000"),
        ("learn", {"tau": _nested(100_000)}, "learn: is nested too deeply"),
        ("net", {"kind": ["small"]}, "net.kind: "),
        ("heightmap", {"view": "side"}, r"^heightmap\.view: input should be 'ortho' or 'oblique'"),
    ],
)
def test_bad_values_are_one_line(section: str, values: Any, message: str):
    """Claim: an unknown key, a wrong type, a value out of range, numbers beyond floats, lists
    without end and deep nesting are refused at once, in a short line that names the setting."""
    begun = time.monotonic()
    with pytest.raises(SettingsError, match=message) as caught:
        configs.from_dict({"format": configs.FORMAT, section: values})
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 200
    assert time.monotonic() - begun < 5.0


TOML = """
preset = "smoke"
seed = 3
[learn]
tau = 1
[replay]
sampler = "beta"
end = [1, 5]
[scene]
slots = ["box", "prism"]
"""
YAML = """
preset: smoke
seed: 3
learn: {tau: 1}
replay: {sampler: beta, end: [1, 5]}
scene: {slots: [box, prism]}
"""
WANTED = presets.smoke().change(
    seed=3,
    learn={"tau": 1.0},
    replay={"sampler": "beta", "end": (1.0, 5.0)},
    scene={"slots": ("box", "prism")},
)


def _file(folder: Path, text: str, suffix: str = ".toml") -> Path:
    path = folder / f"my{suffix}"
    path.write_bytes(text.encode(errors="surrogateescape"))
    return path


@pytest.mark.parametrize(
    ("suffix", "text"),
    [(".toml", TOML), (".yaml", YAML), (".yml", YAML), (".json", json.dumps(tomllib.loads(TOML)))],
    ids=("toml", "yaml", "yml", "json"),
)
def test_file_changes_its_preset(tmp_path: Path, suffix: str, text: str):
    """Claim: TOML, YAML and JSON say the same; other settings are the preset's; whole numbers are
    good where the setting is a fraction."""
    path = _file(tmp_path, text, suffix)
    assert configs.load_config(path) == configs.load_config(path, "smoke") == WANTED


def test_files_of_the_manual_load(tmp_path: Path):
    """Claim: every TOML file that the documentation shows is a config."""
    pages = Path(csac_jax.__file__).parents[1].glob("docs/**/*.md")
    shown = [one for page in pages for one in re.findall("(?s)```toml\n(.*?)```", page.read_text())]
    assert shown
    for text in shown:
        assert configs.load_config(_file(tmp_path, text)) != presets.quick()


def test_config_of_a_run_is_taken_whole(tmp_path: Path):
    """Claim: the config.json of a run gives its config, also of an unknown preset."""
    cfg = WANTED.change(preset="mine", algo="vpg", train={"actions": 128})
    path = _file(tmp_path, json.dumps(configs.to_dict(cfg)), ".json")
    assert configs.load_config(path) == cfg
    assert configs.load_config(path, algo="csac") == algorithms.configure(cfg, "csac")


def test_algorithm_comes_before_the_settings(tmp_path: Path):
    """Claim: `algo` of a file makes the preset one of that algorithm, one given elsewhere wins over
    it, and settings of the file win over both; another alternative of a section keeps the settings
    that both have."""
    path = _file(tmp_path, 'preset = "smoke"\nalgo = "vpg"\n[target]\ngamma = 0.3\n')
    for algo, wanted in ((None, "vpg"), ("csac", "csac")):
        base = algorithms.configure(presets.smoke(), wanted)
        assert configs.load_config(path, algo=algo) == base.change(target={"gamma": 0.3})
    path = _file(tmp_path, 'preset = "smoke"\nalgo = "csac"\n[replay]\nsampler = "beta"\n')
    capacity = presets.smoke().replay.capacity
    assert configs.load_config(path).replay == BetaReplay(capacity=capacity)


@pytest.mark.parametrize(
    ("suffix", "text", "message"),
    [
        (".toml", "[learn]\ntau = 0.1", r'preset: is missing; add one, such as preset = "quick"$'),
        (".toml", 'preset = "quik"', "unknown preset 'quik'; did you mean quick"),
        (".toml", "SMOKE[learn]\nbath = 3", r"learn\.bath: unknown setting$"),
        (".toml", 'SMOKElearn = "fast"', "learn: must be a section of settings, not 'fast'$"),
        (".toml", "SMOKE[learn\n", r"is no readable TOML \("),
        (".toml", "\udcff", ".*decode"),
        (".ini", "", "the name of a config file ends in .toml, .yaml, .yml, .json"),
        (".yaml", "a: &a [1]\nb: *a", "aliases"),
        (".yaml", "seed: !!python/object/apply:os.getpid []", "is no readable YAML"),
        (".json", "[" * 100_000, "is nested too deeply"),
    ],
)
def test_fault_names_file_and_key(tmp_path: Path, suffix: str, text: str, message: str):
    """Claim: a file that is no config, of another kind, with code, aliases or deep nesting is one
    line with the file's name and the key at fault; nothing in it is executed."""
    path = _file(tmp_path, text.replace("SMOKE", 'preset = "smoke"\n'), suffix)
    with pytest.raises(SettingsError, match=f"^{path}: {message}") as caught:
        configs.load_config(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("suffix", "text", "message"),
    [
        (".yaml", "preset: [" + "[" * 100_000, "has 100001 brackets, more than 1000"),
        (".toml", "a." * 50_000 + "a = 1", "has a line of 100005 characters"),
        (".toml", "#\n" * 2**17, "larger than 128 KiB"),
    ],
)
def test_texts_that_take_the_square_of_their_length(
    tmp_path: Path, suffix: str, text: str, message: str
):
    """Claim: nested lists without end, and keys of many parts, are refused within a second."""
    path = tmp_path / f"my{suffix}"
    path.write_text(text)
    begun = time.monotonic()
    with pytest.raises(SettingsError, match=message):
        configs.load_config(path)
    assert time.monotonic() - begun < 1.0
