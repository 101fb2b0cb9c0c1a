"""An interactive view of an episode: MuJoCo's window, or without a display a page in the browser.

The page needs the extra `viewer`. It listens on 127.0.0.1 only.
"""

import contextlib
import itertools
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from csac_jax.render import gl, media

PORT = 8080  # of the page, or the next free one
CLOSING = 10.0  # s that a window may take to close
_PLANE = 1.0  # half side of an endless plane as drawn, m
_MESH = mujoco.mjtGeom.mjGEOM_MESH


class Pictured(NamedTuple):
    """An action to show."""

    text: str  # its effect
    poses: np.ndarray  # [T, ...] qpos


def play(
    model: mujoco.MjModel,
    actions: Sequence[Pictured],
    log: Callable[[str], None],
    again: bool = True,
) -> None:
    """Shows an episode, again and again until the window is closed or by Ctrl-C."""
    opened = _window(model) if gl.has_display() else _page(model, log)
    with contextlib.suppress(KeyboardInterrupt), opened as view:
        for _ in itertools.count() if again else range(1):
            for action in actions:
                if not _run(model, action, view):
                    return


def _run(model: mujoco.MjModel, action: Pictured, view: "_Window | Page") -> bool:
    """Shows an action in the time that it takes; returns False once the view is closed."""
    data = mujoco.MjData(model)
    for pose in action.poses:
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        if not view.show(data, action.text):
            return False
        time.sleep(1.0 / media.FRAMES_PER_SECOND)
    return True


class _Window:
    def __init__(self, handle: Any, data: mujoco.MjData) -> None:
        self._handle, self._data = handle, data

    def show(self, data: mujoco.MjData, text: str) -> bool:
        with self._handle.lock():
            self._data.qpos[:] = data.qpos
            mujoco.mj_forward(self._handle.m, self._data)
        self._handle.sync()
        return bool(self._handle.is_running())


@contextlib.contextmanager
def _window(model: mujoco.MjModel) -> Iterator[_Window]:
    import mujoco.viewer

    data = mujoco.MjData(model)
    panels = {"show_left_ui": False, "show_right_ui": False}
    others = set(threading.enumerate())
    try:
        with mujoco.viewer.launch_passive(model, data, **panels) as handle:
            handle.cam.lookat[:], handle.cam.distance = (0.0, 0.0, 0.05), 1.2
            handle.cam.azimuth, handle.cam.elevation = 45.0, -35.0
            yield _Window(handle, data)
    finally:
        for thread in set(threading.enumerate()) - others:
            thread.join(CLOSING)  # Python's end closes GLFW, and crashes a window that still draws


class Page:
    """A scene of viser with the visible geoms of a model."""

    def __init__(self, server: Any, model: mujoco.MjModel) -> None:
        server.scene.set_up_direction("+z")

        @server.on_client_connect
        def _(client: Any) -> None:
            client.camera.position, client.camera.look_at = (-0.7, -0.7, 0.7), (0.0, 0.0, 0.05)

        self._text = server.gui.add_markdown("")
        self.parts = {}
        for geom in np.flatnonzero(model.geom_rgba[:, 3] > 0.0):
            vertices, faces = mesh(model, int(geom))
            red, green, blue = (round(255 * float(share)) for share in model.geom_rgba[geom, :3])
            self.parts[int(geom)] = server.scene.add_mesh_simple(
                f"/geom{geom}", vertices, faces, color=(red, green, blue), flat_shading=True
            )

    def show(self, data: mujoco.MjData, text: str) -> bool:
        """Shows the model's pose; True, since a page never closes."""
        if self._text.content != text:
            self._text.content = text
        for geom, part in self.parts.items():
            turn = np.empty(4)
            mujoco.mju_mat2Quat(turn, data.geom_xmat[geom])
            part.position, part.wxyz = data.geom_xpos[geom].copy(), turn
        return True


@contextlib.contextmanager
def _page(model: mujoco.MjModel, log: Callable[[str], None]) -> Iterator[Page]:
    import viser

    server = viser.ViserServer(host="127.0.0.1", port=PORT, verbose=False)
    log(f"open http://127.0.0.1:{server.get_port()} in a browser; Ctrl-C ends")
    try:
        yield Page(server, model)
    finally:
        server.stop()


def mesh(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns vertices [V, 3], m, in the geom's frame, and triangles [F, 3] of its surface."""
    import trimesh

    size, kind = model.geom_size[geom], mujoco.mjtGeom(int(model.geom_type[geom]))
    if kind == _MESH:
        return _compiled_mesh(model, int(model.geom_dataid[geom]))
    shapes = {
        mujoco.mjtGeom.mjGEOM_BOX: lambda: trimesh.creation.box(2.0 * size),
        mujoco.mjtGeom.mjGEOM_SPHERE: lambda: trimesh.creation.icosphere(radius=size[0]),
        mujoco.mjtGeom.mjGEOM_CYLINDER: lambda: trimesh.creation.cylinder(size[0], 2.0 * size[1]),
        mujoco.mjtGeom.mjGEOM_CAPSULE: lambda: trimesh.creation.capsule(2.0 * size[1], size[0]),
        mujoco.mjtGeom.mjGEOM_PLANE: lambda: _plane(trimesh, size),
    }
    if kind not in shapes:
        raise ValueError(f"geom {geom}: {kind.name} has no picture in the page")
    surface = shapes[kind]()
    return np.asarray(surface.vertices), np.asarray(surface.faces)


def _plane(trimesh: Any, size: np.ndarray) -> Any:
    """Makes a thin box whose top is the plane."""
    half = np.where(size[:2] > 0.0, size[:2], _PLANE)
    box = trimesh.creation.box((*(2.0 * half), 0.002))
    return box.apply_translation((0.0, 0.0, -0.001))


def _compiled_mesh(model: mujoco.MjModel, number: int) -> tuple[np.ndarray, np.ndarray]:
    first, count = model.mesh_vertadr[number], model.mesh_vertnum[number]
    face, faces = model.mesh_faceadr[number], model.mesh_facenum[number]
    return model.mesh_vert[first : first + count], model.mesh_face[face : face + faces]
