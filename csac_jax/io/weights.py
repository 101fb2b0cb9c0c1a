"""Pretrained weights from a user's file."""

from pathlib import Path
from typing import Any

import safetensors.numpy

from csac_jax.config import DenseNet121
from csac_jax.errors import SettingsError
from csac_jax.io import files
from csac_jax.nets import torchvision


def read(cfg: DenseNet121, path: Path) -> Any:
    """Reads a trunk's variables from a file with torchvision's names. Executes nothing.

    Raises SettingsError, one line that names a missing, extra or misshapen tensor.
    """
    try:
        tensors = safetensors.numpy.load_file(path)
    except Exception as error:  # KeyError for a type that NumPy lacks, others for a damaged header
        raise SettingsError(
            f"{path} cannot be read as .safetensors ({files.first_line(error)}); give another file"
        ) from None
    try:
        return torchvision.variables(cfg, tensors)
    except ValueError as error:
        raise SettingsError(f"in {path}, {error}; give torchvision's densenet121") from error
