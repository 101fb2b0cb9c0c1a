"""A gripper as numbers, GRIPPER/gripper.json; only physics and pictures read its MJCF.

Two pads face one another. They close along a straight line, or stay parallel and move on an arc, as
a parallelogram of links moves them; then the tips come lower as they close.
"""

import dataclasses
import functools
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from csac_jax import reading
from csac_jax.assets import assets
from csac_jax.errors import SettingsError, first_fault

NUMBERS, MJCF = "gripper.json", "gripper.xml"
FORMAT = 1
LARGEST = 2**20  # bytes of a file of numbers
LENGTHS = ("opening", "depth", "finger", "clearance", "radius", "body_radius", "hand_capsule")
_CAPSULE = ("from", "to", "radius")
_PALM_ROOM = 0.01  # m, ours: between what is held and the palm
_FINGER_ROOM = 0.002  # m, ours: on every side of a finger that comes down


class Ends(NamedTuple):
    """A number of the closed gripper and of the open one."""

    closed: float
    open: float


class Grip(NamedTuple):
    """Grip of an episode: numbers, or arrays [...]; 0: the gripper's own."""

    friction: Any  # sliding, of the pads
    force: Any  # N, most of the drive


class FingerSize(NamedTuple):
    """Size of a finger, m."""

    thickness: float  # along the closing
    width: float  # across it
    length: float


class Fingers(NamedTuple):
    """Sizes of a gripper that may differ between episodes: numbers, or arrays [...], m."""

    opening: Any  # between the open pads
    thickness: Any  # of a finger, along the closing
    width: Any  # across it

    @property
    def footprint(self) -> tuple[Any, Any]:
        """Returns half the sides of the floor a finger needs, along the closing and across, m."""
        return 0.5 * self.thickness + _FINGER_ROOM, 0.5 * self.width + _FINGER_ROOM


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Shared:
    """The numbers of a gripper that its file has alike."""

    name: str
    body: str  # root of the MJCF, whose frame is the tip frame
    palm: str  # geom above the fingers
    pads: tuple[str, str]  # geoms that face one another
    arc_radius: float | None  # m, of the pads' way; None: a straight line
    opening: Ends  # m, between the pads
    depth: Ends  # m, flange to tips
    finger: FingerSize
    force: float | None = None  # N, of the drive at its limit; None: unknown
    clearance: float  # m, least height of the tips above the table
    radius: float  # m, circle about the tool axis that holds the open hand
    body_radius: float  # m, capsule about the gripper's body


@dataclasses.dataclass(frozen=True, kw_only=True)
class Gripper(_Shared):
    """A two-finger gripper. Tip frame: between the open tips, z to the flange, closing along x."""

    folder: Path
    actuator: str
    set_points: Ends  # of the actuator
    joints: tuple[str, ...]  # all that it moves; the opening is read from the first
    positions: tuple[Ends, ...]  # of each joint
    hand_capsule: tuple[float, float, float]  # m, about palm and fingers: from, to, radius
    varies: tuple[Fingers, Fingers] | None = None  # least and most of an episode's; None: the same

    def __str__(self) -> str:
        return str(self.folder)

    @property
    def fingers(self) -> Fingers:
        """Returns its own fingers, the largest where they vary."""
        return Fingers(self.opening[1], *self.finger[:2])

    @property
    def footprint(self) -> tuple[float, float]:
        """Returns the fingers' footprint [2] m, see `Fingers`."""
        return self.fingers.footprint

    @property
    def deepest(self) -> float:
        """Returns how far the tips may go below the top of what they grasp, m."""
        return self.finger[2] - _PALM_ROOM

    @property
    def half(self) -> Ends:
        """Returns half the opening, m."""
        return Ends(0.5 * self.opening[0], 0.5 * self.opening[1])

    @property
    def angles(self) -> Ends:
        """Returns the links' angles from straight ahead, rad; their arc has `arc_radius`."""
        assert self.arc_radius is not None
        across, back = self.half[1] - self.half[0], self.depth[0] - self.depth[1]
        middle = math.atan2(back, across)
        spread = math.asin(0.5 * math.hypot(across, back) / self.arc_radius)
        return Ends(middle - spread, middle + spread)

    def joint_positions(self, half: Any, xp: Any = np) -> list[Any]:
        """Returns each joint's position [...] at half openings [...] m; `xp` is np or jnp."""
        return [self._between(ends, half, xp) for ends in self.positions]

    def set_point(self, half: Any, xp: Any = np) -> Any:
        """Returns the actuator's set-point [...] for half openings [...] m."""
        return self._between(self.set_points, half, xp)

    def gap(self, position: Any, xp: Any = np) -> Any:
        """Returns the opening [...] m beyond the closed one at the first joint's `position`."""
        (closed, opened), (low, high) = self.positions[0], self._way
        way = (position - closed) * ((high - low) / (opened - closed))
        if self.arc_radius is None:
            return 2.0 * way
        return 2.0 * self.arc_radius * (xp.sin(low + way) - math.sin(low))

    def drop(self, half: Any, xp: Any = np) -> Any:
        """Returns how far the tips are below the tip frame [...] m at half openings [...] m."""
        if self.arc_radius is None:
            return 0.0 * half
        return self.arc_radius * (xp.cos(self._along(half, xp)) - math.cos(self.angles[1]))

    def _between(self, ends: Ends, half: Any, xp: Any) -> Any:
        low, high = self._way
        return ends[0] + (self._along(half, xp) - low) * ((ends[1] - ends[0]) / (high - low))

    @property
    def _way(self) -> Ends:
        """Returns the ends of half the opening, or of the angle: it grows evenly with joints."""
        return self.half if self.arc_radius is None else self.angles

    def _along(self, half: Any, xp: Any) -> Any:
        """Converts half openings [...] m to `_way`."""
        if self.arc_radius is None:
            return half
        return xp.arcsin(math.sin(self.angles[0]) + (half - self.half[0]) / self.arc_radius)


def shipped() -> list[str]:
    """Returns the names of the grippers that come with the package."""
    return sorted(path.parent.name for path in assets().glob(f"grippers/*/{NUMBERS}"))


def load(source: "str | Gripper", setting: str = "sim.gripper") -> Gripper:
    """Returns the gripper of a name or a folder, which is read at each call; a gripper as it is.

    Raises SettingsError, which names `setting`, for a source that is no gripper, and for numbers
    that are wrong.
    """
    if isinstance(source, Gripper):
        return source
    return _shipped(source) if source in shipped() else _from_folder(Path(source), setting)


def resolve(source: "str | Gripper", setting: str = "sim.gripper") -> "str | Gripper":
    """Replaces the folder of a gripper by the gripper, so that it travels with its config; see
    `load`."""
    return source if source in shipped() else load(source, setting)


@functools.lru_cache
def _shipped(name: str) -> Gripper:
    return _from_folder(assets() / "grippers" / name, "sim.gripper")


def _from_folder(folder: Path, setting: str) -> Gripper:
    path = folder / NUMBERS
    if not path.is_file():
        neither = f"{setting}: '{folder}' is neither one of {', '.join(shipped())}"
        raise SettingsError(f"{neither} nor a folder with a {NUMBERS}")
    try:
        return _from_json(folder, reading.read_bytes(path, LARGEST))
    except OSError as error:
        raise SettingsError(f"{path}: {error.strerror}") from None
    except ValueError as error:
        raise SettingsError(f"{path}: {error}") from None


def from_numbers(folder: Path, numbers: dict[str, Any]) -> Gripper:
    """Builds a gripper from the content of a gripper.json. Raises ValueError for wrong numbers."""
    return _from_json(folder, json.dumps(numbers))


def to_numbers(gripper: Gripper) -> dict[str, Any]:
    """Returns a gripper as the content of its gripper.json, without sources."""

    def ends(pair: tuple[float, ...]) -> dict[str, float]:
        return Ends(*pair)._asdict()

    numbers = {
        "format": FORMAT,
        **{field.name: getattr(gripper, field.name) for field in dataclasses.fields(_Shared)},
        "pads": list(gripper.pads),
        "actuator": {"name": gripper.actuator, **ends(gripper.set_points)},
        "joints": dict(zip(gripper.joints, map(ends, gripper.positions), strict=True)),
        "opening": ends(gripper.opening),
        "depth": ends(gripper.depth),
        "finger": FingerSize(*gripper.finger)._asdict(),
        "hand_capsule": dict(zip(_CAPSULE, gripper.hand_capsule, strict=True)),
    }
    if gripper.varies is not None:
        pairs = map(list, zip(*gripper.varies, strict=True))
        numbers["varies"] = dict(zip(Fingers._fields, pairs, strict=True))
    return numbers


class _Actuator(NamedTuple):
    name: str
    closed: float
    open: float


class _Ranges(NamedTuple):
    opening: tuple[float, float]  # least and most
    thickness: tuple[float, float]
    width: tuple[float, float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Numbers(_Shared):
    """The content of a gripper.json, checked by pydantic."""

    __pydantic_config__: ClassVar = {"extra": "forbid"}
    format: Literal[1]
    actuator: _Actuator
    joints: dict[str, Ends]
    hand_capsule: dict[Literal["from", "to", "radius"], float]
    varies: _Ranges | None = None
    sources: Any = None


@functools.cache
def _adapter() -> Any:
    import pydantic  # slow

    return pydantic.TypeAdapter(_Numbers)


def _from_json(folder: Path, content: str | bytes) -> Gripper:
    try:
        numbers = _adapter().validate_json(content, strict=True)
    except ValueError as error:
        raise ValueError(first_fault(error)) from None
    capsule: Any = tuple(numbers.hand_capsule.get(part, -1.0) for part in _CAPSULE)
    gripper = Gripper(
        folder=folder,
        actuator=numbers.actuator.name,
        set_points=Ends(*numbers.actuator[1:]),
        joints=tuple(numbers.joints),
        positions=tuple(numbers.joints.values()),
        hand_capsule=capsule,
        varies=numbers.varies and tuple(map(Fingers, *numbers.varies)),
        **{field.name: getattr(numbers, field.name) for field in dataclasses.fields(_Shared)},
    )
    for message, holds in _rules(gripper):
        if not holds:
            raise ValueError(message)
    return gripper


def _rules(gripper: Gripper) -> Iterator[tuple[str, Any]]:
    """Yields what numbers must be, and if they are; each may rely on those before it."""
    half, depth, finger = gripper.half, gripper.depth, gripper.finger
    numbers = [*gripper.set_points, *sum(gripper.positions, ()), gripper.arc_radius or 0.0]
    yield "'force' must be above 0", gripper.force is None or 0.0 < gripper.force < math.inf
    yield "'actuator', 'joints' and 'arc_radius' must be finite", np.isfinite(numbers).all()
    words = (gripper.name, gripper.body, gripper.palm, *gripper.pads, gripper.actuator)
    yield "'name', 'body', 'palm', 'pads' and 'actuator.name' must not be empty", all(words)
    for name in LENGTHS:
        lengths = np.array(getattr(gripper, name))
        yield f"'{name}' must lie in 0 .. 1 m", lengths.min() >= 0.0 and lengths.max() <= 1.0
    yield "'joints' must name 1 to 16", 1 <= len(gripper.joints) <= 16
    yield "'opening' must grow from closed", half.closed < half.open
    moves = all(closed != opened for closed, opened in (gripper.set_points, *gripper.positions))
    yield "'actuator' and 'joints' must differ between closed and open", moves
    yield f"'finger.length' must be above {_PALM_ROOM}", finger.length > _PALM_ROOM
    yield "'finger' and 'depth' must be above 0", min(*finger, *depth) > 0.0
    yield "'radius' must hold the open fingers", gripper.radius >= half.open
    if gripper.varies is not None:
        yield from _rules_of_ranges(gripper, *gripper.varies)
    if gripper.arc_radius is None:
        same = depth.closed == depth.open
        yield "'depth' must be the same at both ends without an 'arc_radius'", same
        return
    chord = math.hypot(half.open - half.closed, depth.closed - depth.open)
    yield f"'arc_radius' must be above {0.5 * chord:.4f}", gripper.arc_radius > 0.5 * chord
    turns = -0.5 * math.pi < gripper.angles[0] < gripper.angles[1] < 0.5 * math.pi
    yield "'arc_radius', 'opening' and 'depth': the links would turn beyond 90 degrees", turns


def _rules_of_ranges(gripper: Gripper, low: Fingers, high: Fingers) -> Iterator[tuple[str, Any]]:
    rising = all(0.0 < least <= most for least, most in zip(low, high, strict=True))
    yield "'varies' must be ranges [least, most] above 0", rising
    yield "'varies.opening' must exceed the closed one", low.opening > gripper.opening.closed
    same = high == gripper.fingers
    yield "the most of 'varies' must be the MJCF's: 'opening.open' and 'finger'", same
    yield "'varies' needs pads that close along a line", gripper.arc_radius is None
