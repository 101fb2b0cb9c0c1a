"""Marks on pictures."""

import numpy as np
import pytest

from csac_jax.render import canvas

RED = (200, 0, 0)


def _blank() -> np.ndarray:
    return np.zeros((20, 30, 3), np.uint8)


def test_letters_are_told_apart():
    """Claim: every letter, digit and sign that a line of `play` has is there, and none looks like
    another."""
    assert set("ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789+-.,:;()") <= set(canvas.LETTERS)
    assert len({shape.tobytes() for shape in canvas.LETTERS.values()}) == len(canvas.LETTERS)
    assert all(shape.shape == (5, 3) for shape in canvas.LETTERS.values())


def test_line_runs_from_end_to_end():
    """Claim: a line covers the way between its ends, as wide as asked, and nothing else."""
    image = _blank()
    canvas.line(image, np.array([4.0, 5.0]), np.array([4.0, 25.0]), 3.0, RED)
    wanted = np.zeros((20, 30), bool)
    wanted[3:6, 4:27] = True  # a pixel more at either end: it is as long as it is wide there
    np.testing.assert_array_equal((image == RED).all(axis=2), wanted)


def test_arrow_points_to_its_end():
    """Claim: an arrow is widest near its end."""
    image = _blank()
    canvas.arrow(image, np.array([10.0, 3.0]), np.array([10.0, 27.0]), 1.0, RED)
    wide = (image[..., 0] > 0).sum(axis=0)
    assert wide[3:18].max() == 1
    assert wide[20:26].max() >= 3


def test_what_lies_outside_is_cut_off():
    """Claim: marks beyond the picture's border neither fail nor appear at its other side."""
    image = _blank()
    canvas.dots(image, np.array([[-3.0, 5.0], [10.0, 31.5], [25.0, 40.0]]), 2.0, RED)
    canvas.write(image, (17, 26), "WW", 2, RED)
    assert not image[:, :25].any()
    assert image[17:, 26:].any()


def test_colours_rise_with_values():
    """Claim: larger values are lighter, what is not finite is dark grey, what is beyond the range
    as at its end."""
    values = np.array([[-5.0, 0.0, 0.5, 1.0, 9.0, -np.inf]])
    shown = canvas.colours(values, 0.0, 1.0)[0].astype(int)
    light = shown @ [0.3, 0.6, 0.1]
    assert light[1] < light[2] < light[3]
    np.testing.assert_array_equal(shown[[0, 4]], shown[[1, 3]])
    np.testing.assert_array_equal(shown[5], [40, 40, 40])


@pytest.mark.parametrize("scale", [1, 2])
def test_strip_breaks_lines(scale: int):
    """Claim: a text too long for one line goes on in the next; what is too long for all is left
    out."""
    width = 40 * canvas.ADVANCE * scale
    short, long = (canvas.strip(text, width, 2, scale) for text in ("one", "word " * 60))
    assert short.shape == long.shape == ((2 * canvas.LINE + 1) * scale, width, 3)
    lower = slice(canvas.LINE * scale + scale, None)
    assert not short[lower].any()
    assert long[lower].any()
