"""Weights of DenseNet-121 in torchvision's names, from a user's file, as the variables of a trunk.

`features.denseblock1.denselayer2.conv1.weight` [O, I, k, k] is
`params.denseblock1.denselayer2.conv1.kernel` [k, k, I, O].
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy

from csac_jax import reading
from csac_jax.config import DenseNet121
from csac_jax.errors import SettingsError
from csac_jax.io import files
from csac_jax.nets import densenet

_NAMES = {"kernel": "weight", "scale": "weight", "mean": "running_mean", "var": "running_var"}


def read(cfg: DenseNet121, path: Path) -> Any:
    """Reads a trunk's variables from a file with torchvision's names. Executes nothing.

    Raises SettingsError, one line that names a missing, extra or misshapen tensor.
    """
    try:
        reading.check_regular(path)
        tensors = safetensors.numpy.load_file(path)
    except Exception as error:  # KeyError for a type that NumPy lacks, others for a damaged header
        raise SettingsError(
            f"{path} cannot be read as .safetensors ({files.first_line(error)}); give another file"
        ) from None
    try:
        return variables(cfg, tensors)
    except ValueError as error:
        raise SettingsError(f"in {path}, {error}; give torchvision's densenet121") from error


def variables(cfg: DenseNet121, tensors: Mapping[str, np.ndarray]) -> Any:
    """Converts `tensors` by name to a trunk's variables, float32, without the classifier.

    Raises ValueError naming the first tensor that is missing, misshapen or unknown.
    """
    trunk, blank = densenet.DenseNetTrunk(cfg), jax.ShapeDtypeStruct((1, 32, 32, 3), jnp.float32)
    names = set()

    def take(path: Any, leaf: jax.ShapeDtypeStruct) -> np.ndarray:
        *modules, kind = (key.key for key in path[1:])
        name = ".".join(["features", *modules, _NAMES.get(kind, kind)])
        names.add(name)
        if name not in tensors:
            raise ValueError(f"tensor {name} is missing")
        tensor = np.asarray(tensors[name], np.float32)
        shape = tuple(leaf.shape[axis] for axis in (3, 2, 0, 1)) if kind == "kernel" else leaf.shape
        if tensor.shape != shape:
            raise ValueError(f"tensor {name} has the shape {list(tensor.shape)}, not {list(shape)}")
        return tensor.transpose(2, 3, 1, 0) if kind == "kernel" else tensor

    wanted = jax.eval_shape(trunk.init, jax.random.key(0), blank)
    taken = jax.tree_util.tree_map_with_path(take, wanted)
    for name in sorted(tensors.keys() - names):
        if not name.startswith("classifier.") and not name.endswith(".num_batches_tracked"):
            raise ValueError(f"tensor {name} is not part of DenseNet-121")
    return taken
