"""An OpenGL backend that MuJoCo can draw with on this machine; MuJoCo reads it on import."""

import contextlib
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


def has_display() -> bool:
    """Returns True if a window can open here."""
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def choose() -> str | None:
    """Sets MUJOCO_GL, unless it is set, to a backend that draws; returns it, or None."""
    if backend := os.environ.get(VARIABLE, "").lower():
        return None if backend in OFF else backend
    drawing = next(filter(_draws, BACKENDS), None)
    if drawing is not None:
        os.environ[VARIABLE] = drawing
    return drawing


def _draws(backend: str) -> bool:
    """Tries a backend in its own process, which a broken driver may end."""
    command, env = [sys.executable, "-c", _PROBE], os.environ | {VARIABLE: backend}
    with contextlib.suppress(subprocess.TimeoutExpired):
        return not subprocess.run(command, env=env, capture_output=True, timeout=60).returncode
    return False
