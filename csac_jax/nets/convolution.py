"""2-D convolution whose gradient stays fast: inside `lax.scan` on a CPU, and with dilation on a
GPU.

XLA's CPU back end runs the convolutions that autodiff makes, whose batch and channels are swapped,
many times slower inside a while loop than outside (jaxlib 0.10.1; `experiments/bench` times both
ways). Here the swap is a transpose, and every convolution plain. On a GPU the gradient for a
dilated kernel is its taps one by one: as one convolution it takes several times as long (jaxlib
0.11, H200). The net's first convolution, of few channels and many taps, is a matrix product there,
with which a look takes a fifth less; on a CPU that would be slower.
"""

import functools

import jax
import jax.numpy as jnp

_LAYOUT = ("NHWC", "HWIO", "NHWC")


def conv2d(
    maps: jax.Array, kernel: jax.Array, stride: int, dilation: int, padding: int
) -> jax.Array:
    """Convolution of maps [B, H, W, I] with a kernel [k, k, I, O], zeros around: [B, H', W', O]."""
    overlapping = kernel.shape[0] == 2 * stride == 4 * padding and dilation == 1  # by half
    whole = all(length % stride == 0 for length in maps.shape[1:3])
    if overlapping and whole and jax.default_backend() != "cpu":
        return _product_of_blocks(maps, kernel, stride)
    return _conv2d(maps, kernel, stride, dilation, padding)


def _product_of_blocks(maps: jax.Array, kernel: jax.Array, stride: int) -> jax.Array:
    """Convolution with a kernel two strides wide, zeros half a stride wide around: a product of 2 x
    2 blocks' cells."""
    batch, rows, cols, ins = maps.shape
    high, wide, half = rows // stride, cols // stride, stride // 2
    padded = jnp.pad(maps, ((0, 0), (half, half), (half, half), (0, 0)))
    blocks = padded.reshape(batch, high + 1, stride, wide + 1, stride, ins)
    blocks = jnp.swapaxes(blocks, 2, 3).reshape(
        batch, high + 1, wide + 1, -1
    )  # cells of a block side by side
    seen = jnp.concatenate(
        [blocks[:, i : i + high, j : j + wide] for i in (0, 1) for j in (0, 1)], axis=-1
    )
    taps = jnp.swapaxes(kernel.reshape(2, stride, 2, stride, ins, -1), 1, 2).reshape(
        seen.shape[-1], -1
    )
    return (seen.reshape(-1, seen.shape[-1]) @ taps).reshape(batch, high, wide, -1)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2, 3, 4))
def _conv2d(
    maps: jax.Array, kernel: jax.Array, stride: int, dilation: int, padding: int
) -> jax.Array:
    pad = [(padding, padding)] * 2
    return jax.lax.conv_general_dilated(
        maps,
        kernel,
        (stride, stride),
        pad,
        rhs_dilation=(dilation, dilation),
        dimension_numbers=_LAYOUT,
    )


def _forward(maps: jax.Array, kernel: jax.Array, stride: int, dilation: int, padding: int):
    return _conv2d(maps, kernel, stride, dilation, padding), (maps, kernel)


def _backward(
    stride: int,
    dilation: int,
    padding: int,
    saved: tuple[jax.Array, jax.Array],
    gradient: jax.Array,
):
    maps, kernel = saved
    return (
        _maps_gradient(maps, kernel, gradient, stride, dilation, padding),
        _kernel_gradient(maps, kernel, gradient, stride, dilation, padding),
    )


def _maps_gradient(maps, kernel, gradient, stride, dilation, padding) -> jax.Array:
    """d loss / d maps [B, H, W, I]: the gradient [B, H', W', O], its cells `stride` apart, with the
    turned kernel."""
    turned = jnp.swapaxes(kernel[::-1, ::-1], 2, 3)
    low = dilation * (kernel.shape[0] - 1) - padding
    pad = [
        (low, size - (out - 1) * stride - 1 + padding)
        for size, out in zip(maps.shape[1:3], gradient.shape[1:3], strict=True)
    ]
    return jax.lax.conv_general_dilated(
        gradient,
        turned,
        (1, 1),
        pad,
        lhs_dilation=(stride, stride),
        rhs_dilation=(dilation, dilation),
        dimension_numbers=_LAYOUT,
    )


def _kernel_gradient(maps, kernel, gradient, stride, dilation, padding) -> jax.Array:
    """d loss / d kernel [k, k, I, O]: the maps, with channels as batch, convolved with the gradient
    as a kernel.

    Or, if the gradient has the fewer channels, the other way round, which gives the turned kernel:
    on a CPU the fewer channels are better the batch. There rows are taken two apart as well, with
    zeros between them, which changes no sum: XLA's library for convolutions, `train.compiler`,
    leaves those to Eigen, which has two to three times its speed at so few outputs.
    """
    size = kernel.shape[0]
    on_cpu = jax.default_backend() == "cpu"
    if dilation > 1 and not on_cpu:
        return _kernel_gradient_by_taps(maps, gradient, size, stride, dilation, padding).astype(
            kernel.dtype
        )
    swapped = on_cpu and stride == 1 and maps.shape[-1] > gradient.shape[-1]
    batch, window, pad = (
        (maps, gradient, padding)
        if not swapped
        else (gradient, maps, dilation * (size - 1) - padding)
    )
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
    return (
        jnp.transpose(taps, (1, 2, 3, 0))[::-1, ::-1]
        if swapped
        else jnp.transpose(taps, (1, 2, 0, 3))
    )


def _kernel_gradient_by_taps(maps, gradient, size, stride, dilation, padding) -> jax.Array:
    """`_kernel_gradient` as a matrix product for each of the kernel's taps; float32."""
    padded = jnp.pad(maps, ((0, 0), (padding, padding), (padding, padding), (0, 0)))
    rows, cols = (stride * (length - 1) + 1 for length in gradient.shape[1:3])

    def tap(row: int, col: int) -> jax.Array:
        seen = padded[:, row : row + rows : stride, col : col + cols : stride]
        return jnp.einsum("bhwi,bhwo->io", seen, gradient, preferred_element_type=jnp.float32)

    offsets = [dilation * i for i in range(size)]
    return jnp.stack([jnp.stack([tap(row, col) for col in offsets]) for row in offsets])


_conv2d.defvjp(_forward, _backward)
