"""Pictures and videos as files; the suffix names the format."""

import contextlib
import errno
import io
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np

from csac_jax.errors import SettingsError
from csac_jax.io import files

FRAMES_PER_SECOND = 25
FILMS = (".mp4", ".mkv", ".mov")  # by ffmpeg
VIDEOS = (*FILMS, ".gif", ".webp")
PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".gif")


def check_suffix(path: Path, suffixes: tuple[str, ...]) -> None:
    """Raises SettingsError for any other suffix."""
    if path.suffix.lower() not in suffixes:
        raise SettingsError(f"{path}: its name must end in one of: {', '.join(suffixes)}")


def needs_ffmpeg(path: Path) -> bool:
    """Returns True for a video that ffmpeg writes."""
    return path.suffix.lower() in FILMS


def write_picture(path: Path, picture: np.ndarray) -> None:
    """Writes a picture [H, W, 3] uint8; makes its folder."""
    check_suffix(path, PICTURES)
    content = io.BytesIO()  # imageio's own files print tracebacks on a full disc
    imageio.imwrite(content, picture, format=path.suffix.lower())
    files.replace(path, content.getvalue())


def write_video(path: Path, pictures: Iterable[np.ndarray]) -> None:
    """Writes pictures [H, W, 3] uint8, H and W even; makes the folder. OSError: ffmpeg failed."""
    check_suffix(path, VIDEOS)
    if not needs_ffmpeg(path):
        settings: dict[str, Any] = {"duration": 1000 // FRAMES_PER_SECOND, "loop": 0}
        content = io.BytesIO()
        with imageio.get_writer(content, format=path.suffix.lower(), **settings) as writer:
            for picture in pictures:
                writer.append_data(picture)
        files.replace(path, content.getvalue())
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    settings = {"fps": FRAMES_PER_SECOND, "macro_block_size": 2, "ffmpeg_log_level": "error"}
    number = 0
    with imageio.get_writer(path, **settings) as writer, warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*fork", RuntimeWarning)  # ffmpeg replaces the fork
        for picture in pictures:
            writer.append_data(picture)
            number += 1
    _check_whole(path, number)


def _check_whole(path: Path, number: int) -> None:
    """Raises OSError unless a film has so many pictures: ffmpeg is silent about a full disc."""
    import imageio_ffmpeg

    with contextlib.suppress(RuntimeError):  # of a file that is cut off
        if imageio_ffmpeg.count_frames_and_secs(str(path))[0] == number:
            return
    path.unlink(missing_ok=True)
    raise OSError(errno.EIO, "ffmpeg could not write it whole; is the disc full?", str(path))
