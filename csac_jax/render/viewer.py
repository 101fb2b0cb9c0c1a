"""An interactive view of an episode: MuJoCo's window, or without a display a page in the browser.

The page needs the extra `viewer`. It listens on 127.0.0.1 only.
"""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import mujoco
import numpy as np

from csac_jax.objects import descriptions
from csac_jax.render import gl, media, picture
from csac_jax.render.picture import Viewpoint

ABOVE = Viewpoint(position=(-0.4, -0.4, 0.45), look_at=(0.0, 0.0, 0.03))
PORT = 8080  # of the page, or the next free one
CLOSING = 10.0  # s that a window may take to close
MOST_SEED = 2**31 - 2
_PLANE = 1.0  # half side of an endless plane as drawn, m


class Film:
    """The pictures of an episode: a model, and its actions as texts and qpos [T, ...]."""

    def __init__(
        self, model: mujoco.MjModel, actions: Sequence[tuple[str, np.ndarray]], seed: int = 0
    ) -> None:
        self.model, self.data, self.seed = model, mujoco.MjData(model), seed
        self.frames = [(text, pose) for text, poses in actions for pose in poses]

    def move(self, number: int) -> str:
        """Moves the data to the pose of a picture; returns its text."""
        text, self.data.qpos[:] = self.frames[number]
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        return text


# Shows a pose, a line of text and the picture's number; returns the number of the next picture,
# another film, or None once the view is closed.
Show = Callable[[mujoco.MjData, str, int], int | Film | None]
Another = Callable[[int], Film]  # makes the film of a seed


def play(
    film: Film,
    log: Callable[[str], None],
    again: bool = True,
    view: Viewpoint = ABOVE,
    another: Another | None = None,
) -> None:
    """Shows a film again and again, until closed or by Ctrl-C. The page shows `another` one, of a
    seed that is chosen there."""
    window = gl.has_display()
    opened = _window(film.model, view) if window else _page(film, log, view, another)
    number = 0
    with contextlib.suppress(KeyboardInterrupt), opened as show:
        while again or number < len(film.frames):
            number %= len(film.frames)
            following = show(film.data, film.move(number), number)
            if following is None:
                return
            film, number = (following, 0) if isinstance(following, Film) else (film, following)
            time.sleep(1.0 / media.FRAMES_PER_SECOND)


@contextlib.contextmanager
def _window(model: mujoco.MjModel, view: Viewpoint) -> Iterator[Show]:
    import mujoco.viewer

    shown, others = mujoco.MjData(model), set(threading.enumerate())

    def show(data: mujoco.MjData, _: str, number: int) -> int | None:
        with handle.lock():
            shown.qpos[:] = data.qpos
            mujoco.mj_forward(model, shown)
        handle.sync()
        return number + 1 if handle.is_running() else None

    panels = {"show_left_ui": False, "show_right_ui": False}
    try:
        with mujoco.viewer.launch_passive(model, shown, **panels) as handle:
            picture.aim(handle.cam, view)
            yield show
    finally:
        for thread in set(threading.enumerate()) - others:
            thread.join(CLOSING)  # Python's end closes GLFW, and crashes a window that still draws


class Page:
    """A scene of viser with the visible geoms of a film's model, and controls of its pictures."""

    def __init__(
        self, server: Any, film: Film, view: Viewpoint = ABOVE, another: Another | None = None
    ) -> None:
        server.scene.set_up_direction("+z")
        self._server, self._another = server, another

        @server.on_client_connect
        def _(client: Any) -> None:
            client.camera.position, client.camera.look_at = view.position, view.look_at

        self._text = server.gui.add_markdown("")
        self.playing = server.gui.add_checkbox("play", True)
        self.picture = server.gui.add_slider("picture", 0, 1, 1, 0)
        self.start = server.gui.add_button("from the start")
        self._chosen: int | None = None
        self._wanted: int | None = None  # seed of the film that was asked for
        self.start.on_click(lambda _: self.choose(0))
        if another is not None:
            self.seed = server.gui.add_number("seed", film.seed, min=0, max=MOST_SEED, step=1)
            self.other = server.gui.add_button("scene of this seed")
            self.other.on_click(lambda _: self.ask(int(self.seed.value)))

        @self.picture.on_update
        def _(event: Any) -> None:
            if event.client is not None:  # else it follows the motion
                self.choose(self.picture.value)

        self.parts: dict[int, Any] = {}
        self.load(film)

    def load(self, film: Film) -> None:
        """Replaces what is shown by the geoms of a film."""
        self.picture.max = max(len(film.frames) - 1, 1)
        for part in self.parts.values():
            part.remove()
        self.parts, model = {}, film.model
        for geom in np.flatnonzero(model.geom_rgba[:, 3] > 0.0):
            vertices, faces = mesh(model, int(geom))
            red, green, blue = (round(255 * float(share)) for share in model.geom_rgba[geom, :3])
            self.parts[int(geom)] = self._server.scene.add_mesh_simple(
                f"/geom{geom}", vertices, faces, color=(red, green, blue), flat_shading=True
            )

    def ask(self, seed: int) -> None:
        """Makes the film of this seed the next one."""
        self._wanted = seed

    def choose(self, number: int) -> None:
        """Makes this picture the next one."""
        self._chosen = number

    def show(self, data: mujoco.MjData, text: str, number: int) -> int | Film:
        """Shows the model's pose; returns the film that was asked for, or the next picture: the
        chosen, the following or, while it does not play, the same."""
        wanted, self._wanted = self._wanted, None
        if wanted is not None and self._another is not None:
            self._text.content = f"simulates the episode of seed {wanted}"
            film = self._another(wanted)
            self.load(film)
            return film
        if self._text.content != text:
            self._text.content = text
        for geom, part in self.parts.items():
            turn = np.empty(4)
            mujoco.mju_mat2Quat(turn, data.geom_xmat[geom])
            part.position, part.wxyz = data.geom_xpos[geom].copy(), turn
        self.picture.value = number
        chosen, self._chosen = self._chosen, None
        return number + self.playing.value if chosen is None else chosen


@contextlib.contextmanager
def _page(
    film: Film, log: Callable[[str], None], view: Viewpoint, another: Another | None
) -> Iterator[Show]:
    import viser

    server = viser.ViserServer(host="127.0.0.1", port=PORT, verbose=False)
    log(f"open http://127.0.0.1:{server.get_port()} in a browser; Ctrl-C ends")
    try:
        yield Page(server, film, view, another).show
    finally:
        server.stop()


def mesh(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns vertices [V, 3], m, in the geom's frame, and triangles [F, 3] of its surface."""
    if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_PLANE:
        surface = descriptions.surface(model, geom)
        return np.asarray(surface.vertices), np.asarray(surface.faces)
    x, y, _ = np.where(model.geom_size[geom] > 0.0, model.geom_size[geom], _PLANE)
    corners = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
    return corners, np.array([[0, 1, 2], [0, 2, 3]])
