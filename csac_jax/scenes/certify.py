"""Certified scenes: in each hardly any grasp lifts, before a push after which many do.

A file of them is an .npz archive: the scenes' leaves [P, N, ...], and of every candidate, kept or
refused, its certificate and a digest. `evaluation.certification` makes one.
"""

import dataclasses
import hashlib
import io
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from csac_jax.assets import assets
from csac_jax.errors import SettingsError
from csac_jax.world.scene_state import SceneState

_SCENE = "scene."  # before the names of a scene's leaves in a file


class Certificate(NamedTuple):
    """Measurements of a candidate."""

    generator: str  # construction or case file
    seed: int  # of the generator's key
    before: float  # share of the grasps of the whole grid that lift; of too many, so far
    after: float  # the same of random grasps after the best push
    push: int  # number of that push; -1: none is good enough, and the scene is refused


@dataclasses.dataclass(frozen=True)
class CertifiedScenes:
    """Certificates by generator and seed, each with its scene of NumPy leaves [N, ...]."""

    settings: str  # world, engine and search that the numbers are of
    entries: dict[Certificate, SceneState | None]  # None: refused

    @property
    def kept(self) -> list[Certificate]:
        """Returns the certificates of the scenes, in their order."""
        return [one for one in sorted(self.entries) if self.entries[one] is not None]

    @property
    def scenes(self) -> SceneState:
        """Returns the scenes [P, N, ...], at least one."""
        rows = [self.entries[one] for one in self.kept]
        return jax.tree.map(lambda *leaves: np.stack(leaves), *rows)


def digest(settings: str, certificate: Certificate, scene: SceneState | None) -> str:
    """Returns the SHA-256 digest over the settings, a certificate and its scene's leaves."""
    content = hashlib.sha256(repr((settings, *certificate)).encode())
    for name, leaf in _leaves(scene).items():
        content.update(repr((name, leaf.dtype.str, leaf.shape)).encode() + leaf.tobytes())
    return content.hexdigest()


def encode(certified: CertifiedScenes) -> bytes:
    """Returns the content of a file, the same for the same scenes."""
    rows = sorted(certified.entries)
    arrays: dict[str, Any] = {"settings": certified.settings}
    arrays |= {k: [getattr(row, k) for row in rows] for k in Certificate._fields}
    arrays["sha256"] = [digest(certified.settings, row, certified.entries[row]) for row in rows]
    if certified.kept:
        arrays |= {_SCENE + name: leaf for name, leaf in _leaves(certified.scenes).items()}
    np.savez_compressed(buffer := io.BytesIO(), **arrays)
    return buffer.getvalue()


def shipped(name: str) -> Path:
    """Returns the path of a file of the package, of a suite or, with -train, for training."""
    return assets() / "certified" / f"{name}.npz"


def load(path: Path) -> CertifiedScenes:
    """Loads certified scenes. Raises SettingsError, one line: with the file for one that is
    damaged, with generator and seed for a certificate or scene that does not fit its digest."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        settings, columns = str(arrays["settings"]), (arrays[name] for name in Certificate._fields)
        rows = zip(*(column.tolist() for column in columns), strict=True)
        leaves = {k.removeprefix(_SCENE): v for k, v in arrays.items() if k.startswith(_SCENE)}
        scenes = SceneState(**leaves) if leaves else None
        entries, kept = {}, 0
        for row in map(Certificate._make, rows):
            entries[row] = (
                jax.tree.map(lambda leaf, i=kept: leaf[i], scenes) if row.push >= 0 else None
            )
            kept += row.push >= 0
        digests = arrays["sha256"].tolist()
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read: {error.strerror or error}") from None
    except Exception:  # a damaged archive raises nearly anything, from BadZipFile to KeyError
        raise SettingsError(f"{path}: is no sound file of certified scenes") from None
    for (row, scene), stored in zip(entries.items(), digests, strict=True):
        if digest(settings, row, scene) != stored:
            name = f"scene {row.generator} {row.seed}"
            raise SettingsError(f"{path}: {name}: its certificate does not fit its digest")
    return CertifiedScenes(settings, entries)


def _leaves(scene: SceneState | None) -> dict[str, np.ndarray]:
    items = {} if scene is None else vars(scene)
    return {name: np.asarray(leaf) for name, leaf in items.items() if leaf is not None}
