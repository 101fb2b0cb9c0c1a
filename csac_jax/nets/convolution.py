"""2-D convolution whose gradient stays fast: inside `lax.scan` on a CPU, and with dilation on a GPU.

XLA's CPU back end runs the convolutions that autodiff makes, whose batch and channels are swapped, many times slower
inside a while loop than outside (jaxlib 0.10.1; `experiments/bench` times both ways). Here the swap is a transpose, and
every convolution plain. On a GPU the gradient for a dilated kernel is its taps one by one: as one convolution it takes
several times as long (jaxlib 0.11, H200). Where kernels are batched, of seeds side by side, vmap would make grouped
convolutions, for which a GPU has no fast ones: there they are matrix products.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

_LAYOUT = ("NHWC", "HWIO", "NHWC")


@functools.partial(jax.custom_vjp, nondiff_argnums=(2, 3, 4))
def conv2d(maps: jax.Array, kernel: jax.Array, stride: int, dilation: int, padding: int) -> jax.Array:
    """Convolution of maps [B, H, W, I] with a kernel [k, k, I, O], zeros around: [B, H', W', O]."""

    def plain(maps: jax.Array, kernel: jax.Array) -> jax.Array:
        pad = [(padding, padding)] * 2
        return jax.lax.conv_general_dilated(
            maps, kernel, (stride, stride), pad, rhs_dilation=(dilation, dilation), dimension_numbers=_LAYOUT
        )

    return _batched_by(plain, lambda maps, kernel: _by_rows(maps, kernel, stride, dilation, padding))(maps, kernel)


def _batched_by(plain: Callable[..., jax.Array], products: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    """`plain`, a function of two arrays, which on a GPU is vmapped as `products` where both are batched."""
    if jax.default_backend() == "cpu":
        return plain
    function = jax.custom_batching.custom_vmap(plain)

    @function.def_vmap
    def rule(_: int, batched: list[bool], *arrays: jax.Array) -> tuple[jax.Array, bool]:
        axes = tuple(0 if one else None for one in batched)
        return jax.vmap(products if all(batched) else plain, axes)(*arrays), True

    return function


def _windows(maps: jax.Array, size: int, stride: int, dilation: int, padding: int, shape: tuple[int, int]):
    """What each tap of a kernel of `size` sees of maps [B, H, W, I], [B, *shape, I]: row by row, tap by tap."""
    padded = jnp.pad(maps, ((0, 0), (padding, padding), (padding, padding), (0, 0)))
    rows, cols = (stride * (length - 1) + 1 for length in shape)
    offsets = [dilation * i for i in range(size)]
    return [[padded[:, row : row + rows : stride, col : col + cols : stride] for col in offsets] for row in offsets]


def _by_rows(maps: jax.Array, kernel: jax.Array, stride: int, dilation: int, padding: int) -> jax.Array:
    """`conv2d` as a matrix product for each row of the kernel."""
    size, *_, channels = kernel.shape
    reach = dilation * (size - 1) + 1
    rows, cols = ((length + 2 * padding - reach) // stride + 1 for length in maps.shape[1:3])
    seen = _windows(maps, size, stride, dilation, padding, (rows, cols))
    products = (
        jnp.einsum(
            "bhwi,io->bhwo",
            jnp.concatenate(row, axis=-1),
            taps.reshape(-1, channels),
            preferred_element_type=jnp.float32,
        )
        for row, taps in zip(seen, kernel, strict=True)
    )
    return sum(products, jnp.float32(0.0)).astype(maps.dtype)


def _forward(maps: jax.Array, kernel: jax.Array, stride: int, dilation: int, padding: int):
    return conv2d(maps, kernel, stride, dilation, padding), (maps, kernel)


def _backward(stride: int, dilation: int, padding: int, saved: tuple[jax.Array, jax.Array], gradient: jax.Array):
    maps, kernel = saved
    return (
        _maps_gradient(maps, kernel, gradient, stride, dilation, padding),
        _kernel_gradient(maps, kernel, gradient, stride, dilation, padding),
    )


def _maps_gradient(maps, kernel, gradient, stride, dilation, padding) -> jax.Array:
    """d loss / d maps [B, H, W, I]: the gradient [B, H', W', O], its cells `stride` apart, with the turned kernel."""
    low = dilation * (kernel.shape[0] - 1) - padding
    pad = [
        (low, size - (out - 1) * stride - 1 + padding)
        for size, out in zip(maps.shape[1:3], gradient.shape[1:3], strict=True)
    ]

    def plain(gradient: jax.Array, turned: jax.Array) -> jax.Array:
        return jax.lax.conv_general_dilated(
            gradient,
            turned,
            (1, 1),
            pad,
            lhs_dilation=(stride, stride),
            rhs_dilation=(dilation, dilation),
            dimension_numbers=_LAYOUT,
        )

    turned = jnp.swapaxes(kernel[::-1, ::-1], 2, 3)
    if stride > 1 or low != padding:  # the first layer's, which is not asked for
        return plain(gradient, turned)
    return _batched_by(plain, lambda gradient, turned: _by_rows(gradient, turned, 1, dilation, low))(gradient, turned)


def _kernel_gradient(maps, kernel, gradient, stride, dilation, padding) -> jax.Array:
    """d loss / d kernel [k, k, I, O]: the maps, with channels as batch, convolved with the gradient as a kernel.

    Or, if the gradient has the fewer channels, the other way round, which gives the turned kernel: on a CPU the fewer
    channels are better the batch. There rows are taken two apart as well, with zeros between them, which changes no
    sum: XLA's library for convolutions, `train.compiler`, leaves those to Eigen, which has two to three times its speed
    at so few outputs.
    """
    size = kernel.shape[0]

    def by_taps(maps: jax.Array, gradient: jax.Array) -> jax.Array:
        return _kernel_gradient_by_taps(maps, gradient, size, stride, dilation, padding).astype(kernel.dtype)

    def plain(maps: jax.Array, gradient: jax.Array) -> jax.Array:
        return _kernel_gradient_plain(maps, gradient, size, stride, dilation, padding)

    if dilation > 1 and jax.default_backend() != "cpu":
        return by_taps(maps, gradient)
    return _batched_by(plain, by_taps)(maps, gradient)


def _kernel_gradient_plain(maps, gradient, size, stride, dilation, padding) -> jax.Array:
    """`_kernel_gradient` as one convolution."""
    on_cpu = jax.default_backend() == "cpu"
    swapped = on_cpu and stride == 1 and maps.shape[-1] > gradient.shape[-1]
    batch, window, pad = (maps, gradient, padding) if not swapped else (gradient, maps, dilation * (size - 1) - padding)
    apart = 2 if on_cpu else 1
    taps = jax.lax.conv_general_dilated(
        jnp.transpose(batch, (3, 1, 2, 0)),  # [I, H, W, B]
        jnp.transpose(window, (1, 2, 0, 3)),  # [H', W', B, O]
        (apart * dilation, dilation),
        [(apart * pad, apart * pad), (pad, pad)],
        lhs_dilation=(apart, 1),
        rhs_dilation=(apart * stride, stride),
        dimension_numbers=_LAYOUT,
    )[:, :size, :size]  # [I, k, k, O]
    return jnp.transpose(taps, (1, 2, 3, 0))[::-1, ::-1] if swapped else jnp.transpose(taps, (1, 2, 0, 3))


def _kernel_gradient_by_taps(maps, gradient, size, stride, dilation, padding) -> jax.Array:
    """`_kernel_gradient` as a matrix product for each of the kernel's taps; float32."""
    seen = _windows(maps, size, stride, dilation, padding, gradient.shape[1:3])

    def tap(window: jax.Array) -> jax.Array:
        return jnp.einsum("bhwi,bhwo->io", window, gradient, preferred_element_type=jnp.float32)

    return jnp.stack([jnp.stack([tap(window) for window in row]) for row in seen])


conv2d.defvjp(_forward, _backward)
