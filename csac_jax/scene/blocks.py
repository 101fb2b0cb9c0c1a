"""The block set: sizes, faces and colours. Shapes that are no boxes have a fixed size; box sizes differ per scene."""

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.config import SlotKind

BOX_HALF_SIZES = np.array(
    [[0.025, 0.025, 0.025], [0.05, 0.025, 0.025], [0.05, 0.025, 0.0125], [0.025, 0.025, 0.0125]], np.float32
)  # [4, 3] m: cube, cuboid, plank, tile (block set of VPG, arXiv:1803.09956)
FIXED_HALF_SIZES = {"prism": (0.0467, 0.025, 0.0243), "cylinder": (0.0224, 0.0224, 0.025)}  # m, bounding boxes
MAX_FACES = 10
PADDING_OFFSET = 1e3  # m, offset of a face that is not there: every point lies inside it

COLOURS = np.array(
    [
        [78, 121, 167],
        [89, 161, 79],
        [156, 117, 95],
        [242, 142, 43],
        [237, 201, 72],
        [186, 176, 172],
        [255, 87, 89],
        [176, 122, 161],
        [118, 183, 178],
        [255, 157, 167],
    ],
    np.float32,
) / np.float32(255)  # [10, 3] sRGB in 0..1 (Tableau's ten, as in VPG)
TABLE_COLOUR = np.array([0.35, 0.33, 0.31], np.float32)


def _box_faces() -> tuple[np.ndarray, np.ndarray]:
    """Normals [6, 3]; the offset of face f is |normal_f| . half_size, which differs per scene."""
    eye = np.eye(3)
    return np.concatenate([eye, -eye]), np.zeros(6)


def _prism_faces() -> tuple[np.ndarray, np.ndarray]:
    """Triangular prism: base down, two ends across y, two slopes that meet at the apex."""
    x, y, z = FIXED_HALF_SIZES["prism"]
    slope = np.array([2 * z, 0.0, x]) / np.hypot(2 * z, x)
    normals = np.array([[0, 0, -1], [0, 1, 0], [0, -1, 0], slope, slope * [-1, 1, 1]])
    return normals, np.array([z, y, y, slope[2] * z, slope[2] * z])


def _cylinder_faces() -> tuple[np.ndarray, np.ndarray]:
    """Octagonal prism through a circle about z."""
    radius, _, z = FIXED_HALF_SIZES["cylinder"]
    angle = (np.arange(8) + 0.5) * np.pi / 4
    sides = np.stack([np.cos(angle), np.sin(angle), np.zeros(8)], axis=1)
    normals = np.concatenate([sides, [[0, 0, 1], [0, 0, -1]]])
    return normals, np.concatenate([np.full(8, radius * np.cos(np.pi / 8)), [z, z]])


_FACES = {"box": _box_faces, "prism": _prism_faces, "cylinder": _cylinder_faces}


def half_spaces(slots: tuple[SlotKind, ...], half_size: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Faces of every slot in the block's frame: a point p lies inside where n . p <= offset for all of them.

    Args: half_size [N, 3] m, which box slots take their offsets from.
    Returns: normals [N, F, 3], outward unit vectors, 0 where there is no face; offsets [N, F] m.
    """
    normals = np.zeros((len(slots), MAX_FACES, 3), np.float32)
    offsets = np.full((len(slots), MAX_FACES), PADDING_OFFSET, np.float32)
    for slot, kind in enumerate(slots):
        normal, offset = _FACES[kind]()
        normals[slot, : len(normal)], offsets[slot, : len(offset)] = normal, offset
    is_box_face = np.array([kind == "box" for kind in slots])[:, None] & (offsets < PADDING_OFFSET)
    reach = jnp.sum(jnp.abs(normals) * half_size[:, None], axis=-1)
    return jnp.asarray(normals), jnp.where(is_box_face, reach, offsets)


def half_size_choices(kind: SlotKind) -> np.ndarray:
    """Half sizes [choices, 3] m that a slot of this kind may take."""
    return BOX_HALF_SIZES if kind == "box" else np.array([FIXED_HALF_SIZES[kind]], np.float32)
