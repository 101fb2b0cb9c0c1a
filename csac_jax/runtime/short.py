"""Short texts of objects that hold arrays: these by type and shape, a config by its names."""

import dataclasses
from typing import Any

import jax
import numpy as np

from csac_jax.config import Config

LONGEST = 120  # characters of a field without arrays


def text(value: Any) -> str:
    """Returns the text of a dataclass or named tuple, as its `__repr__`."""
    if dataclasses.is_dataclass(value):
        fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    else:
        fields = value._asdict()
    items = [f"{name}={_field(field)}" for name, field in fields.items() if field is not None]
    return f"{type(value).__name__}({', '.join(items)})"


def _field(value: Any) -> str:
    if isinstance(value, Config):
        return f"<{value.preset}, {value.algo}, seed {value.seed}>"
    kind: Any = type(value)
    if kind.__repr__ is text:
        return text(value)
    arrays = [leaf for leaf in jax.tree.leaves(value) if isinstance(leaf, np.ndarray | jax.Array)]
    if arrays and value is arrays[0]:
        return f"{value.dtype}{list(value.shape)}" if value.shape else str(value)
    if arrays:
        return f"<{len(arrays)} arrays, {sum(array.size for array in arrays):,} numbers>"
    full = repr(value)
    return full if len(full) <= LONGEST else f"{full[:LONGEST]}..."
