"""Pictures of a MuJoCo model, by its renderer where an OpenGL is found, by our rays where none is;
PNG and video."""

import dataclasses
import itertools
import struct
import warnings
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path

import jax
import mujoco
import numpy as np

from csac_jax.config import CameraConfig
from csac_jax.scene import solids
from csac_jax.vision import camera

FRAMES_PER_SECOND = 25

Draw = Callable[[mujoco.MjData], np.ndarray]  # a state to a picture [H, W, 3] uint8


@dataclasses.dataclass(frozen=True)
class View:
    """From where a picture is taken."""

    position: tuple[float, float, float]  # m
    look_at: tuple[float, float, float]  # m
    size: tuple[int, int] = (640, 480)  # width and height, px
    field: float = 45.0  # height of the view, degrees


def artist(model: mujoco.MjModel, view: View, opengl: str | None) -> Draw:
    """What draws this model: MuJoCo with the OpenGL backend named, our rays if there is none or it
    fails."""
    if opengl is not None:
        try:
            return _by_mujoco(model, view)
        except Exception:  # a driver that is there but does not work raises nearly anything
            pass
    return _by_rays(model, view)


def _by_mujoco(model: mujoco.MjModel, view: View) -> Draw:
    model.vis.global_.fovy = view.field
    model.vis.global_.offwidth, model.vis.global_.offheight = view.size
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.3, 0.35
    width, height = view.size
    renderer = mujoco.Renderer(model, height, width)
    eye, offset = mujoco.MjvCamera(), np.array(view.look_at) - np.array(view.position)
    eye.lookat[:] = view.look_at
    eye.distance = np.linalg.norm(offset)
    eye.azimuth = np.degrees(np.arctan2(offset[1], offset[0]))
    eye.elevation = np.degrees(np.arcsin(offset[2] / eye.distance))
    every = mujoco.MjvOption()
    every.geomgroup[:] = 1

    def draw(data: mujoco.MjData) -> np.ndarray:
        renderer.update_scene(data, eye, every)
        return renderer.render().copy()

    return draw


def _by_rays(model: mujoco.MjModel, view: View) -> Draw:
    width, height = view.size
    focal = 0.5 * height / np.tan(np.radians(0.5 * view.field))
    eye = camera.make(
        CameraConfig(
            size=view.size,
            focal=(focal, focal),
            centre=(0.5 * (width - 1), 0.5 * (height - 1)),
            position=view.position,
            look_at=view.look_at,
        )
    )
    seen = solids.read(model)

    @jax.jit
    def render(xpos: jax.Array, xmat: jax.Array) -> camera.Picture:
        return camera.render(eye, solids.place(seen, xpos, xmat))

    def draw(data: mujoco.MjData) -> np.ndarray:
        picture = jax.device_get(
            render(data.geom_xpos.astype(np.float32), data.geom_xmat.astype(np.float32))
        )
        sky = np.array([0.92, 0.94, 0.96], np.float32)
        return np.round(255 * np.where(picture.valid[..., None], picture.colour, sky)).astype(
            np.uint8
        )

    return draw


def write_png(path: Path, picture: np.ndarray) -> None:
    """Writes a picture [H, W, 3] uint8; every row as its difference from the one above, which packs
    flat areas well."""
    height, width, _ = picture.shape
    above = np.concatenate([np.zeros_like(picture[:1]), picture[:-1]])
    rows = (picture - above).reshape(height, -1)  # modulo 256
    lines = np.concatenate([np.full((height, 1), 2, np.uint8), rows], axis=1)  # filter type 2, "up"

    def chunk(kind: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content))
            + kind
            + content
            + struct.pack(">I", zlib.crc32(kind + content))
        )

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)  # 8 bits, red green blue
    parts = ((b"IHDR", header), (b"IDAT", zlib.compress(lines.tobytes(), 9)), (b"IEND", b""))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts))


def write_video(path: Path, pictures: Iterable[np.ndarray]) -> int:
    """Writes pictures [H, W, 3] uint8, at least one, as a video of FRAMES_PER_SECOND; returns their
    number.

    Raises OSError where ffmpeg fails, such as for a name that it knows no format of.
    """
    import imageio_ffmpeg

    path.parent.mkdir(parents=True, exist_ok=True)
    every = iter(pictures)
    first = next(every)
    height, width, _ = first.shape
    writer = imageio_ffmpeg.write_frames(
        str(path),
        (width, height),
        fps=FRAMES_PER_SECOND,
        macro_block_size=2,
        ffmpeg_log_level="error",
    )
    count = 0
    with warnings.catch_warnings():  # the fork is replaced by ffmpeg at once
        warnings.filterwarnings("ignore", message=".*fork", category=RuntimeWarning)
        writer.send(None)
    try:
        for picture in itertools.chain([first], every):
            writer.send(np.ascontiguousarray(picture))
            count += 1
    finally:
        writer.close()
    return count
