"""Our own shapes: families of objects, each drawn from random numbers as convex parts.

The parts of an object touch and do not overlap. A hand that opens to 110 mm can grasp each. Round
cross-sections are polygons, so that objects come to rest. z is up as the object stands.
"""

import itertools
from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from csac_jax.objects import body, solid
from csac_jax.objects.body import Object
from csac_jax.objects.solid import Part

SIDES = 6  # of walls of hollow things
_ROUND = 12  # sides of full round things
_REACH = 0.042  # m, from the middle of a block of an assembly to its farthest side: the hand fits
_THIN = 0.003  # m, the same to its nearest side, at least


def _circle(radius: float, sides: int = _ROUND) -> np.ndarray:
    """Returns corners [sides, 2] of a regular polygon; the x axis meets the middle of a side."""
    angle = 2.0 * np.pi * (np.arange(sides) + 0.5) / sides
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _frustum(low: np.ndarray, high: np.ndarray, bottom: float, top: float) -> Part:
    ends = (np.column_stack([xy, np.full(len(xy), z)]) for xy, z in ((low, bottom), (high, top)))
    return solid.convex(np.concatenate([*ends]))


def _prism(polygon: np.ndarray, bottom: float, top: float) -> Part:
    return _frustum(polygon, polygon, bottom, top)


def _box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Part:
    x, y, z = np.stack([low, high], axis=1)
    return _prism(np.array([[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]]), *z)


def _wall(
    inner: tuple[float, float], outer: tuple[float, float], bottom: float, top: float, sides: int
) -> list[Part]:
    """Builds the parts of a ring; radii at the bottom and at the top."""
    radii, parts = zip(inner, outer, strict=True), []
    rings = [[_circle(inside, sides), _circle(outside, sides)] for inside, outside in radii]
    for i in range(sides):
        edge = np.array([i, (i + 1) % sides])
        low, high = (np.concatenate([ring[0][edge], ring[1][edge[::-1]]]) for ring in rings)
        parts.append(_frustum(low, high, bottom, top))
    return parts


def bottle(rng: Generator) -> list[Part]:
    """Draws a bottle: body, shoulder and neck, revolved."""
    body, neck = rng.uniform(0.018, 0.034), rng.uniform(0.008, 0.013)
    heights = np.cumsum([0.0, *rng.uniform([0.05, 0.01, 0.015], [0.09, 0.03, 0.03])])
    rings = [_circle(radius) for radius in (body, body, neck, neck)]
    return [_frustum(rings[i], rings[i + 1], heights[i], heights[i + 1]) for i in range(3)]


def _vessel(radii: tuple[float, float], wall: float, height: float, floor: float) -> list[Part]:
    """Builds a floor and a wall around it; outer radii at the bottom and at the top."""
    inner = radii[0] - wall, radii[1] - wall
    slope = (inner[1] - inner[0]) / height
    base = _frustum(_circle(inner[0], SIDES), _circle(inner[0] + slope * floor, SIDES), 0.0, floor)
    return [base, *_wall(inner, radii, 0.0, height, SIDES)]


def bowl(rng: Generator) -> list[Part]:
    """Draws a bowl: a floor and a wall that opens upwards."""
    top = rng.uniform(0.04, 0.06)
    bottom, wall, height = rng.uniform([0.55, 0.004, 0.03], [0.8, 0.007, 0.05])
    return _vessel((top * bottom, top), wall, height, 0.005)


def cup(rng: Generator) -> list[Part]:
    """Draws a cup: a floor, an upright wall and a handle of three bars."""
    radius, height = rng.uniform(0.026, 0.038), rng.uniform(0.05, 0.08)
    side = radius * np.cos(np.pi / SIDES)  # of the wall, from the axis
    reach, thick, half = rng.uniform(0.018, 0.026), 0.006, rng.uniform(0.004, 0.007)
    low, high = 0.2 * height, 0.8 * height
    bars = [_box((side, -half, z), (side + reach, half, z + thick)) for z in (low, high - thick)]
    grip = _box((side + reach, -half, low), (side + reach + thick, half, high))
    return [*_vessel((radius, radius), rng.uniform(0.004, 0.006), height, 0.005), *bars, grip]


def superquadric(rng: Generator) -> list[Part]:
    """Draws a superquadric, (|x/a|^(2/e) + |y/b|^(2/e))^(e/f) + |z/c|^(2/f) = 1, Barr 1981."""
    half, (east, north) = rng.uniform(0.015, 0.04, 3), rng.uniform(0.25, 1.3, 2)
    around = np.pi * (np.arange(8) + 0.5) / 4.0
    up, across = np.meshgrid(np.radians([-54.0, -18.0, 18.0, 54.0]), around)

    def power(values: np.ndarray, exponent: float) -> np.ndarray:
        return np.sign(values) * np.abs(values) ** exponent

    flat = power(np.cos(up), north)
    x, y = flat * power(np.cos(across), east), flat * power(np.sin(across), east)
    points = np.stack([x, y, power(np.sin(up), north)], axis=-1).reshape(-1, 3)
    return [solid.convex(half * np.concatenate([points, [[0, 0, 1], [0, 0, -1]]]))]


def bracket(rng: Generator) -> list[Part]:
    """Draws a bracket: a plate with one leg or two, an L or a U."""
    thick, width = rng.uniform(0.008, 0.015), rng.uniform(0.02, 0.045)
    length, legs = rng.uniform(0.05, 0.085), rng.uniform(0.025, 0.06, rng.integers(1, 3))
    parts = [_box((0.0, 0.0, 0.0), (length, width, thick))]
    for leg, start in zip(legs, (0.0, length - thick), strict=False):
        parts.append(_box((start, 0.0, thick), (start + thick, width, thick + leg)))
    return parts


def tube(rng: Generator) -> list[Part]:
    """Draws a tube: a pipe or a ring."""
    outer, wall = rng.uniform(0.015, 0.038), rng.uniform(0.004, 0.007)
    return _wall((outer - wall,) * 2, (outer,) * 2, 0.0, rng.uniform(0.015, 0.08), SIDES)


def nut(rng: Generator) -> list[Part]:
    """Draws a nut: a hexagon with a hole."""
    outer = rng.uniform(0.018, 0.034)
    inner, height = outer * rng.uniform(0.45, 0.65), rng.uniform(0.012, 0.025)
    return _wall((inner,) * 2, (outer,) * 2, 0.0, height, 6)


def star(rng: Generator) -> list[Part]:
    """Draws a star: a core with three to six pointed arms."""
    arms = int(rng.integers(3, 7))
    radius, thick = rng.uniform(0.012, [0.02, 0.025])
    core, tip = _circle(radius, arms), rng.uniform(0.03, 0.05)
    parts = [_prism(core, 0.0, thick)]
    for i in range(arms):
        side = core[[i, (i + 1) % arms]]
        middle = side.mean(axis=0)
        point = tip * middle / np.linalg.norm(middle)
        parts.append(_prism(np.array([*side, point]), 0.0, thick))
    return parts


def wedge(rng: Generator) -> list[Part]:
    """Draws a wedge: a ramp, its thin end cut off or not."""
    length, width, height = rng.uniform([0.04, 0.025, 0.02], [0.09, 0.06, 0.05])
    end = rng.choice([0.0, rng.uniform(0.2, 0.5)]) * height
    x, z = np.array([0.0, length, length, 0.0]), np.array([0.0, 0.0, end, height])
    ends = [np.column_stack([x, np.full(4, y), z]) for y in (0.0, width)]
    return [solid.convex(np.concatenate(ends))]


def rod(rng: Generator) -> list[Part]:
    """Draws a rod: a hexagonal bar with one to three mitred bends in a plane."""
    bends = int(rng.integers(1, 4))
    turns = rng.uniform(0.4, 1.2, bends) * rng.choice([-1.0, 1.0], bends)
    heading = np.concatenate([[0.0], np.cumsum(turns)])
    along = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    lengths = rng.uniform(0.03, 0.05, bends + 1)
    knots = np.concatenate([np.zeros((1, 2)), np.cumsum(lengths[:, None] * along, axis=0)])
    section = _circle(rng.uniform(0.007, 0.012), 6)  # sideways and up
    cuts = np.concatenate([[0.0], 0.5 * turns, [0.0]])  # from the bar before to the joint's plane
    rings = []
    for i, cut in enumerate(cuts):
        across = heading[max(i - 1, 0)] + cut + 0.5 * np.pi
        side = section[:, :1] / np.cos(cut) * [np.cos(across), np.sin(across)]
        rings.append(np.column_stack([knots[i] + side, section[:, 1]]))
    return [solid.convex(np.concatenate(pair)) for pair in itertools.pairwise(rings)]


def tool(rng: Generator) -> list[Part]:
    """Draws a tool: a hammer, a screwdriver or a spanner."""
    length, half = rng.uniform(0.06, 0.1), rng.uniform(0.006, 0.011)
    handle = _box((0.0, -half, -half), (length, half, half))
    kind = rng.integers(3)
    if kind == 0:
        wide, deep, high = rng.uniform([0.02, 0.022, 0.01], [0.03, 0.04, 0.014])
        return [handle, _box((length, -deep, -high), (length + wide, deep, high))]
    if kind == 1:
        thin, blade = rng.uniform([0.003, 0.03], [0.005, 0.05])
        return [handle, _box((length, -thin, -thin), (length + blade, thin, thin))]
    wide, jaw = rng.uniform(0.018, 0.026), rng.uniform(0.007, 0.01)
    head = length + 0.015
    ends = (wide - jaw, wide), (-wide, jaw - wide)
    jaws = [_box((head, low, -half), (head + 0.02, high, half)) for low, high in ends]
    return [handle, _box((length, -wide, -half), (head, wide, half)), *jaws]


def stone(rng: Generator) -> list[Part]:
    """Draws a stone: the hull of random points of an ellipsoid's surface."""
    points = rng.normal(size=(int(rng.integers(10, 25)), 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return [solid.convex(points * rng.uniform(0.015, 0.04, 3))]


def dumbbell(rng: Generator) -> list[Part]:
    """Draws a dumbbell or a spool: two discs and a bar between them."""
    ends, bar = rng.uniform(0.018, 0.036, 2), rng.uniform(0.007, 0.012)
    heights = np.cumsum([0.0, *rng.uniform([0.01, 0.03, 0.01], [0.025, 0.05, 0.025])])
    rings = [_circle(radius) for radius in (ends[0], bar, ends[1])]
    return [_prism(ring, heights[i], heights[i + 1]) for i, ring in enumerate(rings)]


def brick(rng: Generator) -> list[Part]:
    """Draws a brick: a box, or a prism of three to eight sides."""
    if rng.integers(2):
        return [_box((0.0, 0.0, 0.0), tuple(rng.uniform(0.02, 0.085, 3)))]
    sides = int(rng.integers(3, 9))
    return [_prism(_circle(rng.uniform(0.018, 0.04), sides), 0.0, rng.uniform(0.025, 0.08))]


def assembly(rng: Generator) -> list[Part]:
    """Draws an assembly: one to three storeys of one or two blocks, the last perhaps a wall."""
    storeys = int(rng.integers(1, 4))
    parts: list[Part] = []
    below = np.zeros((1, 2))
    heights = np.cumsum([0.0, *rng.uniform(0.01, 0.01 + 0.07 / storeys, storeys)])
    for storey in range(storeys):
        bottom, top = heights[storey : storey + 2]
        if storey == storeys - 1 and rng.random() < 0.4:
            return [*parts, *_fence(rng, below if storey else _footprint(rng, _REACH), bottom, top)]
        if storey and rng.random() < 0.4:  # two, towards the ends of the longer side
            axis = int(np.argmax(np.ptp(below, axis=0)))
            ends = below[[below[:, axis].argmin(), below[:, axis].argmax()]]
            middles, room = 0.2 * ends[::-1] + 0.8 * ends, 0.28 * float(np.ptp(ends[:, axis]))
        else:
            weights = rng.dirichlet(np.ones(len(below)), 1)
            middles, room = np.einsum("mn,ni->mi", weights, below), _REACH
        feet = [middle + _footprint(rng, room) for middle in middles]
        for foot in feet:
            middle, half = foot.mean(axis=0), 0.5 * np.ptp(foot, axis=0)
            scale = rng.uniform(0.1, 1.1, 2)
            slant = rng.uniform(-1.0, 1.0, 2) * np.maximum(1.0 - scale, 0.0) * half
            below = middle + scale * (foot - middle) + slant
            parts.append(_frustum(foot, below, bottom, top))
    return parts


def _fence(rng: Generator, outline: np.ndarray, bottom: float, top: float) -> list[Part]:
    """Draws a wall inside a convex outline [n, 2], upright or leaning; a block if too narrow."""
    middle = outline.mean(axis=0)
    corners = outline - middle
    sides = np.roll(corners, -1, axis=0) - corners
    across = corners[:, 0] * sides[:, 1] - corners[:, 1] * sides[:, 0]
    apothem = np.min(np.abs(across) / np.linalg.norm(sides, axis=1))
    inner, flare = 1.0 - rng.uniform(0.004, 0.008) / apothem, rng.uniform(0.7, 1.2)
    if inner < 0.3:
        return [_frustum(outline, middle + flare * corners, bottom, top)]
    parts = []
    for side in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        low = np.concatenate([side, inner * np.array(side[::-1])])
        parts.append(_frustum(middle + low, middle + flare * low, bottom, top))
    return parts


def _footprint(rng: Generator, reach: float) -> np.ndarray:
    """Draws a convex polygon of 3 to 7 corners [n, 2], _THIN to `reach` m from the origin."""
    half = np.maximum(reach * rng.uniform(0.1, 1.0, 2), _THIN)
    if rng.integers(2):
        return half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    corners = int(rng.integers(3, 8))
    angle = 2.0 * np.pi * (np.arange(corners) + rng.uniform(-0.2, 0.2, corners)) / corners
    return half * np.stack([np.cos(angle), np.sin(angle)], axis=1)


Family = Callable[[Generator], list[Part]]
FAMILIES: dict[str, Family] = {
    family.__name__: family
    for family in (
        *(bottle, bowl, cup, superquadric, bracket, tube, nut),
        *(star, wedge, rod, tool, stone, dumbbell, brick),
    )
}


def draw(seed: int, count: int) -> list[Object]:
    """Draws `count` objects, one family after another; a longer list begins with the shorter."""
    families = [*FAMILIES.values()]
    return [_object(families[i % len(families)], seed, i) for i in range(count)]


def draw_mixed(seed: int, count: int) -> list[Object]:
    """Draws `count` objects: those of `draw` and assemblies, alternating."""
    shapes = draw(seed, -(-count // 2))
    pairs = ((shape, _object(assembly, seed, i)) for i, shape in enumerate(shapes))
    return [*itertools.chain.from_iterable(pairs)][:count]


def _object(family: Family, seed: int, number: int) -> Object:
    name = family.__name__
    parts = family(np.random.default_rng([seed, number]))
    return body.make(f"{name}-{seed}-{number}", parts, family=name)
