"""A policy in a .safetensors file: its networks' variables and the config they were trained with.

Nothing in such a file is executed. It holds a digest of its content, and the versions of the
libraries that made it. Files of `SHIPPED` come with the package, see docs/policies.md.
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

from csac_jax import grippers, reading
from csac_jax.agent import actor_critic
from csac_jax.agent.actor_critic import Params
from csac_jax.config import Config
from csac_jax.errors import DataWarning, FailedError, SettingsError
from csac_jax.io import configs, files, leaves
from csac_jax.runtime import provenance

_FOLDER = Path(__file__).parents[1] / "policies"
_DIGESTS = {  # so that a replaced file is detected
    "shipped": "05843c1c566ca7ead33a39fe1996238c693d9755fe6009ecc61cc3df99026342",
    "shipped_clutter": "cf3f9ff4b12320842f72adeea50d832eab83c7fe79541f559066e1ed297e2ef2",
}
SHIPPED = {name: _FOLDER / f"{name}.safetensors" for name in _DIGESTS}
_SHA256 = {path: _DIGESTS[name] for name, path in SHIPPED.items()}
_RETIRED = {  # name of an earlier version -> how `shipped` does what it did
    "shipped_camera": "",
    "shipped_general": "",
    "shipped_grippers": ", which takes any hand by --sim.gripper, or --gripper at a robot",
    "shipped_objects": "",
    "shipped_target": ", which gets what a mask marks, or takes all without one",
}
_CONFIG, _VERSIONS, _DIGEST = "config", "versions", "sha256"  # names of the file's remarks
_GRIPPER = "gripper"  # remark of older files: the numbers of the user's own gripper


class PolicyFileError(FailedError):
    """A file that is no policy or is damaged; the message is one line with the remedy."""


def save(path: Path, params: Params, cfg: Config) -> None:
    """Writes a policy. Raises OSError, and PolicyFileError for networks that are not finite."""
    tensors = {name: np.asarray(leaf) for name, leaf in leaves.named(params).items()}
    check_finite(path, tensors)
    gripper = grippers.resolve(cfg.sim.gripper)  # its folder is not where the policy goes
    stored = configs.to_dict(cfg.change(sim={"gripper": gripper}))
    remarks = {_CONFIG: json.dumps(stored), _VERSIONS: json.dumps(provenance.versions())}
    remarks[_DIGEST] = _digest(remarks, tensors)
    files.remove_drafts(path.parent)
    files.replace(path, safetensors.numpy.save(tensors, remarks))


def check_finite(source: Any, params: Any) -> None:
    """Raises PolicyFileError for networks with a number that is not finite."""
    for name, leaf in leaves.named(params).items():
        if not np.isfinite(np.asarray(leaf, np.float32)).all():
            raise PolicyFileError(f"{source}: {name} is not finite; take an earlier policy")


def _digest(remarks: dict[str, str], tensors: dict[str, np.ndarray]) -> str:
    content = hashlib.sha256()
    for name in sorted(remarks.keys() - {_DIGEST}):
        content.update(f"{name}={remarks[name]}\n".encode())
    for name, tensor in sorted(tensors.items()):
        content.update(f"{name}={tensor.dtype}{list(tensor.shape)}\n".encode())
        content.update(tensor.tobytes())
    return content.hexdigest()


def find(source: str | Path) -> Path:
    """Returns the policy file or run folder that `source` names. Raises FileNotFoundError, and
    SettingsError for a policy of an earlier version."""
    path = SHIPPED.get(str(source), Path(source))
    if not path.exists():
        if (instead := _RETIRED.get(str(source))) is not None:
            raise SettingsError(f"{source} ships no more; use shipped{instead}")
        known = f"give the folder of a run, a policy file, or one of {', '.join(SHIPPED)}"
        raise FileNotFoundError(f"there is no folder {path}; {known}")
    return path


def is_policy(path: Path) -> bool:
    """Returns whether a .safetensors file holds a config."""
    try:
        with safetensors.safe_open(path, "numpy") as file:
            return _CONFIG in (file.metadata() or {})
    except Exception:  # a damaged header raises nearly anything
        return False


def load(path: Path) -> tuple[Config, Params]:
    """Reads config and networks of a policy.

    Raises PolicyFileError for a file that is no policy, is damaged or needs another version. Warns
    of a file without a digest, and of one that other versions of the libraries made.
    """
    ours = path in _SHA256
    if ours and hashlib.sha256(path.read_bytes()).hexdigest() != _SHA256[path]:
        raise PolicyFileError(f"{path} is not the file that this version ships; reinstall csac-jax")
    remarks, tensors = _content(path)
    if _DIGEST not in remarks:
        text = f"{path} has no digest, so damage goes unseen; csac-jax export writes one"
        warnings.warn(text, DataWarning, stacklevel=2)
    elif remarks[_DIGEST] != _digest(remarks, tensors):
        raise PolicyFileError(f"{path} is damaged: its digest differs; give another file")
    cfg, versions = _config(path, remarks)
    if not ours:
        provenance.warn_if_other(versions, str(path))
    return cfg, _params(path, cfg, tensors)


def _content(path: Path) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    try:
        reading.check_regular(path)
        with safetensors.safe_open(path, "numpy") as file:
            remarks = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118, it is no dict
    except Exception as error:  # a damaged header raises nearly anything
        reason = files.first_line(error)
        text = f"{path} cannot be read as .safetensors ({reason}); give another file"
        raise PolicyFileError(text) from None
    if _CONFIG not in remarks:
        text = f"{path} holds no config: it is no policy; csac-jax export writes one"
        raise PolicyFileError(text)
    return remarks, tensors


def _config(path: Path, remarks: dict[str, str]) -> tuple[Config, Any]:
    try:
        cfg = configs.from_dict(files.parse(remarks[_CONFIG], _CONFIG), acts=True)
        if _GRIPPER in remarks:
            numbers = files.parse(remarks[_GRIPPER], _GRIPPER)
            gripper = grippers.from_numbers(Path(str(cfg.sim.gripper)), numbers)
            cfg = cfg.change(sim={"gripper": gripper})
        return cfg, files.parse(remarks.get(_VERSIONS, "{}"), _VERSIONS)
    except ValueError as error:
        text = f"{path} was made by another version of csac_jax ({error}); use that version"
        raise PolicyFileError(text) from None


def _params(path: Path, cfg: Config, tensors: dict[str, np.ndarray]) -> Params:
    try:
        blank = actor_critic.abstract_params(cfg)
    except Exception as error:  # sizes that no network can have
        reason = files.first_line(error)
        text = f"{path} has a config without networks ({reason}); give another file"
        raise PolicyFileError(text) from None
    if different := leaves.difference(leaves.layout(tensors), leaves.layout(blank)):
        name, has, asked = different
        text = f"{path} holds {name} as {has}, its config asks for {asked}; export it again"
        raise PolicyFileError(text)
    check_finite(path, tensors)
    params = [tensors[name] for name in leaves.named(blank)]
    return jax.tree.unflatten(jax.tree.structure(blank), params)
