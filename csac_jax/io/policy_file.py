"""A policy in a .safetensors file: its networks' variables and the config they were trained with.

Nothing in such a file is executed. It holds a digest of all its content, and the versions that made
it. Those of `SHIPPED` come with the package, see docs/policies.md. Their digests stand here, so
that a replaced file is noticed.
"""

import hashlib
import json
import warnings
from pathlib import Path
from typing import Any

import jax
import numpy as np
import safetensors
import safetensors.numpy

from csac_jax import grippers
from csac_jax.agent import actor_critic
from csac_jax.agent.actor_critic import Params
from csac_jax.config import Config
from csac_jax.errors import DataWarning, FailedError
from csac_jax.io import configs, files, leaves
from csac_jax.runtime import provenance

_FOLDER = Path(__file__).parents[1] / "policies"
SHIPPED = {
    "shipped": _FOLDER / "clear.safetensors",
    "shipped_camera": _FOLDER / "camera.safetensors",
    "shipped_clutter": _FOLDER / "clutter.safetensors",
    "shipped_grippers": _FOLDER / "grippers.safetensors",
    "shipped_objects": _FOLDER / "objects.safetensors",
    "shipped_target": _FOLDER / "target.safetensors",
}
_SHA256 = {
    SHIPPED["shipped"]: "e5a7d1d90b63c40535493ad68819a33d5f97cac52b776f1cd5e9bb13a241bf0c",
    SHIPPED["shipped_camera"]: "70db3538a3e81cedb314b57c6e1ee72db42eedc20d06a30b20d2d68ccfa9070f",
    SHIPPED["shipped_clutter"]: "cf3f9ff4b12320842f72adeea50d832eab83c7fe79541f559066e1ed297e2ef2",
    SHIPPED["shipped_grippers"]: "dddb79b4b7ec1205ef751218c81d727604605eb91f4b0bcbfe8c934016cf6f19",
    SHIPPED["shipped_objects"]: "12bf20a8a5597f313de22580922bfa6b0ac89f614ae06d4afe401f81f1ad425e",
    SHIPPED["shipped_target"]: "74f90256dfb15d9c89fb6d5c95382ed80eab0050ce6200426fe52a07a857ab8e",
}
_CONFIG, _VERSIONS, _DIGEST = "config", "versions", "sha256"  # names of the file's remarks
_GRIPPER = "gripper"  # remark of older files: the numbers of a gripper of one's own


class PolicyFileError(FailedError):
    """A file that is no policy, or a damaged one; the message is one line with the remedy."""


def save(path: Path, params: Params, cfg: Config) -> None:
    """Writes a policy; see `files.replace`. Raises OSError where it cannot be written, and
    PolicyFileError for networks that are not finite."""
    tensors = {name: np.asarray(leaf) for name, leaf in leaves.named(params).items()}
    check_finite(path, tensors)
    versions = json.dumps(provenance.versions())
    gripper = grippers.resolve(cfg.sim.gripper)  # its folder is not where the policy goes
    stored = configs.to_dict(cfg.change(sim={"gripper": gripper}))
    remarks = {_CONFIG: json.dumps(stored), _VERSIONS: versions}
    remarks[_DIGEST] = _digest(remarks, tensors)
    files.replace(path, safetensors.numpy.save(tensors, remarks))


def check_finite(source: Any, params: Any) -> None:
    """Raises PolicyFileError for networks with a number that is not finite."""
    for name, leaf in leaves.named(params).items():
        if not np.isfinite(np.asarray(leaf, np.float32)).all():
            raise PolicyFileError(f"{source}: {name} is not finite; take an earlier policy")


def _digest(remarks: dict[str, str], tensors: dict[str, np.ndarray]) -> str:
    """SHA-256 of a policy's content but the digest itself."""
    content = hashlib.sha256()
    for name in sorted(remarks.keys() - {_DIGEST}):
        content.update(f"{name}={remarks[name]}\n".encode())
    for name, tensor in sorted(tensors.items()):
        content.update(f"{name}={tensor.dtype}{list(tensor.shape)}\n".encode())
        content.update(tensor.tobytes())
    return content.hexdigest()


def find(source: str | Path) -> Path:
    """The policy file or run's folder that `source` names. Raises FileNotFoundError."""
    path = SHIPPED.get(str(source), Path(source))
    if not path.exists():
        known = ", ".join(SHIPPED)
        raise FileNotFoundError(
            f"there is no folder {path}; give the folder of a run, a policy file, or one of {known}"
        )
    return path


def is_policy(path: Path) -> bool:
    """Whether a .safetensors file holds a config."""
    try:
        with safetensors.safe_open(path, "numpy") as file:
            return _CONFIG in (file.metadata() or {})
    except Exception:  # a damaged header raises nearly anything
        return False


def load(path: Path) -> tuple[Config, Params]:
    """Config and networks of a policy. Raises PolicyFileError for a file that is none, is damaged
    or another version's. Warns of one without a digest, and of one by other versions."""
    ours = path in _SHA256
    if ours and hashlib.sha256(path.read_bytes()).hexdigest() != _SHA256[path]:
        raise PolicyFileError(f"{path} is not the file that this version ships; reinstall csac-jax")
    try:
        with safetensors.safe_open(path, "numpy") as file:
            remarks = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118, it is no dict
    except Exception as error:  # a damaged header raises nearly anything
        raise PolicyFileError(
            f"{path} cannot be read as .safetensors ({files.first_line(error)}); give another file"
        ) from None
    if _CONFIG not in remarks:
        raise PolicyFileError(
            f"{path} holds no config: it is no policy; csac-jax export writes one"
        )
    if _DIGEST not in remarks and not ours:
        text = f"{path} has no digest, so damage goes unseen; csac-jax export writes one"
        warnings.warn(text, DataWarning, stacklevel=2)
    elif not ours and remarks[_DIGEST] != _digest(remarks, tensors):
        raise PolicyFileError(f"{path} is damaged: its digest differs; give another file")
    try:
        cfg = configs.from_dict(files.parse(remarks[_CONFIG], _CONFIG))
        if _GRIPPER in remarks:
            numbers = files.parse(remarks[_GRIPPER], _GRIPPER)
            gripper = grippers.from_numbers(Path(str(cfg.sim.gripper)), numbers)
            cfg = cfg.change(sim={"gripper": gripper})
        made = files.parse(remarks.get(_VERSIONS, "{}"), _VERSIONS)
        if not ours:
            provenance.warn_if_other(made, str(path))
    except ValueError as error:
        raise PolicyFileError(
            f"{path} was made by another version of csac_jax ({error}); use that version"
        ) from None
    try:
        blank = actor_critic.abstract_params(cfg)
    except Exception as error:  # sizes that no network can have
        raise PolicyFileError(
            f"{path} has a config without networks ({files.first_line(error)}); give another file"
        ) from None
    if found := leaves.difference(leaves.layout(tensors), leaves.layout(blank)):
        name, has, asked = found
        raise PolicyFileError(
            f"{path} holds {name} as {has}, its config asks for {asked}; export it anew"
        )
    check_finite(path, tensors)
    params = [tensors[name] for name in leaves.named(blank)]
    return cfg, jax.tree.unflatten(jax.tree.structure(blank), params)
