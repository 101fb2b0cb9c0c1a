"""Our own shapes."""

import numpy as np
import pytest
from scipy import optimize

from csac_jax import grippers
from csac_jax.objects import body, shapes, solid, tables
from csac_jax.objects.body import Object
from csac_jax.objects.solid import Part

MADE = shapes.draw(3, 8 * len(shapes.FAMILIES))
ASSEMBLIES = shapes.draw_mixed(3, 120)[1::2]


def _members(family: str) -> list[Object]:
    return [member for member in [*MADE, *ASSEMBLIES] if member.family == family]


def _depths(member: Object, points: np.ndarray) -> np.ndarray:
    """Computes depths of points [n, 3] in each part [n, parts] m; negative outside."""
    depths = [part.planes[:, 3] - points @ part.planes[:, :3].T for part in member.parts]
    return np.stack([depth.min(axis=1) for depth in depths], axis=1)


def _touch(one: Part, other: Part) -> bool:
    """Tests for a point in both, or within 0.1 mm of them."""
    planes = np.concatenate([one.planes, other.planes])
    result = optimize.linprog(np.zeros(3), planes[:, :3], planes[:, 3] + 1e-4, bounds=(None, None))
    return bool(result.status == 0)


@pytest.mark.parametrize("family", [*shapes.FAMILIES, "assembly"])
def test_shapes_can_be_simulated_and_held(family: str):
    """Claim: shapes are sound, centred at their mass, of few faces, and pass between the fingers.
    No point lies in two parts, and each part touches another one: volume and inertia are sums."""
    rng = np.random.default_rng(0)
    for member in _members(family):
        assert body.faults(member) is None
        assert len(member.parts) <= 12
        assert member.narrowest < grippers.load("rg2").opening[1] - 0.02
        whole = solid.joined(map(solid.moments, member.parts))
        np.testing.assert_allclose(whole.first / whole.volume, 0.0, atol=1e-6)
    for member in _members(family)[: 30 if family == "assembly" else 3]:
        depths = _depths(member, rng.uniform(*member.bounds, (20000, 3)))
        assert ((depths > 2e-5).sum(axis=1) <= 1).all()
        volume = (depths.max(axis=1) > 0).mean() * np.prod(np.ptp(member.bounds, axis=0))
        assert volume == pytest.approx(member.volume, rel=0.15)
        for part in member.parts[1:]:
            assert any(_touch(part, other) for other in member.parts if other is not part)


def test_a_tube_has_its_closed_form():
    """Claim: the volume of a tube is that of the polygons' difference times its length."""
    tube = _members("tube")[0]
    corners = np.concatenate([part.vertices for part in tube.parts])
    radii, sides = np.linalg.norm(corners[:, :2], axis=1), shapes.SIDES
    area = 0.5 * sides * np.sin(2 * np.pi / sides) * (radii.max() ** 2 - radii.min() ** 2)
    assert tube.volume == pytest.approx(area * np.ptp(corners[:, 2]), rel=1e-4)


def test_shapes_follow_from_the_seed():
    """Claim: at least 12 families are drawn in turn; a longer list begins with the shorter one;
    another seed gives others."""
    names = [member.family for member in MADE[: len(shapes.FAMILIES)]]
    assert len(set(names)) == len(names) >= 12
    again, other = shapes.draw(3, 20), shapes.draw(4, 20)
    for one, two, three in zip(MADE, again, other, strict=False):
        assert one.name == two.name
        assert one.volume == two.volume != three.volume


def test_assemblies_come_between():
    """Claim: `procedural+assemblies:SEED:COUNT` has an assembly after each object of
    `procedural:SEED:COUNT / 2`; they train, but for some, and no two are alike."""
    mixed = tables.find("procedural+assemblies:3:120", "all").objects
    assert [member.name for member in mixed[::2]] == [member.name for member in MADE[:60]]
    assert {member.family for member in mixed[1::2]} == {"assembly"}
    assert 0 < sum(member.held_out for member in mixed[1::2]) < 30
    assert len({member.volume for member in mixed[1::2]}) == 60


def test_splits_are_disjoint_and_by_name():
    """Claim: an object is held out by the digest of its name or family, alone or in a library;
    whole families and some objects of every other one are."""
    made, train, held_out = (
        tables.find("procedural:0:280", split).objects for split in ("all", "train", "held_out")
    )
    names = [{member.name for member in members} for members in (made, train, held_out)]
    assert names[1] | names[2] == names[0]
    assert not names[1] & names[2]
    assert {member.family for member in held_out} == set(shapes.FAMILIES)
    trained = {member.family for member in train}
    assert trained == set(shapes.FAMILIES) - {"bracket", "tube", "wedge"}


def test_tables_hold_every_face():
    """Claim: an object is what lies between two chunks with `first`: a point is inside a part of
    the table just where it is inside one of the object."""
    source = tables.find("procedural:0:42", "all")
    table, rng = tables.from_library(source), np.random.default_rng(0)
    for number, member in enumerate(source.objects):
        points = rng.uniform(*member.bounds, (500, 3)).astype(np.float32)
        depth = table.offset[number] - np.einsum("cfi,ni->ncf", table.normal[number], points)
        deep = depth.min(axis=2)  # [n, C]
        parts = [deep[:, table.part[number] == p].min(axis=1) for p in range(len(member.parts))]
        np.testing.assert_allclose(np.stack(parts, axis=1), _depths(member, points), atol=1e-6)
        starts = np.flatnonzero(table.first[number])
        assert len(np.unique(table.part[number][starts])) >= len(member.parts)
