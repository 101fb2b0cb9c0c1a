"""Q between the cells of maps that say how it goes on: a polynomial of the offset in every cell.

q_i(o) = v_i + sum_d (s_d o_d + c_d o_d^2) with the offset o = (row, column, yaw) from cell i, in
cells and in yaws. Q(a) = sum_i w_i(a) q_i(a - i) with the trilinear weights w_i of the eight cells
around a: continuous, equal to v_i in a cell, and trilinear where s = c = 0. It can be highest
between cells, which a trilinear map cannot. Ours; Babuska and Melenk 1997 blend so.
"""

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.vision import rotate

_TURNED = np.array([1, -1, -1, 1, 1, 1, 1], np.float32)  # rows and columns upside down


def basis(offset: jax.Array) -> jax.Array:
    """Terms [T] of the polynomial at an offset [3]."""
    return jnp.concatenate([jnp.ones(1), offset, offset**2])


def turn_around(terms: jax.Array) -> jax.Array:
    """Terms [..., T] of cells in the frame that is turned by pi."""
    return terms * jnp.asarray(_TURNED).reshape((1,) * (terms.ndim - 1) + (-1,))


def blend(terms: jax.Array, row_col: jax.Array, turn: jax.Array) -> jax.Array:
    """Value [] of a map of polynomials [h, w, T] at `row_col` [2] in cells, `turn` [] yaws from its
    own; differentiable in all. Outside, the nearest edge counts."""
    side = jnp.array(terms.shape[:2], jnp.float32)
    position = jnp.clip(row_col, 0.0, side - 1.0)
    first = jnp.clip(rotate.floor(position), 0.0, side - 2.0)

    def at(corner: jax.Array) -> jax.Array:
        row, col = (first + corner).astype(jnp.int32)
        offset = position - first - corner
        weight = jnp.prod(1.0 - jnp.abs(offset))
        cell = terms.at[row, col].get(mode="clip")
        return weight * jnp.sum(cell * basis(jnp.append(offset, turn)))

    corners = jnp.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]])
    return jnp.sum(jax.vmap(at)(corners))


def lower(q: jax.Array, outputs: int) -> jax.Array:
    """The maps [..., outputs T] of the critic, of [M, ...], whose value is lower in each cell."""
    split = q.reshape(*q.shape[:-1], -1, outputs)  # terms first, values among them
    chosen = jnp.argmin(split[..., :1, :], axis=0, keepdims=True)
    kept = jnp.take_along_axis(split, jnp.broadcast_to(chosen, (1, *split.shape[1:])), axis=0)
    return kept[0].reshape(q.shape[1:])


def read(
    terms: jax.Array, cell: float, yaws: np.ndarray, primitive: jax.Array, pose: jax.Array
) -> jax.Array:
    """Q [] of terms [P, K, h, w, T] at a pose [3] m, m, rad; differentiable in both."""
    num, side = terms.shape[1], terms.shape[2]
    index = pose[2] * (num / (2.0 * np.pi))
    below = rotate.floor(index)

    def at(k: jax.Array, turn: jax.Array) -> jax.Array:
        k = jnp.mod(k, num)
        position = rotate.to_cell(side, cell, jnp.asarray(yaws)[k], pose[:2])
        return blend(terms[primitive, k], position, turn)

    k, share = below.astype(jnp.int32), index - below
    return (1.0 - share) * at(k, share) + share * at(k + 1, share - 1.0)
