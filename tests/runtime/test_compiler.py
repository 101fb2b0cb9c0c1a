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
    side, net = cfg.net.canvas(cfg.heightmap.size), cfg.net
    stem = (side, 4, net.stem, 2 * net.stride, net.stride, 1, net.stride // 2)
    layers = [
        (side // net.stride, net.stem + i * net.growth, net.growth, 3, 1, d, d)
        for i, d in enumerate(net.dilations)
    ]
    return [stem, *layers]


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

    options = (None, compiler.LIBRARY)
    wanted, got = (jax.jit(both, compiler_options=chosen)(*drawn) for chosen in options)
    for name, new, old in zip(("value", "maps", "kernel"), got, wanted, strict=True):
        bound = 1e-5 * np.max(np.abs(old))
        np.testing.assert_allclose(new, old, rtol=0.0, atol=bound, err_msg=name)
    two = np.stack([drawn[0], drawn[0]]), np.stack([drawn[1], -drawn[1]])  # grouped: two critics
    grouped = jax.jit(jax.vmap(lambda m, k: conv2d(m, k, *rest)), compiler_options=compiler.LIBRARY)
    np.testing.assert_allclose(grouped(*two)[0], wanted[0], rtol=0.0, atol=1e-4)


def test_library_takes_all_but_kernel_gradients():
    """Claim: the library computes values and maps' gradients of dense layers; kernel gradients stay
    with Eigen."""
    maps, kernel, gradient = map(jnp.ones, ((20, 12, 12, 40), (3, 3, 40, 24), (20, 12, 12, 24)))
    conv = lambda m, k: conv2d(m, k, 1, 1, 1)  # noqa: E731

    def taken(function, *arguments) -> bool:
        lowered = jax.jit(function, compiler_options=compiler.LIBRARY).lower(*arguments)
        return TAKEN in lowered.compile().as_text()

    assert taken(conv, maps, kernel)
    assert taken(lambda g, k: jax.vjp(lambda m: conv(m, k), maps)[1](g), gradient, kernel)
    assert not taken(lambda g, m: jax.vjp(lambda k: conv(m, k), kernel)[1](g), gradient, maps)


@pytest.mark.usefixtures("forgotten")
def test_library_that_is_lacking_or_wrong_is_not_used(monkeypatch: pytest.MonkeyPatch):
    """Claim: where XLA does not know the library, or it is wrong, training is compiled without."""
    convolve = compiler._convolve
    for name, value in (
        ("LIBRARY", {"xla_no_such_option": "1"}),
        ("LIBRARY", dict.fromkeys(compiler.LIBRARY, "NO_SUCH_TYPE")),
        ("_convolve", lambda *inputs: 1.001 * convolve(*inputs)),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(compiler, name, value)
            compiler.has_library.cache_clear()
            assert compiler.options(presets.quick()) == compiler.SOONER


@pytest.mark.usefixtures("forgotten")
def test_library_is_for_the_small_net_on_a_cpu(monkeypatch: pytest.MonkeyPatch):
    """Claim: it is asked for with the small net, not with DenseNet-121, and on no accelerator; so
    is what compiles sooner, with any net."""
    assert compiler.options(presets.quick()) == compiler.LIBRARY | compiler.SOONER
    assert compiler.options(presets.paper()) == compiler.SOONER
    with monkeypatch.context() as patch:  # a jaxlib that lacks one of the options
        patch.setattr(compiler, "SOONER", {**compiler.SOONER, "xla_no_such_option": 1})
        assert "xla_no_such_option" not in (compiler.options(presets.paper()) or {})
    compiler.has_library.cache_clear()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert compiler.options(presets.quick()) is None


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


@pytest.mark.parametrize("was_on", [True, False])
@pytest.mark.parametrize("fails", [False, True])
def test_collector_is_off_while_a_program_is_traced(was_on: bool, fails: bool):
    """Claim: it is off as the function is traced, and as before after that, even on failure."""
    seen = []

    def function(x):
        seen.append(gc.isenabled())
        return 2.0 * x if not fails else x / None

    try:
        if not was_on:
            gc.disable()
        with pytest.raises(TypeError) if fails else contextlib.nullcontext():
            assert compiler.lower(jax.jit(function), 1.5).compile()(1.5) == 3.0
        assert gc.isenabled() == was_on
    finally:
        gc.enable()
    assert seen == [False]
