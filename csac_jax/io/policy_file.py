"""A policy in one file: its networks' variables and the config they were trained with, as
.safetensors.

Nothing in such a file is executed. `SHIPPED` comes with the package; its digest stands here, so
that a file that was damaged or replaced is noticed.
"""

import hashlib
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import safetensors
import safetensors.numpy

from csac_jax.agent import actor_critic
from csac_jax.agent.actor_critic import Params
from csac_jax.config import Config
from csac_jax.errors import FailedError
from csac_jax.io import configs, files

SHIPPED = Path(__file__).parents[1] / "policies" / "clear.safetensors"
SHIPPED_SHA256 = "e5a7d1d90b63c40535493ad68819a33d5f97cac52b776f1cd5e9bb13a241bf0c"
_CONFIG = "config"  # the config's name among the file's remarks


class PolicyFileError(FailedError):
    """A file that is no policy, or a damaged one; the message is one line with the remedy."""


def save(path: Path, params: Params, cfg: Config) -> None:
    """Writes a policy; the file appears all at once, its folder is made. Raises OSError where it
    cannot be written."""
    remarks = {_CONFIG: json.dumps(configs.to_dict(cfg))}
    content = safetensors.numpy.save(
        {name: np.asarray(leaf) for name, leaf in _named(params)}, remarks
    )
    files.replace(path, content)


def is_policy(path: Path) -> bool:
    """Whether a .safetensors file holds a config."""
    try:
        with safetensors.safe_open(path, "numpy") as file:
            return _CONFIG in (file.metadata() or {})
    except (OSError, safetensors.SafetensorError):
        return False


def load(path: Path) -> tuple[Config, Params]:
    """Config and networks of a policy. Raises PolicyFileError where the file is none, or not one of
    this version."""
    if path == SHIPPED and hashlib.sha256(path.read_bytes()).hexdigest() != SHIPPED_SHA256:
        raise PolicyFileError(
            f"{path} is not the file that this version ships; install csac-jax anew"
        )
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
    return cfg, _filled(path, actor_critic.abstract_params(cfg), tensors)


def _filled(path: Path, blank: Params, tensors: dict[str, np.ndarray]) -> Params:
    """The variables `blank`, shapes and types, with the values of `tensors` by name."""
    wanted = dict(_named(blank))
    for name in sorted(wanted.keys() | tensors.keys()):
        given, asked = (
            f"{leaf.dtype}{list(leaf.shape)}" if leaf is not None else "nothing"
            for leaf in (tensors.get(name), wanted.get(name))
        )
        if given != asked:
            raise PolicyFileError(
                f"{path} holds {name} as {given}, its config asks for {asked}; export it anew"
            )
    return jax.tree.unflatten(jax.tree.structure(blank), [tensors[name] for name in wanted])


def _named(params: Any) -> list[tuple[str, Any]]:
    leaves = jax.tree_util.tree_leaves_with_path(params)
    return [(jax.tree_util.keystr(path, simple=True, separator="."), leaf) for path, leaf in leaves]
