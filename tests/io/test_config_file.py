"""Configs in files of one's own, against the presets and against `Config.change`."""

import json
import re
import tomllib
from pathlib import Path

import pytest

import csac_jax
from csac_jax import algorithms, presets
from csac_jax.config import BetaReplay
from csac_jax.errors import SettingsError
from csac_jax.io import config_file, configs

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
replay:
  sampler: beta
  end: [1, 5]
scene:
  slots: [box, prism]
"""
WANTED = presets.smoke().change(
    seed=3,
    learn={"tau": 1.0},
    replay={"sampler": "beta", "end": (1.0, 5.0)},
    scene={"slots": ("box", "prism")},
)


def _file(folder: Path, text: str, suffix: str = ".toml") -> Path:
    path = folder / f"my{suffix}"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("suffix", "text"),
    [(".toml", TOML), (".yaml", YAML), (".yml", YAML), (".json", None)],
    ids=("toml", "yaml", "yml", "json"),
)
def test_settings_are_those_of_the_preset_but_for_the_files(
    tmp_path: Path, suffix: str, text: str | None
):
    """Claim: TOML, YAML and JSON say the same; what a file leaves out is the preset's; whole
    numbers are good where the setting is a fraction."""
    path = _file(tmp_path, text or json.dumps(tomllib.loads(TOML)), suffix)
    assert config_file.load_config(path) == WANTED
    assert config_file.load_config(path, "smoke") == WANTED


def test_files_of_the_manual_load(tmp_path: Path):
    """Claim: every TOML file that the documentation shows is a config."""
    pages = Path(csac_jax.__file__).parents[1].glob("docs/**/*.md")
    shown = [one for page in pages for one in re.findall("(?s)```toml\n(.*?)```", page.read_text())]
    assert shown
    for text in shown:
        assert config_file.load_config(_file(tmp_path, text)) != presets.quick()


def test_missing_file_is_named(tmp_path: Path):
    """Claim: a file that is not there, or a folder, is one line."""
    for path in (tmp_path / "no.toml", tmp_path / "folder.toml"):
        (tmp_path / "folder.toml").mkdir(exist_ok=True)
        with pytest.raises(SettingsError, match=f"^{path}: .*(No such file|folder)"):
            config_file.load_config(path, "smoke")


def test_config_of_a_run_is_taken_whole(tmp_path: Path):
    """Claim: the config.json of a run gives its config, also of a preset that is no more."""
    cfg = WANTED.change(preset="mine", algo="vpg", train={"actions": 128})
    path = _file(tmp_path, json.dumps(configs.to_dict(cfg)), ".json")
    assert config_file.load_config(path) == cfg
    assert config_file.load_config(path, algo="csac") == algorithms.configure(cfg, "csac")


def test_algorithm_comes_before_the_settings(tmp_path: Path):
    """Claim: `algo` of a file makes the preset one of that algorithm, one given elsewhere wins over
    it, and settings of the file win over both."""
    path = _file(tmp_path, 'preset = "smoke"\nalgo = "vpg"\n[target]\ngamma = 0.3\n')
    for algo, wanted in ((None, "vpg"), ("csac", "csac")):
        base = algorithms.configure(presets.smoke(), wanted)
        assert config_file.load_config(path, algo=algo) == base.change(target={"gamma": 0.3})


def test_alternative_takes_over_what_it_shares(tmp_path: Path):
    """Claim: another alternative of a section keeps the settings that both have."""
    path = _file(tmp_path, 'preset = "smoke"\nalgo = "csac"\n[replay]\nsampler = "beta"\n')
    assert config_file.load_config(path).replay == BetaReplay(
        capacity=presets.smoke().replay.capacity
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[learn]\ntau = 0.1", r'preset: is missing; add one, such as preset = "quick"$'),
        ('preset = "quik"', "unknown preset 'quik'; did you mean quick"),
        ('preset = "quick"', "preset: is 'quick'; leave out smoke, or change the file$"),
        ("preset = 3", "preset: is missing"),
        ("[learn]\nbath = 3", r"learn\.bath: unknown setting$"),
        ("[lern]\nbatch = 3", "lern: unknown setting$"),
        ('learn = "fast"', "learn: must be a section of settings, not 'fast'$"),
        ("[learn]\ntau = 2.0", r"learn\.tau: must be above 0, at most 1, not 2\.0$"),
        ("[learn]\ntau = nan", r"learn\.tau: "),
        ('[learn]\ntau = "1e-3"', r"learn\.tau: input should be a valid number, not '1e-3'$"),
        ("[learn]\nbatch = 2020-01-01", r"learn\.batch: input should be a valid integer"),
        ("seed = true", "seed: input should be a valid integer, not True$"),
        ('[replay]\nsampler = "best"', r"replay\.sampler: 'best' is not one of: uniform"),
        ('[replay]\nsampler = "uniform"\nend = [1, 2]', r"replay\.end: unknown setting$"),
        ('algo = "dqn"', "unknown algorithm 'dqn'; choose one of"),
        ("format = 9", "format: 9 is unknown, this version reads up to"),
        ("[learn\n", r"is no readable TOML \("),
    ],
)
def test_fault_names_file_and_key(tmp_path: Path, text: str, message: str):
    """Claim: a file that is no config is one line with the file's name and the key at fault."""
    named = "preset" in text or "preset" in message
    path = _file(tmp_path, text if named else f'preset = "smoke"\n{text}')
    given = "smoke" if "leave out smoke" in message else None
    with pytest.raises(SettingsError, match=f"^{path}: {message}") as caught:
        config_file.load_config(path, given)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("suffix", "text", "message"),
    [
        (".ini", "", "the name of a config file ends in .toml, .yaml, .yml, .json"),
        (".yaml", "a: [1", "is no readable YAML"),
        (".yaml", "- 1", "must hold settings by name"),
        (".yaml", "a: &a [1]\nb: *a", "aliases"),
        (".yaml", "seed: !!python/object/apply:os.getpid []", "is no readable YAML"),
        (".json", "{", "is no readable JSON"),
        (".json", "[" * 100_000, "is nested too deeply"),
        (".yaml", "[" * 1_500, "is "),
        (".toml", "\udcff", "decode"),
    ],
)
def test_hostile_file_is_refused(tmp_path: Path, suffix: str, text: str, message: str):
    """Claim: a file of another kind, with code, aliases or too deep a nest is one line, and nothing
    in it is executed."""
    path = tmp_path / f"my{suffix}"
    path.write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(SettingsError, match=message) as caught:
        config_file.load_config(path, "smoke")
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
