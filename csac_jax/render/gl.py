"""Finds an OpenGL backend that MuJoCo can draw with here. MuJoCo reads the choice as it is
imported."""

import os
import subprocess
import sys

VARIABLE = "MUJOCO_GL"
BACKENDS = ("egl", "osmesa")  # neither needs a display
OFF = ("off", "disable", "disabled", "false", "0")  # values that turn MuJoCo's drawing off
_PROBE = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
with mujoco.Renderer(model, 16, 16) as renderer:
    renderer.update_scene(mujoco.MjData(model))
    renderer.render()
"""


def choose() -> str | None:
    """Sets MUJOCO_GL to a backend that draws and returns it; None if none draws.

    The user's own MUJOCO_GL stands.
    """
    given = os.environ.get(VARIABLE, "").lower()
    if given:
        return None if given in OFF else given
    for backend in BACKENDS:
        if _draws(backend):
            os.environ[VARIABLE] = backend
            return backend
    return None


def _draws(backend: str) -> bool:
    """Tries a backend in its own process, which a broken driver may end."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE],
            env=os.environ | {VARIABLE: backend},
            capture_output=True,
            timeout=60,
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0
