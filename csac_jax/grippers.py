"""A gripper as numbers: what planning, judging and drawing need of it, without its MJCF.

    GRIPPER/gripper.json   the numbers, see `Gripper`; docs/grippers.md explains each
    GRIPPER/gripper.xml    its MJCF, which only physics and pictures read

Two pads face one another. They close along a straight line, or stay parallel and move on an arc, as
a parallelogram of links moves them; then the tips come lower as they close.
"""

import dataclasses
import functools
import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from csac_jax.assets import assets
from csac_jax.errors import SettingsError

NUMBERS, MJCF = "gripper.json", "gripper.xml"
FORMAT = 1
LARGEST = 2**20  # bytes of a file of numbers
_PALM_ROOM = 0.01  # m, ours: between what is held and the palm
_FINGER_ROOM = 0.002  # m, ours: on every side of a finger that comes down

_ENDS = ("closed", "open")
_LENGTHS = {  # key -> its parts, () for one number; m, up to 1
    "opening": _ENDS,
    "depth": _ENDS,
    "finger": ("thickness", "width", "length"),
    "clearance": (),
    "radius": (),
    "body_radius": (),
    "hand_capsule": ("from", "to", "radius"),
}
_WORDS = ("name", "body", "palm")
_VARIES = "varies"
_KEYS = ("format", *_WORDS, "pads", "actuator", "joints", *_LENGTHS, "arc_radius", "sources")
_KEYS += (_VARIES,)  # which may be missing

Ends = tuple[float, float]  # closed, open


class Fingers(NamedTuple):
    """What of a gripper may differ between episodes: numbers, or arrays [...], m."""

    opening: Any  # between the open pads
    thickness: Any  # of a finger, along the closing
    width: Any  # across it

    @property
    def footprint(self) -> tuple[Any, Any]:
        """Half the sides of the floor that a finger needs, along the closing and across, m."""
        return 0.5 * self.thickness + _FINGER_ROOM, 0.5 * self.width + _FINGER_ROOM

    @property
    def beside(self) -> Any:
        """From the middle of the open hand to that of a finger, m."""
        return 0.5 * self.opening + 0.5 * self.thickness


@dataclasses.dataclass(frozen=True)
class Gripper:
    """A two-finger gripper. Its tip frame lies between the open tips: z points back to the flange,
    the fingers close along x."""

    folder: Path
    name: str
    body: str  # root of the MJCF, whose frame is the tip frame
    palm: str  # geom above the fingers
    pads: tuple[str, str]  # geoms that face one another
    actuator: str
    set_points: Ends  # of the actuator
    joints: tuple[str, ...]  # all that it moves; the opening is read from the first
    positions: tuple[Ends, ...]  # of each joint
    opening: Ends  # m, between the pads
    depth: Ends  # m, flange to tips
    arc_radius: float | None  # m, of the pads' way; None: a straight line
    finger: tuple[float, float, float]  # m, a finger's size along the closing, across, its length
    clearance: float  # m, least height of the tips above the table
    radius: float  # m, circle about the tool axis that holds the open hand
    body_radius: float  # m, capsule about the gripper's body
    hand_capsule: tuple[
        float, float, float
    ]  # m, about palm and fingers: back from the tips, radius
    varies: tuple[Fingers, Fingers] | None = None  # least and most of an episode's; None: the same

    def __str__(self) -> str:
        return str(self.folder)

    @property
    def fingers(self) -> Fingers:
        """Its own, the largest where they vary."""
        return Fingers(self.opening[1], *self.finger[:2])

    @property
    def footprint(self) -> tuple[float, float]:
        """Half the sides of the floor that a finger needs, along the closing and across, m."""
        return self.fingers.footprint

    @property
    def deepest(self) -> float:
        """How far the tips may go below the top of what they grasp, m."""
        return self.finger[2] - _PALM_ROOM

    @property
    def half(self) -> Ends:
        """Half the opening, m."""
        return 0.5 * self.opening[0], 0.5 * self.opening[1]

    @property
    def angles(self) -> Ends:
        """Of the links from straight ahead, rad, on an arc: it has its radius, and its chord leads
        from the closed pad to the open one."""
        assert self.arc_radius is not None
        across, back = self.half[1] - self.half[0], self.depth[0] - self.depth[1]
        middle = math.atan2(back, across)
        spread = math.asin(0.5 * math.hypot(across, back) / self.arc_radius)
        return middle - spread, middle + spread

    def joint_positions(self, half: Any, xp: Any = np) -> list[Any]:
        """Position [...] of each joint at half openings [...] m; `xp` is NumPy or jax.numpy."""
        return [self._between(ends, half, xp) for ends in self.positions]

    def set_point(self, half: Any, xp: Any = np) -> Any:
        """What the actuator is told [...] for half openings [...] m."""
        return self._between(self.set_points, half, xp)

    def gap(self, position: Any, xp: Any = np) -> Any:
        """Opening [...] m beyond the closed one, where the first joint is at `position` [...]."""
        (closed, opened), (low, high) = self.positions[0], self._way
        way = (position - closed) * ((high - low) / (opened - closed))
        if self.arc_radius is None:
            return 2.0 * way
        return 2.0 * self.arc_radius * (xp.sin(low + way) - math.sin(low))

    def drop(self, half: Any, xp: Any = np) -> Any:
        """How far the tips are below the tip frame [...] m at half openings [...] m."""
        if self.arc_radius is None:
            return 0.0 * half
        return self.arc_radius * (xp.cos(self._along(half, xp)) - math.cos(self.angles[1]))

    def _between(self, ends: Ends, half: Any, xp: Any) -> Any:
        """From one end to the other in step with the pads' way."""
        low, high = self._way
        return ends[0] + (self._along(half, xp) - low) * ((ends[1] - ends[0]) / (high - low))

    @property
    def _way(self) -> Ends:
        """What grows evenly with the joints: half the opening, m, or the links' angle, rad."""
        return self.half if self.arc_radius is None else self.angles

    def _along(self, half: Any, xp: Any) -> Any:
        """Where half openings [...] m lie on `_way`."""
        if self.arc_radius is None:
            return half
        return xp.arcsin(math.sin(self.angles[0]) + (half - self.half[0]) / self.arc_radius)


def shipped() -> list[str]:
    """Names of the grippers that come with the package."""
    return sorted(path.parent.name for path in assets().glob(f"grippers/*/{NUMBERS}"))


def load(source: "str | Gripper") -> Gripper:
    """Returns the gripper of a name or a folder; a gripper is returned as it is.

    A folder is read at each call: nothing of it is kept. Raises SettingsError for a source that is
    no gripper, and for numbers that are missing, unknown or out of range.
    """
    if isinstance(source, Gripper):
        return source
    return _shipped(source) if source in shipped() else _of_folder(Path(source))


def resolve(source: "str | Gripper") -> "str | Gripper":
    """Replaces the folder of a gripper by the gripper, so that it is read once and travels with its
    config; the name of a shipped one stays. Raises SettingsError as `load`."""
    return source if source in shipped() else load(source)


@functools.lru_cache
def _shipped(name: str) -> Gripper:
    return _of_folder(assets() / "grippers" / name)


def _of_folder(folder: Path) -> Gripper:
    path = folder / NUMBERS
    if not path.is_file():
        known = ", ".join(shipped())
        fault = f"'{folder}' is neither one of {known} nor a folder with a {NUMBERS}"
        raise SettingsError(f"sim.gripper: {fault}")
    try:
        return from_numbers(folder, _read(path))
    except ValueError as error:
        raise SettingsError(f"{path}: {error}") from None


def from_numbers(folder: Path, numbers: dict[str, Any]) -> Gripper:
    """Builds a gripper from the content of a gripper.json; physics and pictures alone need the
    folder. Raises ValueError for numbers that are missing, unknown or out of range."""
    gripper = _gripper(folder, numbers)
    _check(gripper)
    return gripper


def to_numbers(gripper: Gripper) -> dict[str, Any]:
    """Writes a gripper as the content of its gripper.json, without sources."""

    def ends(pair: Ends) -> dict[str, float]:
        return dict(zip(_ENDS, pair, strict=True))

    lengths: dict[str, Any] = {}
    for name, parts in _LENGTHS.items():
        value = getattr(gripper, name)
        lengths[name] = dict(zip(parts, value, strict=True)) if parts else value
    positions = zip(gripper.joints, gripper.positions, strict=True)
    numbers = {
        "format": FORMAT,
        **{name: getattr(gripper, name) for name in _WORDS},
        "pads": list(gripper.pads),
        "actuator": {"name": gripper.actuator, **ends(gripper.set_points)},
        "joints": {joint: ends(pair) for joint, pair in positions},
        "arc_radius": gripper.arc_radius,
        **lengths,
    }
    if gripper.varies is not None:
        pairs = zip(*gripper.varies, strict=True)
        numbers[_VARIES] = {
            name: list(pair) for name, pair in zip(Fingers._fields, pairs, strict=True)
        }
    return numbers


def _read(path: Path) -> dict[str, Any]:
    """The JSON object of a file. Raises ValueError for other content."""
    _require(path.stat().st_size <= LARGEST, "is larger than 1 MiB")
    try:
        return _object(json.loads(path.read_bytes()), "the file")
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError):
        raise ValueError("is not readable JSON") from None


def _gripper(folder: Path, given: dict[str, Any]) -> Gripper:
    """The gripper of these numbers, whatever they are. Raises ValueError by name of a wrong key."""
    for name in sorted(given.keys() - set(_KEYS)):
        raise ValueError(f"'{name}' is unknown; the keys are: {', '.join(_KEYS)}")
    _require(_need(given, "format") == FORMAT, f"'format' must be {FORMAT}")
    actuator, joints = (_object(_need(given, name), name) for name in ("actuator", "joints"))
    pads, arc = _need(given, "pads"), _need(given, "arc_radius")
    _require(isinstance(pads, list) and len(pads) == 2, "'pads' must be the names of two geoms")
    words: dict[str, Any] = {name: _word(_need(given, name), name) for name in _WORDS}
    lengths: dict[str, Any] = {}
    for name, parts in _LENGTHS.items():
        several = _lengths(given, name, parts)
        lengths[name] = several if parts else several[0]
    return Gripper(
        folder=folder,
        pads=(_word(pads[0], "pads"), _word(pads[1], "pads")),
        actuator=_word(_need(actuator, "name", "actuator"), "actuator.name"),
        set_points=_ends(actuator, "actuator"),
        joints=tuple(joints),
        positions=tuple(
            _ends(_object(ends, f"joints.{joint}"), f"joints.{joint}")
            for joint, ends in joints.items()
        ),
        arc_radius=None if arc is None else _number(arc, "arc_radius"),
        varies=_ranges(given) if _VARIES in given else None,
        **words,
        **lengths,
    )


def _check(gripper: Gripper) -> None:
    """Raises ValueError for numbers that do not fit one another."""
    _require(1 <= len(gripper.joints) <= 16, "'joints' must name 1 to 16")
    _require(0.0 <= gripper.opening[0] < gripper.opening[1], "'opening' must grow from closed")
    moves = all(closed != opened for closed, opened in (gripper.set_points, *gripper.positions))
    _require(moves, "'actuator' and 'joints' must differ between closed and open")
    _require(gripper.finger[2] > _PALM_ROOM, f"'finger.length' must be above {_PALM_ROOM}")
    _require(min(gripper.finger) > 0.0 < min(gripper.depth), "'finger' and 'depth' must be above 0")
    _require(gripper.radius >= gripper.half[1], "'radius' must hold the open fingers")
    if gripper.varies is not None:
        low, high = gripper.varies
        rising = all(0.0 < least <= most for least, most in zip(low, high, strict=True))
        _require(rising, f"'{_VARIES}' must be ranges [least, most] above 0")
        _require(
            low.opening > gripper.opening[0], f"'{_VARIES}.opening' must exceed the closed one"
        )
        largest = f"the most of '{_VARIES}' must be the MJCF's: 'opening.open' and 'finger'"
        _require(high == gripper.fingers, largest)
        _require(gripper.arc_radius is None, f"'{_VARIES}' needs pads that close along a line")
    if gripper.arc_radius is None:
        same = gripper.depth[0] == gripper.depth[1]
        _require(same, "'depth' must be the same at both ends without an 'arc_radius'")
        return
    chord = math.hypot(gripper.half[1] - gripper.half[0], gripper.depth[0] - gripper.depth[1])
    _require(gripper.arc_radius > 0.5 * chord, f"'arc_radius' must be above {0.5 * chord:.4f}")
    turns = -0.5 * math.pi < gripper.angles[0] < gripper.angles[1] < 0.5 * math.pi
    _require(turns, "'arc_radius', 'opening' and 'depth': the links would turn beyond 90 degrees")


def _ranges(given: dict[str, Any]) -> tuple[Fingers, Fingers]:
    """Least and most of what varies."""
    stored = _object(given[_VARIES], _VARIES)
    for name in sorted(stored.keys() - set(Fingers._fields)):
        raise ValueError(f"'{_VARIES}.{name}' is unknown; there are: {', '.join(Fingers._fields)}")
    ends = []
    for name in Fingers._fields:
        pair, key = _need(stored, name, _VARIES), f"{_VARIES}.{name}"
        _require(isinstance(pair, list) and len(pair) == 2, f"'{key}' must be [least, most]")
        ends.append([_number(one, key) for one in pair])
    low, high = zip(*ends, strict=True)
    return Fingers(*low), Fingers(*high)


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


def _need(given: dict[str, Any], name: str, of: str = "") -> Any:
    key = f"{of}.{name}".lstrip(".")
    _require(name in given, f"'{key}' is missing")
    return given[name]


def _object(value: Any, name: str) -> dict[str, Any]:
    _require(isinstance(value, dict), f"'{name}' must be an object")
    return value


def _word(value: Any, name: str) -> str:
    _require(isinstance(value, str) and value != "", f"'{name}' must be a name")
    return value


def _number(value: Any, name: str) -> float:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    _require(is_number and math.isfinite(value), f"'{name}' must be a number")
    return float(value)


def _ends(given: dict[str, Any], name: str) -> Ends:
    closed, opened = (_number(_need(given, end, name), f"{name}.{end}") for end in _ENDS)
    return closed, opened


def _lengths(given: dict[str, Any], name: str, parts: tuple[str, ...]) -> tuple[float, ...]:
    """The numbers of a key, 0 to 1 m."""
    value = _need(given, name)
    values = {f"{name}.{part}": _need(_object(value, name), part, name) for part in parts}
    lengths = [_number(one, key) for key, one in (values or {name: value}).items()]
    _require(all(0.0 <= length <= 1.0 for length in lengths), f"'{name}' must lie in 0 .. 1 m")
    return tuple(lengths)
