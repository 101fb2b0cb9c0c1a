"""A policy in a .safetensors file: its networks' variables and the config they were trained with.

Nothing in such a file is executed. `SHIPPED` comes with the package; its digest stands here, so
that a file that was damaged or replaced is noticed.
"""

import hashlib
import json
from pathlib import Path

import jax
import numpy as np
import safetensors
import safetensors.numpy

from csac_jax.agent import actor_critic
from csac_jax.agent.actor_critic import Params
from csac_jax.config import Config
from csac_jax.errors import FailedError
from csac_jax.io import configs, files, leaves

SHIPPED = Path(__file__).parents[1] / "policies" / "clear.safetensors"
SHIPPED_SHA256 = "e5a7d1d90b63c40535493ad68819a33d5f97cac52b776f1cd5e9bb13a241bf0c"
_CONFIG = "config"  # the config's name among the file's remarks


class PolicyFileError(FailedError):
    """A file that is no policy, or a damaged one; the message is one line with the remedy."""


def save(path: Path, params: Params, cfg: Config) -> None:
    """Writes a policy; see `files.replace`. Raises OSError where it cannot be written."""
    remarks = {_CONFIG: json.dumps(configs.to_dict(cfg))}
    tensors = {name: np.asarray(leaf) for name, leaf in leaves.named(params).items()}
    files.replace(path, safetensors.numpy.save(tensors, remarks))


def is_policy(path: Path) -> bool:
    """Whether a .safetensors file holds a config."""
    try:
        with safetensors.safe_open(path, "numpy") as file:
            return _CONFIG in (file.metadata() or {})
    except (OSError, safetensors.SafetensorError):
        return False


def load(path: Path) -> tuple[Config, Params]:
    """Config and networks of a policy. Raises PolicyFileError for a file that is none, is damaged
    or another version's."""
    if path == SHIPPED and hashlib.sha256(path.read_bytes()).hexdigest() != SHIPPED_SHA256:
        raise PolicyFileError(f"{path} is not the file that this version ships; reinstall csac-jax")
    try:
        with safetensors.safe_open(path, "numpy") as file:
            remarks = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118, it is no dict
    except (OSError, safetensors.SafetensorError) as error:
        raise PolicyFileError(
            f"{path} cannot be read as .safetensors ({error}); give another file"
        ) from None
    if _CONFIG not in remarks:
        raise PolicyFileError(
            f"{path} holds no config: it is no policy; csac-jax export writes one"
        )
    try:
        cfg = configs.from_dict(json.loads(remarks[_CONFIG]))
    except ValueError as error:
        raise PolicyFileError(
            f"{path} was made by another version of csac_jax ({error}); use that version"
        ) from None
    blank = actor_critic.abstract_params(cfg)
    if found := leaves.difference(leaves.layout(tensors), leaves.layout(blank)):
        name, has, asked = found
        raise PolicyFileError(
            f"{path} holds {name} as {has}, its config asks for {asked}; export it anew"
        )
    params = [tensors[name] for name in leaves.named(blank)]
    return cfg, jax.tree.unflatten(jax.tree.structure(blank), params)
