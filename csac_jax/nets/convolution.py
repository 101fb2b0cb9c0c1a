"""2-D convolution in the form that is fast on the device at hand; each choice was measured.

CPU: XLA is slow at convolutions with batch and channels swapped inside `lax.scan`, which autodiff
makes. Here the swap is a transpose and every convolution is plain.

GPU: the first convolution, of few channels and many taps, is a matrix product. Under `vmap` of runs
XLA makes slow grouped convolutions. By taps each is one product, whose parts are shifted and added:
too large for thousands of passes.
"""

import functools
import itertools

import jax
import jax.numpy as jnp

# (maps, kernel, strides, padding, dilation of the maps, dilation of the kernel)
_convolve = functools.partial(
    jax.lax.conv_general_dilated, dimension_numbers=("NHWC", "HWIO", "NHWC")
)
_MOST_PRODUCTS = 1 << 26  # most numbers of a run by taps (ours): 0.13 GB in bfloat16


def conv2d(
    maps: jax.Array, kernel: jax.Array, stride: int, dilation: int, padding: int
) -> jax.Array:
    """Computes a zero-padded convolution: [B, H, W, I], kernel [k, k, I, O] -> [B, H', W', O]."""
    overlapping = kernel.shape[0] == 2 * stride == 4 * padding and dilation == 1  # by half
    whole = all(length % stride == 0 for length in maps.shape[1:3])
    if overlapping and whole and jax.default_backend() != "cpu":
        return _product_of_blocks(maps, kernel, stride)
    return _conv2d(maps, kernel, stride, dilation, padding)


def _product_of_blocks(maps: jax.Array, kernel: jax.Array, stride: int) -> jax.Array:
    """Computes a convolution by a kernel of two strides as a product of 2 x 2 blocks per cell."""
    batch, rows, cols, ins = maps.shape
    high, wide, half = rows // stride, cols // stride, stride // 2
    padded = jnp.pad(maps, ((0, 0), (half, half), (half, half), (0, 0)))
    blocks = padded.reshape(batch, high + 1, stride, wide + 1, stride, ins)
    blocks = jnp.swapaxes(blocks, 2, 3).reshape(batch, high + 1, wide + 1, -1)
    parts = [blocks[:, i : i + high, j : j + wide] for i in (0, 1) for j in (0, 1)]
    patches = jnp.concatenate(parts, axis=-1)
    length = patches.shape[-1]
    taps = jnp.swapaxes(kernel.reshape(2, stride, 2, stride, ins, -1), 1, 2).reshape(length, -1)
    return (patches.reshape(-1, length) @ taps).reshape(batch, high, wide, -1)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2, 3, 4))
def _conv2d(maps, kernel, stride, dilation, padding) -> jax.Array:
    sides = [(padding, padding)] * 2
    return _convolve(maps, kernel, (stride, stride), sides, (1, 1), (dilation, dilation))


def _maps_gradient(stride, dilation, padding, saved, gradient) -> jax.Array:
    """Computes d loss / d maps: `gradient` [B, H', W', O], dilated, times the flipped kernel."""
    maps, kernel = saved
    low = dilation * (kernel.shape[0] - 1) - padding
    lengths = zip(maps.shape[1:3], gradient.shape[1:3], strict=True)
    sides = [(low, length - (out - 1) * stride - 1 + padding) for length, out in lengths]
    flipped = jnp.swapaxes(kernel[::-1, ::-1], 2, 3)
    return _convolve(gradient, flipped, (1, 1), sides, (stride, stride), (dilation, dilation))


def _kernel_gradient(stride, dilation, padding, saved, gradient) -> jax.Array:
    """Computes d loss / d kernel [k, k, I, O]: maps, channels as batch, times the gradient.

    A GPU sums that of a dilated kernel tap by tap in float32. A CPU is faster with fewer channels
    as batch, so it may convolve the other way round, which gives the flipped kernel. It also takes
    rows two apart, with zeros between them: XLA's library (`runtime.compiler`) leaves those to
    Eigen, two to three times as fast at so few outputs.
    """
    maps, kernel = saved
    size, on_cpu = kernel.shape[0], jax.default_backend() == "cpu"
    if dilation > 1 and stride == 1 and 2 * padding == dilation * (size - 1) and not on_cpu:
        tap = functools.partial(jnp.einsum, "bhwi,bhwo->io", preferred_element_type=jnp.float32)
        taps = jnp.stack([tap(window, gradient) for window in windows(maps, size, 1, dilation)])
        return taps.reshape(kernel.shape).astype(kernel.dtype)
    swapped = on_cpu and stride == 1 and maps.shape[-1] > gradient.shape[-1]
    batch, window, pad = maps, gradient, padding
    if swapped:
        batch, window, pad = gradient, maps, dilation * (size - 1) - padding
    row_stride = 2 if on_cpu else 1
    taps = _convolve(
        jnp.transpose(batch, (3, 1, 2, 0)),  # [I, H, W, B]
        jnp.transpose(window, (1, 2, 0, 3)),  # [H', W', B, O]
        (row_stride * dilation, dilation),
        [(row_stride * pad, row_stride * pad), (pad, pad)],
        (row_stride, 1),
        (row_stride * stride, stride),
    )[:, :size, :size]  # [I, k, k, O]
    return jnp.moveaxis(taps, 0, 3)[::-1, ::-1] if swapped else jnp.moveaxis(taps, 0, 2)


_conv2d.defvjp(
    lambda maps, kernel, *window: (_conv2d(maps, kernel, *window), (maps, kernel)),
    lambda *args: (_maps_gradient(*args), _kernel_gradient(*args)),
)


def taps_fit(maps: jax.Array, kernel: jax.Array) -> bool:
    """Checks that the products of all taps fit the memory at once."""
    return maps.size // maps.shape[-1] * (kernel.size // kernel.shape[2]) <= _MOST_PRODUCTS


def convolve_by_taps(maps: jax.Array, kernel: jax.Array, dilation: int) -> jax.Array:
    """Computes `conv2d` of stride 1 with a kernel of odd size: [B, H, W, O]."""
    size, _, ins, outs = kernel.shape
    matrix = jnp.transpose(kernel, (2, 0, 1, 3)).reshape(ins, -1)
    products = (maps.reshape(-1, ins) @ matrix).reshape(*maps.shape[:-1], size**2 * outs)
    return products if size == 1 else shift_and_add(products, size, dilation)


def windows(maps: jax.Array, size: int, stride: int = 1, dilation: int = 1) -> list[jax.Array]:
    """Returns the windows [B, H / stride, W / stride, F] of a kernel's taps, row by row."""
    rows, cols = maps.shape[1:3]
    around = (size // 2 * dilation, (size - 1) // 2 * dilation)
    padded = jnp.pad(maps, ((0, 0), around, around, (0, 0)))
    taps = itertools.product(range(0, size * dilation, dilation), repeat=2)
    return [padded[:, i : i + rows : stride, j : j + cols : stride] for i, j in taps]


@functools.partial(jax.custom_vjp, nondiff_argnums=(1, 2))
def shift_and_add(products: jax.Array, size: int, dilation: int = 1) -> jax.Array:
    """Sums a kernel's shifted products over its taps in float32: [B, H, W, s^2 F] -> [B, H, W, F].

    The gradient is written out: autodiff would pad each tap's slice with zeros.
    """
    features = products.shape[-1] // size**2
    shifted = (
        window[..., k * features : (k + 1) * features].astype(jnp.float32)
        for k, window in enumerate(windows(products, size, dilation=dilation))
    )
    return functools.reduce(jnp.add, shifted).astype(products.dtype)


shift_and_add.defvjp(
    lambda products, *kernel: (shift_and_add(products, *kernel), None),
    lambda size, dilation, _, gradient: (
        jnp.concatenate(windows(gradient, size, dilation=dilation)[::-1], axis=-1),
    ),
)
