"""Constructions: scenes in which hardly any grasp lifts before something has been pushed.

Those that train and those that test share none. Blocks touch, and none offers two opposite free
sides within OPENING: it is longer, or a neighbour, a wall or a roof covers one of them. Sizes,
gaps, colours and materials vary, and the whole is turned. The pads have the friction of rubber on
wood: with more than 1, two pads would lift a block by a free corner. Scenes are drawn on the host,
by NumPy.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from csac_jax.config import SceneConfig, SlotKind
from csac_jax.world import blocks, scene_state
from csac_jax.world.scene_state import SceneState

OPENING = 0.110  # m, of the RG2, for which the sizes are made
TRAY = 0.30  # m, inner side of the tray
SUITES: dict[str, SceneConfig] = {
    "blocked": SceneConfig(slots=("box",) * 4 + ("arch",) * 2, min_blocks=1),
    "enclosed": SceneConfig(slots=("box",) * 5, min_blocks=1),
    "tray": SceneConfig(slots=("box",) * 4 + ("arch",), min_blocks=1, tray=TRAY),
    "hidden": SceneConfig(slots=("box",) * 6, min_blocks=1),
}
"""Slots of the scenes of each suite; those that a scene has no use for are parked."""
SIM: dict[str, Any] = {"pad_friction": (0.8, 0.8)}  # settings of section sim in these suites
WITH_TARGET = ("enclosed", "hidden")  # suites whose scenes mark a target
_LONG = (0.114, 0.124)  # m, longer than the opening
_GAP = 0.001  # m, widest between neighbours: each block is smaller by a random part of it
_SHIFT = 0.02  # m, most along x and y from the middle of the workspace
_SIDES = ((1, 0), (0, 1), (-1, 0), (0, -1))  # directions x, y


class Laid(NamedTuple):
    """A block with sides along x and y, before the whole is turned."""

    middle: tuple[float, float]  # m
    size: tuple[float, float, float]  # m, whole sides
    floor: float = 0.0  # m, height of its underside
    kind: SlotKind = "box"
    exact: bool = False  # it leaves no gap to its neighbours


class Construction(NamedTuple):
    """A way to build scenes of a suite."""

    suite: str  # a name of SUITES
    make: Callable[[jax.Array], SceneState]  # one scene from a key, NumPy leaves [N, ...]


class _Draw:
    """Random numbers from ranges."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def __call__(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def many(self, count: int, low: float, high: float) -> list[float]:
        return self.rng.uniform(low, high, count).tolist()

    def long(self) -> float:
        return self(*_LONG)


Place = Callable[[_Draw], list[Laid]]  # the first piece is the target


def make(suite: str, place: Place, key: jax.Array) -> SceneState:
    """Builds one scene, NumPy leaves [N, ...], of a construction that places its pieces."""
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    cfg, pieces = SUITES[suite], place(_Draw(rng))
    free = {kind: [i for i, slot in enumerate(cfg.slots) if slot == kind] for kind in cfg.slots}
    slot = np.array([free[piece.kind].pop(0) for piece in pieces])
    half = 0.5 * np.array([piece.size for piece in pieces])
    xy, yaw = _turned(rng, cfg, np.array([piece.middle for piece in pieces]), half)
    floor = np.array([[piece.floor] for piece in pieces])
    loose = np.array([[not piece.exact] for piece in pieces])
    gap = np.where(loose, rng.uniform(0.0, _GAP, (len(pieces), 2)), 0.0)
    blank = scene_state.parked(cfg.slots)
    num, num_colours = len(cfg.slots), len(blocks.COLOURS)
    position, half_size, quaternion, in_play = (
        leaf.copy() for leaf in (blank.position, blank.half_size, blank.quaternion, blank.in_play)
    )
    position[slot] = np.column_stack([xy, floor + half[:, 2:]])
    half_size[slot] = half - 0.5 * np.column_stack([gap, np.zeros(len(pieces))])
    quaternion[slot] = np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw)
    in_play[slot] = True
    return blank.replace(
        position=position,
        half_size=half_size,
        quaternion=quaternion,
        in_play=in_play,
        density=rng.uniform(*cfg.density, num).astype(np.float32),
        friction=rng.uniform(*cfg.friction, num).astype(np.float32),
        colour=rng.permutation(max(num, num_colours))[:num].astype(np.int32) % num_colours,
        target=np.int32(slot[0] if suite in WITH_TARGET else scene_state.ANY),
    )


def _turned(
    rng: np.random.Generator, cfg: SceneConfig, xy: np.ndarray, half: np.ndarray
) -> tuple[np.ndarray, float]:
    """Turns places [B, 2] m by a random yaw, rad, and shifts them; in a tray turns by quarters."""
    yaw, shift = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-_SHIFT, _SHIFT, 2)
    if cfg.tray:
        yaw, shift = round(yaw / (0.5 * np.pi)) * (0.5 * np.pi), np.zeros(2)
    else:
        xy = xy - 0.5 * ((xy - half[:, :2]).min(axis=0) + (xy + half[:, :2]).max(axis=0))
    cos, sin = np.cos(yaw), np.sin(yaw)
    return xy @ np.array([[cos, sin], [-sin, cos]]) + shift, yaw


def _middles(widths: list[float]) -> list[float]:
    """Computes the middles, m, of neighbours of these widths along a row that begins at 0."""
    return (np.cumsum(widths) - 0.5 * np.array(widths)).tolist()


def _bars(draw: _Draw) -> list[Laid]:
    """Lays three or four bars longer than the opening side by side."""
    widths, high = draw.many(int(draw.rng.integers(3, 5)), 0.038, 0.048), draw(0.035, 0.050)
    row = zip(_middles(widths), widths, strict=True)
    return [Laid((0.0, y), (draw.long(), width, high)) for y, width in row]


def _slabs(draw: _Draw) -> list[Laid]:
    """Lays two slabs together, each longer than the opening and half as wide."""
    widths, high = draw.many(2, 0.058, 0.070), draw(0.030, 0.050)
    row = zip(_middles(widths), widths, strict=True)
    return [Laid((draw(-0.004, 0.004), y), (draw.long(), width, high)) for y, width in row]


def _arcade(draw: _Draw) -> list[Laid]:
    """Lays two arches longer than the opening tunnel to tunnel, between two bars."""
    kinds: tuple[SlotKind, ...] = ("box", "arch", "arch", "box")
    widths, high = draw.many(4, 0.035, 0.050), draw(0.045, 0.055)
    row = zip(_middles(widths), widths, kinds, strict=True)
    return [Laid((0.0, y), (draw.long(), width, high), kind=kind) for y, width, kind in row]


def _parquet(draw: _Draw) -> list[Laid]:
    """Lays a pair of bars across the end of another pair."""
    length, high, pieces = draw.long(), draw(0.035, 0.050), []
    for across in (False, True):
        share = draw(0.45, 0.55)
        for way, part in ((-0.5, share), (0.5, 1.0 - share)):
            aside = way * (1.0 - part) * length
            middle, size = (0.0, aside), (length, part * length, high)
            if across:
                middle, size = (length + aside, 0.0), (part * length, length, high)
            pieces.append(Laid(middle, size))
    return pieces


def _crib(draw: _Draw) -> list[Laid]:
    """Lays two slabs together and two more across them; no pair is within the opening."""
    pieces, floor = [], 0.0
    for across in (False, True):
        widths, high = draw.many(2, 0.058, 0.066), draw(0.028, 0.040)
        for y, width in zip(_middles(widths), widths, strict=True):
            aside, long = y - 0.5 * sum(widths), draw.long()
            middle, size = (0.0, aside), (long, width, high)
            if across:
                middle, size = (aside, 0.0), (width, long, high)
            pieces.append(Laid(middle, size, floor=floor))
        floor = high
    return pieces


def _frame(draw: _Draw) -> list[Laid]:
    """Encloses a block between two short blocks, and these between two bars."""
    (x, y), high = draw.many(2, 0.038, 0.044), draw(0.038, 0.050)
    ends, sides = draw.many(2, 0.038, 0.040), draw.many(2, 0.040, 0.055)
    target = Laid((0.0, 0.0), (x, y, draw(0.75, 1.0) * high))
    pieces, middle = [target], 0.5 * (ends[1] - ends[0])
    for way, end, side in zip((-0.5, 0.5), ends, sides, strict=True):
        pieces.append(Laid((way * (x + end), 0.0), (end, y, high)))
        pieces.append(Laid((middle, way * (y + side)), (x + sum(ends), side, high)))
    return pieces


def _dock(draw: _Draw) -> list[Laid]:
    """Puts a long block into a U of three bars; its free end is flush with theirs."""
    length, width, high = draw.long(), draw(0.038, 0.040), draw(0.035, 0.050)
    arms, back = draw.many(2, 0.038, 0.042), draw(0.036, 0.050)
    pieces = [Laid((0.0, 0.0), (length, width, high))]
    for way, arm in zip((-0.5, 0.5), arms, strict=True):
        pieces.append(Laid((0.0, way * (width + arm)), (length, arm, high)))
    behind, aside = -0.5 * (length + back), 0.5 * (arms[1] - arms[0])
    return [*pieces, Laid((behind, aside), (back, width + sum(arms), high))]


def _zipper(draw: _Draw) -> list[Laid]:
    """Encloses a bar longer than the opening by two pairs of blocks along its sides."""
    wide, high = draw(0.038, 0.046), draw(0.036, 0.050)
    pieces = [Laid((0.0, 0.0), (draw.long(), wide, high))]
    for way in (-0.5, 0.5):
        deep = draw(0.045, 0.060)
        for along in (-0.5, 0.5):
            long = draw(0.057, 0.062)
            pieces.append(Laid((along * long, way * (wide + deep)), (long, deep, high)))
    return pieces


def _trench(draw: _Draw) -> list[Laid]:
    """Puts a low bar longer than the opening between two high slabs."""
    wide, (low, high) = draw(0.048, 0.058), (draw(0.030, 0.042), draw(0.050, 0.060))
    pieces = [Laid((0.0, 0.0), (draw.long(), wide, low))]
    for way in (-0.5, 0.5):
        deep = draw(0.045, 0.060)
        pieces.append(Laid((draw(-0.003, 0.003), way * (wide + deep)), (draw.long(), deep, high)))
    return pieces


def _corners(draw: _Draw) -> list[Laid]:
    """Puts a block into each of two or three corners of the tray."""
    pieces, count = [], int(draw.rng.integers(2, 4))
    for x, y in ((-0.5, -0.5), (0.5, 0.5), (0.5, -0.5))[:count]:
        wide, long = draw.many(2, 0.040, 0.070)
        middle = x * (TRAY - wide), y * (TRAY - long)
        pieces.append(Laid(middle, (wide, long, draw(0.030, 0.050))))
    return pieces


def _moored(draw: _Draw) -> list[Laid]:
    """Puts two or three blocks longer than the opening along the walls of the tray."""
    kinds: tuple[SlotKind, ...] = ("box", "arch", "box")
    pieces, count = [], int(draw.rng.integers(2, 4))
    for (x, y), kind in list(zip(_SIDES, kinds, strict=False))[:count]:
        wide, long, aside = draw(0.035, 0.055), draw.long(), draw(-0.03, 0.03)
        size = (long, wide) if y else (wide, long)
        out = 0.5 * (TRAY - wide)
        middle = x * out + y * aside, y * out + x * aside
        pieces.append(Laid(middle, (*size, draw(0.035, 0.050)), kind=kind))
    return pieces


def _berth(draw: _Draw) -> list[Laid]:
    """Lays a slab along a wall of the tray and one beside it; together they exceed the opening."""
    pieces, y, aside, high = [], 0.5 * TRAY, draw(-0.05, 0.05), draw(0.035, 0.050)
    for deep in draw.many(2, 0.057, 0.064):
        x = aside + draw(-0.004, 0.004)
        pieces.append(Laid((x, y - 0.5 * deep), (draw.long(), deep, high)))
        y -= deep
    return pieces


def _nook(draw: _Draw) -> list[Laid]:
    """Puts an L of three blocks into a corner of the tray."""
    (x, y), high, low = draw.many(2, 0.05, 0.062), draw(0.035, 0.05), -0.5 * TRAY
    along, aside = draw.many(2, 0.05, 0.08)
    return [
        Laid((low + 0.5 * x, low + 0.5 * y), (x, y, high)),
        Laid((low + x + 0.5 * along, low + 0.5 * y), (along, y, high)),
        Laid((low + 0.5 * x, low + y + 0.5 * aside), (x, aside, high)),
    ]


def _seen(draw: _Draw) -> float:
    """Draws the share of a target that is seen from above: 0, 0.1 to 0.4, or 0.6 to 0.9."""
    share = draw(0.1, 0.4)
    return (0.0, share, share + 0.5)[draw.rng.integers(3)]


def _roof(draw: _Draw) -> list[Laid]:
    """Puts a block between two rails with a bar behind, and a plate over them."""
    long, high, share = draw.long(), draw(0.028, 0.040), _seen(draw)
    (x, y), rails, bar = draw.many(2, 0.042, 0.048), draw.many(2, 0.036, 0.038), draw(0.036, 0.045)
    deep = 0.0 if share else draw(0.005, 0.05)  # the target lies so far under the plate
    pieces = [Laid((0.5 * x + deep, 0.0), (x, y, high))]
    for way, rail in zip((-0.5, 0.5), rails, strict=True):
        pieces.append(Laid((0.5 * long, way * (y + rail)), (long, rail, high)))
    behind = long + 0.5 * bar, 0.5 * (rails[1] - rails[0])
    pieces.append(Laid(behind, (bar, y + sum(rails), high)))  # else a pressed plate would tip
    plate = draw.long(), draw.long(), draw(0.012, 0.020)
    return [*pieces, Laid((share * x + 0.5 * plate[0], 0.0), plate, floor=high)]


def _shed(draw: _Draw) -> list[Laid]:
    """Puts a block and a filler between rails, and a plate that leaves one side of them open."""
    (x, y), high, share = draw.many(2, 0.042, 0.050), draw(0.028, 0.040), _seen(draw)
    rail, wide, last, long = draw(0.034, 0.040), draw(0.062, 0.068), draw(0.042, 0.048), draw.long()
    filler = long - x - draw(0.022, 0.026)  # a finger has room between block and filler
    inner = y + draw(0.0, 0.006)
    plate = long + draw(-0.004, 0.004), draw.long(), draw(0.014, 0.022)
    start = share * y if share else draw(-0.015, -0.005)
    return [
        Laid((0.5 * x, 0.5 * y), (x, y, high)),
        Laid((long - 0.5 * filler, 0.5 * inner), (filler, inner, high)),
        Laid((0.5 * long, -0.5 * rail), (long, rail, high)),
        Laid((0.5 * long, inner + 0.5 * wide), (long, wide, high)),
        Laid((0.5 * long, inner + wide + 0.5 * last), (long, last, high)),
        Laid((0.5 * long, start + 0.5 * plate[1]), plate, floor=high, exact=True),
    ]


def _constructions(**places: tuple[str, Place]) -> dict[str, Construction]:
    return {
        name: Construction(suite, functools.partial(make, suite, place))
        for name, (suite, place) in places.items()
    }


TRAIN = _constructions(
    bars=("blocked", _bars),
    slabs=("blocked", _slabs),
    arcade=("blocked", _arcade),
    frame=("enclosed", _frame),
    dock=("enclosed", _dock),
    corners=("tray", _corners),
    moored=("tray", _moored),
    roof=("hidden", _roof),
)
"""Constructions that training and tuning may use, by name."""
TEST = _constructions(
    parquet=("blocked", _parquet),
    crib=("blocked", _crib),
    zipper=("enclosed", _zipper),
    trench=("enclosed", _trench),
    berth=("tray", _berth),
    nook=("tray", _nook),
    shed=("hidden", _shed),
)
"""Constructions of the suites, by name; no policy is trained on them."""
