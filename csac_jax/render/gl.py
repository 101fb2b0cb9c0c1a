"""Which OpenGL can MuJoCo draw with here? To be asked before MuJoCo is imported, which reads the
answer."""

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
    """Sets MUJOCO_GL to a backend that draws, unless the user has set it; returns it, None where
    none does.

    Each is tried in a process of its own: a broken driver may end the process.
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
