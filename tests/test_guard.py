"""The run-time guard, in fresh processes: it acts before JAX starts."""

import importlib.metadata
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import pytest

from csac_jax import _guard

# Ten free boxes and six hinges: 66 degrees of freedom, in contact, eight scenes at a time.
BATCHED_STEPS = """
from csac_jax.sim.quiet_mjx import mjx
import jax, jax.numpy as jnp, mujoco

box = '<body pos="{} 0 0.019"><freejoint/><geom type="box" size=".02 .02 .02"/></body>'
ball = '<geom type="sphere" size=".02" pos=".05 0 0"/>'
link = '<body pos="{} 1 1"><joint axis="0 1 0"/>' + ball + "</body>"
boxes = "".join(box.format(0.1 * i) for i in range(10))
links = "".join(link.format(0.1 * i) for i in range(6))
model = mujoco.MjModel.from_xml_string(f'''<mujoco>
  <option solver="Newton" iterations="4" ls_iterations="8" jacobian="dense"/>
  <custom>
    <numeric name="max_geom_pairs" data="4"/><numeric name="max_contact_points" data="16"/>
  </custom>
  <worldbody><geom type="plane" size="2 2 .1"/>{boxes}{links}</worldbody></mujoco>''')
assert model.nv == 66, model.nv
put, data = mjx.put_model(model), mjx.make_data(model)

def scene(height):
    first = data.replace(qpos=data.qpos.at[2].add(height))
    return jax.lax.fori_loop(0, 300, lambda _, d: mjx.step(put, d), first).qpos

qpos = jax.block_until_ready(jax.vmap(scene)(jnp.linspace(0.0, 0.01, 8)))
assert bool(jnp.isfinite(qpos).all())
print("stepped")
"""


ROOT = Path(_guard.__file__).parents[1]


def _python(source: str, timeout: float = 60.0, **variables: str) -> subprocess.CompletedProcess:
    """Runs `source` in a fresh Python, with no variable of the guard but `variables`."""
    guarded = (*_guard.USER_VARIABLES, "XLA_FLAGS", _guard.PARTITIONER_VARIABLE)
    inherited = {name: value for name, value in os.environ.items() if name not in guarded}
    pipes: Any = {"capture_output": True, "text": True, "timeout": timeout, "cwd": ROOT}
    return subprocess.run([sys.executable, "-c", source], env={**inherited, **variables}, **pipes)


@pytest.mark.slow
def test_batched_mjx_does_not_hang():
    """Claim: with the package imported, batched MJX runs to its end on any number of cores."""
    done = _python(BATCHED_STEPS, timeout=180.0)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "stepped\n"  # nor does MJX print about Warp


def test_import_widens_the_pool():
    """Claim: importing the package widens the pool; each virtual device gets four threads."""
    for flags, least in (("", 8), (f"{_guard.DEVICES_FLAG}=100", 400)):
        done = _python("import csac_jax, os; print(os.environ['PJRT_NPROC'])", XLA_FLAGS=flags)
        assert int(done.stdout) >= least, done.stderr


@pytest.mark.parametrize("name", ["PJRT_NPROC", "NPROC"])
def test_user_setting_is_kept(name: str):
    """Claim: what the user has set decides."""
    source = (
        "import csac_jax as c, os; print(os.environ.get('PJRT_NPROC'), *c._guard.pool_setting())"
    )
    done = _python(source, **{name: "3"})
    assert done.stdout.split() == ["3" if name == "PJRT_NPROC" else "None", name, "3"]


def test_rows_are_right():
    """Claim: with the package imported, `vmap(sum(M @ row))` is right in every row."""
    done = _python("from csac_jax.sim import selftest; print(selftest.rows_error())")
    assert float(done.stdout) < 1e-5, done.stderr


def test_unknown_jaxlib_gets_no_flag(monkeypatch: pytest.MonkeyPatch):
    """Claim: a jaxlib that may lack the flag is not given it: XLA ends the process on a flag it
    does not know."""
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "0.11.0")
    _guard.switch_off_broken_fusion()
    assert os.environ["XLA_FLAGS"] == ""


def test_broken_jax_is_refused(monkeypatch: pytest.MonkeyPatch):
    """Claim: a JAX known to compute wrong numbers is an ImportError of one line with the remedy."""
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "0.10.2")
    with pytest.raises(ImportError, match=r"0\.10\.2 computes wrong .* pip install") as caught:
        _guard.refuse_broken_jax()
    assert "\n" not in str(caught.value)


EMPTY_CONSTANT = """
import csac_jax
import jax, numpy as np
from jax.sharding import Mesh, PartitionSpec

nothing = np.zeros((0, 3), np.float32)
line = Mesh(np.array(jax.devices()), ("devices",))
along = PartitionSpec("devices")
add = lambda x: x + (nothing + x[0]).sum()
shared = jax.shard_map(add, mesh=line, in_specs=along, out_specs=along, check_vma=False)
print(jax.jit(shared)(np.arange(4.0, dtype=np.float32)))
"""


def test_programs_of_several_devices_take_empty_constants():
    """Claim: with the package imported a program over two devices compiles though a constant has no
    elements."""
    done = _python(EMPTY_CONSTANT, XLA_FLAGS=f"{_guard.DEVICES_FLAG}=2", JAX_PLATFORMS="cpu")
    assert done.returncode == 0, done.stderr
    assert done.stdout == "[0. 1. 2. 3.]\n"


@pytest.mark.parametrize(
    ("version", "before", "after"),
    [("0.11.2", None, "false"), ("0.11.2", "true", "true"), ("0.12.0", None, None)],
)
def test_broken_partitioner_is_not_used(
    monkeypatch: pytest.MonkeyPatch, version: str, before: str | None, after: str | None
):
    """Claim: Shardy is switched off for jaxlib 0.11, whose Shardy ends the process, unless the user
    wants it, also if JAX was imported before this package."""
    monkeypatch.setattr(importlib.metadata, "version", lambda name: version)
    monkeypatch.setenv(_guard.PARTITIONER_VARIABLE, before or "")  # to be put back
    if before is None:
        monkeypatch.delenv(_guard.PARTITIONER_VARIABLE)
    used = jax.config.jax_use_shardy_partitioner
    jax.config.update("jax_use_shardy_partitioner", True)
    try:
        _guard.switch_off_broken_partitioner()
        assert os.environ.get(_guard.PARTITIONER_VARIABLE) == after
        assert jax.config.jax_use_shardy_partitioner == (after != "false")
    finally:
        jax.config.update("jax_use_shardy_partitioner", used)
