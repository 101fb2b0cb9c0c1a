"""The public names of the package."""

import subprocess
import sys

import csac_jax


def test_public_names_exist():
    """Claim: every name of `__all__` is there, and `dir` lists them."""
    for name in csac_jax.__all__:
        assert getattr(csac_jax, name).__doc__, name
    assert set(csac_jax.__all__) < set(dir(csac_jax))


def test_import_leaves_jax_alone():
    """Claim: `import csac_jax` loads neither JAX nor MuJoCo, and `--help` neither."""
    for code in ("import csac_jax", "from csac_jax import cli; cli.main(['--help'])"):
        loaded = "import sys; print({'jax', 'mujoco', 'flax'} & set(sys.modules))"
        out = subprocess.run(
            [sys.executable, "-c", f"{code}; {loaded}"], check=True, capture_output=True, text=True
        )
        assert out.stdout.strip().endswith("set()")


def test_unknown_name_is_an_attribute_error():
    """Claim: a name that the package lacks is an AttributeError that says so."""
    assert not hasattr(csac_jax, "make_robot")
