"""The points of a sweep: every combination of the varied values. Needs no JAX."""

import dataclasses
import difflib
import itertools
import math
import re
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from csac_jax.algorithms import unknown
from csac_jax.config import Config
from csac_jax.errors import SettingsError
from csac_jax.io import renames
from csac_jax.section import ALTERNATIVES, Section, require

LONGEST = 120  # characters of a point's name, which is a folder's
MOST_RUNS = 10_000  # of a sweep, ours: more is a slip of the pen
TASKS: dict[str, dict[str, Any]] = {
    "clear": {"task.kind": "clear", "scene.packed_fraction": 0.0},
    "target": {"task.kind": "target", "scene.packed_fraction": 0.0},
    "packed": {"task.kind": "clear", "scene.packed_fraction": 1.0},
}
"""Values of the varied name `task`: a task and its scenes."""
_OBLIQUE = {"heightmap.view": "oblique"}
_NOISE = {
    "sensor.depth_noise": (0.001, 0.0014),  # of a structured-light camera, see `SensorConfig`
    "sensor.dropped": 0.02,
    "sensor.pose_noise": (0.001, 0.002),
    "sensor.colour": 0.05,
}
SWITCHES: dict[str, dict[str, Any]] = {
    "none": {},
    "sensed": {"reward.outcome_source": "sensors"},
    "anywhere": {"policy.action_mask": "none"},
    "oblique": _OBLIQUE,
    "noisy": _OBLIQUE | _NOISE,
    "ur5": {"sim.robot": "ur5"},
}
SWITCHES["together"] = {name: value for item in SWITCHES.values() for name, value in item.items()}
"""Values of the varied name `switch`: settings nearer to a robot; camera errors are ours."""
BUNDLES = {"task": TASKS, "switch": SWITCHES}  # varied names that stand for several settings
_VALUE = re.compile(r"([^./-]|-?\.?\d|-inf)[^/]*")  # a negative number is no flag


class SweepPoint(NamedTuple):
    """A combination of the varied values."""

    name: str  # as in `learn.tau=0.01,replay.sampler=beta`; of its folder
    values: dict[str, str]  # setting -> value, as given
    cfg: Config  # with the first seed


def points(varied: Sequence[str], configure: Callable[[list[str]], Config]) -> list[SweepPoint]:
    """Combines the values of `NAME=A,B,...`; the last name's values change fastest. `configure`
    makes a config of flags. Colons separate the items of a tuple, as in `replay.end=1:4,1:12`.
    Raises SettingsError for what cannot be varied."""
    axes = dict(map(_axis, varied))
    if len(axes) < len(varied):
        raise SettingsError("vary: a setting is given twice; name it once, with all its values")
    flags = lambda values: [flag for item in values.items() for flag in _flags(*item)]  # noqa: E731
    return combine(axes, lambda values: configure(flags(values)))


def combine(
    axes: Mapping[str, Sequence[Any]], configure: Callable[[dict[str, Any]], Config]
) -> list[SweepPoint]:
    """Makes a point of every combination, setting -> value; `configure` makes its config. Points
    are numbered if one has a name that is too long for a folder. Raises SettingsError for too
    many."""
    if math.prod(map(len, axes.values())) > MOST_RUNS:
        raise SettingsError(f"vary: more than {MOST_RUNS} combinations; leave some values out")
    points: list[SweepPoint] = []
    for combination in itertools.product(*axes.values()):
        values = dict(zip(axes, combination, strict=True))
        texts = {setting: str(value) for setting, value in values.items()}
        name = ",".join(map("=".join, texts.items())) or "base"
        points.append(SweepPoint(name, texts, configure(values)))
    if all(len(point.name) <= LONGEST for point in points):
        return points
    return [point._replace(name=f"setting-{i}") for i, point in enumerate(points)]


def _axis(text: str) -> tuple[str, list[str]]:
    name, equals, rest = text.partition("=")
    name, values = name.replace("-", "_"), rest.split(",")
    if not equals or not all(values):
        raise SettingsError(f"vary {text}: give a setting and its values: learn.tau=0.01,0.02")
    values = [renames.current_setting(name, value)[1] for value in values]
    name, _ = renames.current_setting(name, values[0])
    kind_of(name)
    require(len(set(values)) == len(values), f"vary {text}: a value is given twice")
    form = "a value holds no slash and begins with no dot or dash"
    require(all(map(_VALUE.fullmatch, values)), f"vary {text}: {form}")
    return name, values


def kind_of(name: str) -> object:
    """Returns the type of a setting by its dotted name; SettingsError if it cannot be varied."""
    require(name != "seed", "vary: leave seed out; give the number of seeds")
    kinds: dict[str, object] = {"algo": str, **dict.fromkeys(BUNDLES, str)}
    for section, default in vars(Config()).items():
        alternatives: Any = ALTERNATIVES.get(section, ("", (type(default),)))[1]
        for kind in alternatives if isinstance(default, Section) else ():
            hints, fields = typing.get_type_hints(kind), dataclasses.fields(kind)
            kinds |= {f"{section}.{field.name}": hints[field.name] for field in fields}
    if name not in kinds:
        near = difflib.get_close_matches(name, kinds, 1)
        hint = f"perhaps you meant {near[0]}" if near else "see docs/reference/settings.md"
        raise SettingsError(f"vary: '{name}' is no setting; {hint}")
    return kinds[name]


def settings_of(name: str, value: Any) -> dict[str, Any]:
    """Returns the settings that a varied name stands for: those of a bundle, or itself."""
    if name not in BUNDLES:
        return {name: value}
    require(value in BUNDLES[name], unknown(name, str(value), BUNDLES[name]))
    return BUNDLES[name][value]


def _flags(name: str, value: str) -> list[str]:
    if name in BUNDLES:
        settings = settings_of(name, value)
        return [flag for key, item in settings.items() for flag in _flags(key, _text(item))]
    flag = "--" + name.replace("_", "-")
    if kind_of(name) is bool:
        is_bool = value in ("true", "false")
        require(is_bool, f"vary {name}: {value!r} is neither true nor false")
        section, _, field = flag.rpartition(".")
        return [flag if value == "true" else f"{section}.no-{field}"]
    items = value.split(":") if typing.get_origin(kind_of(name)) is tuple else [value]
    return [flag, *items]


def _text(value: Any) -> str:
    return ":".join(map(str, value)) if isinstance(value, tuple) else str(value)
