"""Our own shapes."""

import numpy as np
import pytest
from scipy import optimize

from csac_jax import grippers
from csac_jax.objects import body, families, solid, tables
from csac_jax.objects.body import Object
from csac_jax.objects.solid import Part

MADE = families.draw(3, 8 * len(families.FAMILIES))
ASSEMBLIES = families.draw_mixed(3, 120)[1::2]
KINDS = [*families.FAMILIES, "assembly"]


def _depths(one: Object, points: np.ndarray) -> np.ndarray:
    """How deep points [n, 3] lie in each part [n, parts] m; negative outside."""
    depths = [part.planes[:, 3] - points @ part.planes[:, :3].T for part in one.parts]
    return np.stack([depth.min(axis=1) for depth in depths], axis=1)


def _touch(one: Part, other: Part) -> bool:
    """A point lies in both, or 0.1 mm beside them."""
    planes = np.concatenate([one.planes, other.planes])
    found = optimize.linprog(np.zeros(3), planes[:, :3], planes[:, 3] + 1e-4, bounds=(None, None))
    return bool(found.status == 0)


def test_there_are_twelve_families_and_more():
    """Claim: there are at least 12 families, and each is drawn in turn."""
    names = [one.family for one in MADE[: len(families.FAMILIES)]]
    assert len(set(names)) == len(names) >= 12


@pytest.mark.parametrize("family", KINDS)
def test_shapes_can_be_simulated_and_held(family: str):
    """Claim: shapes of a family are sound, of few faces, and pass between the fingers."""
    for one in (each for each in [*MADE, *ASSEMBLIES] if each.family == family):
        assert body.faults(one) is None
        assert len(one.parts) <= 12
        assert solid.narrowest(one.parts) < grippers.load("rg2").opening[1] - 0.02


@pytest.mark.parametrize("family", KINDS)
def test_parts_touch_and_do_not_overlap(family: str):
    """Claim: no point lies in two parts; each part touches another one. So volume and inertia are
    sums over the parts."""
    rng = np.random.default_rng(0)
    some = 30 if family == "assembly" else 3
    for one in [each for each in [*MADE, *ASSEMBLIES] if each.family == family][:some]:
        points = rng.uniform(*one.bounds, (20000, 3))
        depths = _depths(one, points)
        assert ((depths > 2e-5).sum(axis=1) <= 1).all()
        share = (depths.max(axis=1) > 0).mean()
        assert share * np.prod(np.ptp(one.bounds, axis=0)) == pytest.approx(one.volume, rel=0.15)
        for part in one.parts[1:]:
            assert any(_touch(part, other) for other in one.parts if other is not part)


def test_a_tube_has_its_closed_form():
    """Claim: the volume of a tube is that of the polygons' difference times its length."""
    one = next(each for each in MADE if each.family == "tube")
    corners = np.concatenate([part.vertices for part in one.parts])
    radii, sides = np.linalg.norm(corners[:, :2], axis=1), families.SIDES
    area = 0.5 * sides * np.sin(2 * np.pi / sides) * (radii.max() ** 2 - radii.min() ** 2)
    assert one.volume == pytest.approx(area * np.ptp(corners[:, 2]), rel=1e-4)


@pytest.mark.parametrize(("half", "parts"), [(0.03, 4), (0.007, 1)])
def test_a_wall_has_its_closed_form(half: float, parts: int):
    """Claim: a wall inside a square is the frustum of the square less that of a bore, which leaves
    4 to 8 mm; a square of less than some 10 mm is full. Some assemblies have a wall."""
    square, height = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]), 0.05
    wall = families._fence(np.random.default_rng(2), 0.01 + square, 0.02, 0.02 + height)
    thick, flare = np.random.default_rng(2).uniform([0.004, 0.7], [0.008, 1.2])
    full = 4.0 * half**2 * height * (1.0 + flare + flare**2) / 3.0
    bore = ((half - thick) / half) ** 2 if parts == 4 else 0.0
    assert len(wall) == parts
    assert sum(solid.moments(part).volume for part in wall) == pytest.approx(
        full * (1.0 - bore), rel=1e-5
    )
    assert 3 < sum(len(one.parts) > 5 for one in ASSEMBLIES) < 20  # a block has no more


def test_bodies_are_centred():
    """Claim: the origin of an object is its centre of mass."""
    for one in MADE:
        whole = solid.joined(map(solid.moments, one.parts))
        np.testing.assert_allclose(whole.first / whole.volume, 0.0, atol=1e-6)


def test_shapes_follow_from_the_seed():
    """Claim: a longer list begins with the shorter one; another seed gives others."""
    again, other = families.draw(3, 20), families.draw(4, 20)
    for one, two, three in zip(MADE, again, other, strict=False):
        assert one.name == two.name
        assert one.volume == two.volume != three.volume


def test_assemblies_come_between():
    """Claim: `mixed:SEED:COUNT` is `made:SEED:COUNT / 2` with an assembly after each object; they
    train, but for some, and no two are alike."""
    mixed = tables.find("mixed:3:120", "all").objects
    assert [one.name for one in mixed[::2]] == [one.name for one in MADE[:60]]
    assert {one.family for one in mixed[1::2]} == {"assembly"}
    assert 0 < sum(one.held_out for one in mixed[1::2]) < 30
    assert len({one.volume for one in mixed[1::2]}) == 60


def test_splits_are_disjoint_and_by_name():
    """Claim: an object is held out by the digest of its name or family, alone or in a library;
    whole families and some objects of every other one are."""
    made = tables.find("made:0:280", "all").objects
    train = {one.name for one in tables.find("made:0:280", "train").objects}
    kept = {one.name for one in tables.find("made:0:280", "held_out").objects}
    assert train | kept == {one.name for one in made}
    assert not train & kept
    held_out = {name: [] for name in families.FAMILIES}
    for one in made:
        held_out[one.family].append(one.held_out)
    whole = [name for name, flags in held_out.items() if all(flags)]
    assert whole == ["bracket", "tube", "wedge"]
    assert all(any(flags) for flags in held_out.values())


def test_tables_hold_every_face():
    """Claim: an object is what lies between two chunks with `first`: a point is inside a part of
    the table just where it is inside one of the object."""
    source = tables.find("made:0:42", "all")
    known, rng = tables.from_library(source), np.random.default_rng(0)
    for number, one in enumerate(source.objects):
        points = rng.uniform(*one.bounds, (500, 3)).astype(np.float32)
        depth = known.offset[number] - np.einsum("cfi,ni->ncf", known.normal[number], points)
        deep = depth.min(axis=2)  # [n, C]
        parts = [deep[:, known.part[number] == p].min(axis=1) for p in range(len(one.parts))]
        np.testing.assert_allclose(np.stack(parts, axis=1), _depths(one, points), atol=1e-6)
        starts = np.flatnonzero(known.first[number])
        assert len(np.unique(known.part[number][starts])) >= len(one.parts)
