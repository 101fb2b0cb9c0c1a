"""Pictures and videos, read back from their files."""

import gc
import resource
import warnings
from pathlib import Path

import imageio.v2 as imageio
import imageio_ffmpeg
import jax
import numpy as np
import pytest
from PIL import Image

from csac_jax.render import media

SHADES = range(40, 240, 8)


@pytest.mark.parametrize("suffix", media.PICTURES)
def test_picture_has_the_format_of_its_suffix(tmp_path: Path, suffix: str):
    """Claim: every suffix offered gives its format, in folders that need not exist; PNG loses
    nothing."""
    path = tmp_path / "new" / f"a{suffix.upper()}"
    media.write_picture(path, np.full((31, 46, 3), 90, np.uint8))
    with Image.open(path) as image:
        assert image.format == {"jpg": "JPEG"}.get(suffix[1:], suffix[1:].upper())
        off = np.abs(np.asarray(image.convert("RGB")).astype(int) - 90).max()
        assert off <= (0 if suffix == ".png" else 2)


@pytest.mark.parametrize(
    "name", [*(f"a{suffix}" for suffix in media.PICTURES), "video.gif", "video.mp4"]
)
def test_a_full_disc_is_one_error(tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str):
    """Claim: where the disc is full a picture or a video is one OSError, and no file is left."""
    noise = np.random.default_rng(0).integers(0, 256, (200, 200, 3)).astype(np.uint8)
    video = name.startswith("video")
    write = media.write_video if video else media.write_picture
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(OSError, match=r"File too large|is the disc full\?"):
            write(tmp_path / name, [noise, noise[::-1]] if video else noise)
        gc.collect()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == []
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize("suffix", media.VIDEOS)
def test_video_has_every_picture(tmp_path: Path, suffix: str):
    """Claim: a video has every picture, its size and about its colour, 25 a second; no warnings."""
    path = tmp_path / "new" / f"a{suffix}"
    jax.devices()  # warns of forks from now on
    with warnings.catch_warnings(record=True) as complaints:
        warnings.simplefilter("always")
        media.write_video(path, (np.full((48, 34, 3), shade, np.uint8) for shade in SHADES))
    assert not complaints
    frames = imageio.mimread(path)
    assert len(frames) == len(SHADES)
    for shade, frame in zip(SHADES, frames, strict=True):
        assert frame.shape[:2] == (48, 34)
        assert np.abs(frame[..., :3].astype(int) - shade).mean() < 6
    assert _seconds(path) == pytest.approx(len(SHADES) / 25, abs=0.01)


def _seconds(path: Path) -> float:
    if path.suffix in media.FILMS:
        return imageio_ffmpeg.count_frames_and_secs(str(path))[1]
    total = 0
    with Image.open(path) as image:
        for number in range(len(SHADES)):
            image.seek(number)
            image.load()
            total += image.info["duration"]  # ms
    return 1e-3 * total
