"""The block set of VPG (arXiv:1803.09956): eight shapes in ten colours.

A slot of kind `box` may hold cube, cuboid, plank or tile; every other kind is one shape. The origin
of a block's frame is the centre of its bounding box. Boxes and arches scale along each axis, the
other shapes as a whole. An arch is three convex parts, every other shape one.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.config import MESH_KINDS, SceneConfig, SlotKind


class Shape(NamedTuple):
    """A block of the set."""

    kind: SlotKind
    half_size: tuple[float, float, float]  # m, half of the bounding box


SHAPES = {
    "cube": Shape("box", (0.025, 0.025, 0.025)),
    "cuboid": Shape("box", (0.05, 0.025, 0.025)),
    "plank": Shape("box", (0.05, 0.025, 0.0125)),
    "tile": Shape("box", (0.025, 0.025, 0.0125)),
    "arch": Shape("arch", (0.05, 0.025, 0.025)),
    "prism": Shape("prism", (0.0467, 0.025, 0.0243)),
    "half_cylinder": Shape("half_cylinder", (0.025, 0.025, 0.0125)),
    "cylinder": Shape("cylinder", (0.0224, 0.0224, 0.025)),
}
OBJECT_HALF = (0.03, 0.03, 0.03)  # m, of slots of kind object before they get one
MAX_FACES = 10
PADDING_OFFSET = 1e3  # m, offset of a padding face: every point lies inside it

_NAMES = "blue green brown orange yellow grey red purple cyan pink"  # Tableau's ten, as in VPG
_SRGB = "4e79a7 59a14f 9c755f f28e2b edc948 bab0ac ff5759 b07aa1 76b7b2 ff9da7"
COLOUR_NAMES = tuple(_NAMES.split())
COLOURS = np.array([[*bytes.fromhex(_SRGB)]], np.float32).reshape(10, 3) / np.float32(255)  # 0..1
TABLE_COLOUR = np.array([0.35, 0.33, 0.31], np.float32)


def half_size_choices(kind: SlotKind) -> np.ndarray:
    """Returns nominal half sizes [choices, 3] m of the shapes that a slot of a kind may hold."""
    halves = [shape.half_size for shape in SHAPES.values() if shape.kind == kind]
    return np.array(halves or [OBJECT_HALF], np.float32)


def is_object(slots: tuple[SlotKind, ...]) -> np.ndarray:
    """Returns [N] bool, slots that hold objects of a library."""
    return np.array(slots) == "object"


def is_mesh(slots: tuple[SlotKind, ...]) -> np.ndarray:
    """Returns [N] bool, slots whose blocks are meshes."""
    return np.isin(slots, MESH_KINDS)


Faces = tuple[np.ndarray, np.ndarray]  # outward normals [F, 3], offsets [F] m, of nominal size
# Centre and half size of every convex part, in units of the block's half size.
_WHOLE = (((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),)
_ARCH = (  # two posts and a lintel: a square tunnel, 50 x 25 mm, for the half-round of VPG
    ((-0.75, 0.0, 0.0), (0.25, 1.0, 1.0)),
    ((0.75, 0.0, 0.0), (0.25, 1.0, 1.0)),
    ((0.0, 0.0, 0.5), (0.5, 1.0, 0.5)),
)


class Parts(NamedTuple):
    """The convex parts of the blocks of all slots. G = parts."""

    slot: np.ndarray  # [G] int, slot that the part belongs to
    centre: np.ndarray  # [G, 3] in units of the slot's half size
    half: np.ndarray  # [G, 3] likewise


def parts(slots: tuple[SlotKind, ...]) -> Parts:
    """Lists the parts of all slots in order; objects of a library have none here."""
    of_slot = [{"arch": _ARCH, "object": ()}.get(kind, _WHOLE) for kind in slots]
    slot = np.repeat(np.arange(len(slots)), [*map(len, of_slot)])
    boxes = np.array([part for whole in of_slot for part in whole], np.float32).reshape(-1, 2, 3)
    return Parts(slot, boxes[:, 0], boxes[:, 1])


def _prism_faces() -> Faces:
    # Base down, two ends across y, two slopes up to the apex.
    x, y, z = SHAPES["prism"].half_size
    slope = np.array([2 * z, 0.0, x]) / np.hypot(2 * z, x)
    normals = np.array([[0, 0, -1], [0, 1, 0], [0, -1, 0], slope, slope * [-1, 1, 1]])
    return normals, np.array([z, y, y, slope[2] * z, slope[2] * z])


def _half_cylinder_faces() -> Faces:
    # Six chords of a half circle about y, its flat face down.
    radius, y, z = SHAPES["half_cylinder"].half_size
    angle = (np.arange(6) + 0.5) * np.pi / 6
    round_ = np.stack([np.cos(angle), np.zeros(6), np.sin(angle)], axis=1)
    normals = np.concatenate([round_, [[0, 0, -1], [0, 1, 0], [0, -1, 0]]])
    chord = radius * np.cos(np.pi / 12) - z * round_[:, 2]  # the circle's centre lies at -z
    return normals, np.concatenate([chord, [z, y, y]])


def _cylinder_faces() -> Faces:
    # An octagon through a circle about z.
    radius, _, z = SHAPES["cylinder"].half_size
    angle = (np.arange(8) + 0.5) * np.pi / 4
    sides = np.stack([np.cos(angle), np.sin(angle), np.zeros(8)], axis=1)
    normals = np.concatenate([sides, [[0, 0, 1], [0, 0, -1]]])
    return normals, np.concatenate([np.full(8, radius * np.cos(np.pi / 8)), [z, z]])


# The offset of face f of a box is |normal_f| . half_size, which differs per scene.
_BOX = np.concatenate([np.eye(3), -np.eye(3)]), np.zeros(6)
FACES = {
    "box": _BOX,
    "arch": _BOX,
    "prism": _prism_faces(),
    "half_cylinder": _half_cylinder_faces(),
    "cylinder": _cylinder_faces(),
}


def half_spaces(slots: tuple[SlotKind, ...], half_size: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Computes the faces of every part in its block's frame: inside, n . p <= offset for all.

    Returns: outward unit normals [G, F, 3], 0 for padding; offsets [G, F] m.
    """
    slot, centre, half = parts(slots)
    normals = np.zeros((len(slot), MAX_FACES, 3), np.float32)
    nominal = np.full((len(slot), MAX_FACES), PADDING_OFFSET, np.float32)
    for part, (normal, offset) in enumerate(FACES[slots[i]] for i in slot):
        normals[part, : len(normal)], nominal[part, : len(offset)] = normal, offset
    size = half_size[slot]  # [G, 3]
    from_centre = np.abs(normals) * (half * size)[:, None]
    reach = jnp.sum(from_centre + normals * (centre * size)[:, None], axis=-1)
    scaled = nominal * mesh_scale(slots, half_size)[slot][:, None]
    offsets = jnp.where(is_mesh(slots)[slot][:, None], scaled, reach)
    return jnp.asarray(normals), jnp.where(nominal < PADDING_OFFSET, offsets, PADDING_OFFSET)


def scales(cfg: SceneConfig, noise: Any) -> Any:
    """Computes sizes [N] relative to nominal from noise [N] in -1 .. 1; of one mesh, one size."""
    shared, jitter = is_mesh(cfg.slots), np.array(cfg.size_jitter, np.float32)
    first = [cfg.slots.index(kind) for kind in cfg.slots]
    leader = np.where(shared, first, np.arange(len(first)))
    return (1.0 + np.where(shared, jitter[1], jitter[0]) * noise)[leader]


def mesh_scale(slots: tuple[SlotKind, ...], half_size: jax.Array) -> jax.Array:
    """Computes the size of mesh blocks relative to nominal [N], by their height."""
    nominal = np.array([half_size_choices(kind)[0][2] for kind in slots], np.float32)
    return half_size[:, 2] / nominal
