"""Tracing, and the second library for convolutions: right on all of the small net's, left out where
it is not to be."""

import jax
import numpy as np
import pytest

from csac_jax import presets
from csac_jax.nets.convolution import conv2d
from csac_jax.runtime import compiler


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
    is what compiles sooner, with any net, and soonest where the program is brief."""
    assert compiler.options(presets.quick()) == compiler.LIBRARY | compiler.SOONER
    brief = compiler.options(presets.paper(), brief=True)
    assert brief == {**compiler.SOONER, "xla_backend_optimization_level": 0}
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
