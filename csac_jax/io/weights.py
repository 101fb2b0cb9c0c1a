"""Pretrained weights from a file that the user brings."""

from pathlib import Path
from typing import Any

import safetensors.numpy

from csac_jax.config import DenseNet121
from csac_jax.io import files
from csac_jax.nets import torchvision


def read(cfg: DenseNet121, path: Path) -> Any:
    """Variables of a trunk from a file with torchvision's names; nothing in it is executed.

    Raises ValueError in one line, naming the tensor if one is missing, extra or misshapen.
    """
    try:
        tensors = safetensors.numpy.load_file(path)
    except Exception as error:  # KeyError for a type that NumPy lacks, others for a damaged header
        raise ValueError(
            f"{path} cannot be read as .safetensors ({files.first_line(error)}); give another file"
        ) from None
    try:
        return torchvision.variables(cfg, tensors)
    except ValueError as error:
        raise ValueError(f"in {path}, {error}; bring torchvision's densenet121") from error
