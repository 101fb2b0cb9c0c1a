"""Points of a sweep from varied values."""

import pytest

from csac_jax import presets
from csac_jax.cli import settings
from csac_jax.cli.sweep import SweepOptions
from csac_jax.config import Config
from csac_jax.errors import SettingsError
from csac_jax.io import configs
from csac_jax.sweeps import grid
from csac_jax.training import programs


def _points(varied: list[str]) -> list[grid.SweepPoint]:
    """Points with their flags in place of a config."""
    return grid.points(varied, lambda flags: flags)


def test_kinds_of_values():
    """Claim: colons separate the items of a tuple, switches are true or false, the algorithm is
    varied by its name; with nothing to vary there is one point."""
    flags = [point.cfg for point in _points(["replay.end=1:4,1:12"])]
    assert flags == [["--replay.end", "1", "4"], ["--replay.end", "1", "12"]]
    flags = [point.cfg for point in _points(["learn.actor=true,false"])]
    assert flags == [["--learn.actor"], ["--learn.no-actor"]]
    assert _points(["algo=csac_per"])[0].cfg == ["--algo", "csac_per"]
    assert _points([]) == [grid.SweepPoint("base", {}, [])]


def test_tasks_are_several_settings():
    """Claim: a task is varied by its name, which stands for a task and its scenes; an
    unknown one is refused with the nearest."""
    flags = {point.values["task"]: point.cfg for point in _points(["task=clear,target,packed"])}
    assert flags == {
        "clear": ["--task.kind", "clear", "--scene.packed-fraction", "0.0"],
        "target": ["--task.kind", "target", "--scene.packed-fraction", "0.0"],
        "packed": ["--task.kind", "clear", "--scene.packed-fraction", "1.0"],
    }
    with pytest.raises(ValueError, match="unknown task 'pack'; did you mean packed"):
        _points(["task=pack"])


def test_switches_are_changes_of_the_preset():
    """Claim: each switch changes settings of its own and no other, alike in flags and in configs;
    `none` changes nothing, `together` is all of them."""
    base = presets.get("paper_small")
    varied = f"switch={','.join(grid.SWITCHES)}"

    def configure(flags: list[str]) -> Config:
        return settings.parse(SweepOptions, "sweep", base, flags)[1]

    found = {point.values["switch"]: point.cfg for point in grid.points([varied], configure)}
    changed = {name: dict(grid.settings_of("switch", name)) for name in found}
    for name, cfg in found.items():
        assert cfg == programs.replace_settings(base, changed[name])
        assert set(configs.differences(base, cfg)) == set(changed[name])
    assert changed["none"] == {}
    assert len({str(sorted(each)) for each in changed.values()}) == len(grid.SWITCHES)
    assert set(changed["together"]) == set().union(*changed.values())
    with pytest.raises(ValueError, match="unknown switch 'ur'; did you mean ur5"):
        _points(["switch=ur"])


@pytest.mark.parametrize(
    ("varied", "message"),
    [
        (["learn.tua=1"], "'learn.tua' is no setting; perhaps you meant learn.tau"),
        (["learn=1"], "'learn' is no setting"),
        (["seed=1,2"], "leave seed out"),
        (["learn.tau"], "give a setting and its values"),
        (["learn.tau=0.1,,0.2"], "give a setting and its values"),
        (["learn.tau=0.1,0.1"], "a value is given twice"),
        (["learn.tau=0.1", "learn.tau=0.2"], "a setting is given twice"),
        (["learn.actor=yes"], "neither true nor false"),
        (["algo=a/b"], "slash"),
        (["algo=.."], "begins with no dot"),
        (["algo=--seed"], "begins with no dot or dash"),
    ],
)
def test_bad_input(varied: list[str], message: str):
    """Claim: what cannot be varied is named, with the remedy."""
    with pytest.raises(SettingsError, match=message):
        _points(varied)
