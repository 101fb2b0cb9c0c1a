"""Tracing, and the second library for convolutions: right on all of the small net's, left out where
it is not to be."""

import contextlib
import gc

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax import presets
from csac_jax.nets.convolution import conv2d
from csac_jax.runtime import compiler

TAKEN = "__ynn_fusion"  # what the library computes is called in a compiled program


@pytest.fixture
def forgotten(monkeypatch: pytest.MonkeyPatch):
    """No memory of what was found before, nor after, and no options of the user's."""
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    compiler.has_library.cache_clear()
    yield
    compiler.has_library.cache_clear()


def _convolutions(cfg) -> list[tuple[int, ...]]:
    """Side of the maps, channels in and out, kernel, stride, dilation, padding of each in the small
    net."""
    side = round(cfg.heightmap.size * (1.0 + cfg.net.margin))
    net, layers = cfg.net, enumerate(cfg.net.dilations)
    stem = (side, 4, net.stem, 2 * net.stride, net.stride, 1, net.stride // 2)
    return [
        stem,
        *(
            (side // net.stride, net.stem + i * net.growth, net.growth, 3, 1, d, d)
            for i, d in layers
        ),
    ]


@pytest.mark.parametrize("setting", _convolutions(presets.quick()))
def test_library_is_right(setting):
    """Claim: with it, value and both gradients of every convolution of `quick` are those without,
    to rounding."""
    side, channels, features, size, *rest = setting
    out = side // rest[0]
    shapes = (3, side, side, channels), (size, size, channels, features), (3, out, out, features)
    rng = np.random.default_rng(0)
    drawn = [rng.normal(size=shape).astype(np.float32) for shape in shapes]

    def both(maps, kernel, gradient):
        out, back = jax.vjp(lambda maps, kernel: conv2d(maps, kernel, *rest), maps, kernel)
        return out, *back(gradient)

    wanted, got = (
        jax.jit(both, compiler_options=asked)(*drawn) for asked in (None, compiler.LIBRARY)
    )
    for name, new, old in zip(("value", "maps", "kernel"), got, wanted, strict=True):
        np.testing.assert_allclose(
            new, old, rtol=0.0, atol=1e-5 * np.max(np.abs(old)), err_msg=name
        )


def test_library_takes_all_but_kernel_gradients():
    """Claim: the library computes values and maps' gradients of dense layers; kernel gradients stay
    with Eigen."""
    maps, kernel, gradient = (
        jnp.ones((20, 12, 12, 40)),
        jnp.ones((3, 3, 40, 24)),
        jnp.ones((20, 12, 12, 24)),
    )

    def taken(function, *arguments) -> bool:
        return (
            TAKEN
            in jax.jit(function, compiler_options=compiler.LIBRARY)
            .lower(*arguments)
            .compile()
            .as_text()
        )

    assert taken(lambda m, k: conv2d(m, k, 1, 1, 1), maps, kernel)
    assert taken(
        lambda g, k: jax.vjp(lambda m: conv2d(m, k, 1, 1, 1), maps)[1](g), gradient, kernel
    )
    assert not taken(
        lambda g, m: jax.vjp(lambda k: conv2d(m, k, 1, 1, 1), kernel)[1](g), gradient, maps
    )


@pytest.mark.usefixtures("forgotten")
@pytest.mark.parametrize(
    "asked", [{"xla_no_such_option": "1"}, {next(iter(compiler.LIBRARY)): "NO_SUCH_TYPE"}]
)
def test_an_xla_without_it_is_asked_for_nothing(
    monkeypatch: pytest.MonkeyPatch, asked: dict[str, str]
):
    """Claim: where XLA does not know the library, training goes on without it."""
    monkeypatch.setattr(compiler, "LIBRARY", asked)
    assert not compiler.has_library()
    assert compiler.options(presets.quick()) == compiler.SOONER


@pytest.mark.usefixtures("forgotten")
def test_a_library_that_is_wrong_is_not_used(monkeypatch: pytest.MonkeyPatch):
    """Claim: it is used only where a convolution by it is right."""
    convolve = compiler._convolve
    monkeypatch.setattr(compiler, "_convolve", lambda *inputs: 1.001 * convolve(*inputs))
    assert not compiler.has_library()


@pytest.mark.usefixtures("forgotten")
def test_library_is_for_the_small_net_on_a_cpu(monkeypatch: pytest.MonkeyPatch):
    """Claim: it is asked for with the small net, not with DenseNet-121, and on no accelerator; so
    is what compiles sooner, with any net."""
    assert compiler.options(presets.quick()) == compiler.LIBRARY | compiler.SOONER
    assert compiler.options(presets.paper()) == compiler.SOONER
    compiler.has_library.cache_clear()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert compiler.options(presets.quick()) is None


def test_an_option_that_xla_lacks_is_left_out(monkeypatch: pytest.MonkeyPatch):
    """Claim: a jaxlib without one of the options that compile sooner is asked for the others."""
    asked = compiler.options(presets.paper())
    monkeypatch.setattr(compiler, "SOONER", {**compiler.SOONER, "xla_no_such_option": 1})
    assert compiler.options(presets.paper()) == asked


@pytest.mark.usefixtures("forgotten")
@pytest.mark.parametrize("chosen", compiler.SOONER)
def test_an_option_that_the_user_gives_stays(monkeypatch: pytest.MonkeyPatch, chosen: str):
    """Claim: no program overrides what `XLA_FLAGS` says, whose other options change nothing."""
    monkeypatch.setenv("XLA_FLAGS", f"--xla_dump_to= --{chosen}=0")
    others = {name: value for name, value in compiler.SOONER.items() if name != chosen}
    assert compiler.options(presets.paper()) == others


@pytest.mark.parametrize(
    ("asked", "known"), [(compiler.VENDOR, True), ({"xla_no_such_option": "1"}, False)]
)
def test_products_of_densenet_are_the_vendors_on_a_gpu(
    monkeypatch: pytest.MonkeyPatch, asked, known: bool
):
    """Claim: on a GPU DenseNet-121 is compiled without XLA's own matrix products, if this XLA can
    be asked to."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(compiler, "VENDOR", asked)
    assert compiler.options(presets.paper()) == (asked if known else None)


def test_library_is_right_in_groups():
    """Claim: so is it for two critics side by side, whose convolutions are grouped."""
    rng = np.random.default_rng(0)
    maps, kernels = (
        rng.normal(size=shape).astype(np.float32) for shape in ((2, 4, 9, 9, 40), (2, 3, 3, 40, 24))
    )
    each = jax.vmap(lambda maps, kernel: conv2d(maps, kernel, 1, 2, 2))
    wanted, got = (
        jax.jit(each, compiler_options=asked)(maps, kernels) for asked in (None, compiler.LIBRARY)
    )
    np.testing.assert_allclose(got, wanted, atol=1e-4)


@pytest.mark.parametrize("was_on", [True, False])
@pytest.mark.parametrize("fails", [False, True])
def test_the_collector_rests_while_a_program_is_traced(was_on: bool, fails: bool):
    """Claim: it is off as the function is traced, and as it was before after that, even if that
    fails."""
    seen = []

    def function(x):
        seen.append(gc.isenabled())
        if fails:
            raise ZeroDivisionError
        return 2.0 * x

    try:
        if not was_on:
            gc.disable()
        with pytest.raises(ZeroDivisionError) if fails else contextlib.nullcontext():
            assert compiler.lower(jax.jit(function), 1.5).compile()(1.5) == 3.0
        assert gc.isenabled() == was_on
    finally:
        gc.enable()
    assert seen == [False]
