"""Leaves of a pytree by name, as files keep them."""

from typing import Any

import jax


def named(tree: Any) -> dict[str, Any]:
    """Returns each leaf by its dotted path."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def layout(tree: Any) -> dict[str, str]:
    """Returns dtype and shape of each leaf by its path, as in `float32[8, 3]`."""
    return {name: f"{leaf.dtype}{list(leaf.shape)}" for name, leaf in named(tree).items()}


def difference(stored: dict[str, str], wanted: dict[str, str]) -> tuple[str, str, str] | None:
    """Returns the first differing name with both entries, None if two layouts are the same."""
    for name in dict.fromkeys([*wanted, *stored]):
        if stored.get(name) != wanted.get(name):
            return name, stored.get(name, "nothing"), wanted.get(name, "nothing")
    return None
