"""Marks on pictures [H, W, 3] uint8, by NumPy alone: lines, dots, maps as colours, small letters.

Positions are (row, column) from the top left, px; what lies outside is cut off. Pictures are drawn
on in place.
"""

import re
import textwrap

import numpy as np

Colour = tuple[int, int, int]

_PALETTE = np.array(
    [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], float
)  # dark to light
_GLYPHS = (  # a letter, then its five rows, the leftmost pixel worth 4
    "A25755B65656C34443D65556E74647F74644G34553H55755I72227J11152K55655L44447M57755N65555O25552P65644Q75571R65655"
    "S34216T72222U55557V55552W55775X55255Y55222Z71247075557126227271747371317455711574717674757771122875757975717"
    "+02720-00700=07070.00002,00024:02020;02024(12221)42224/11244%51245|22222'22000_00007"
)
LETTERS = {
    letter: np.array([[int(row) & bit > 0 for bit in (4, 2, 1)] for row in rows])
    for letter, rows in re.findall(r"(.)([0-7]{5})", _GLYPHS)
}
"""Letters of 5 x 3 pixels, capitals only."""
ADVANCE, LINE = 4, 7  # px from letter to letter and from line to line, before scaling


def colours(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Values [H, W] as colours [H, W, 3] uint8, dark at `low` and light at `high`; dark grey where
    not finite."""
    there = np.isfinite(values)
    share = np.clip((np.where(there, values, low) - low) / max(high - low, 1e-9), 0.0, 1.0)
    stops = np.linspace(0.0, 1.0, len(_PALETTE))
    mixed = np.stack([np.interp(share, stops, channel) for channel in _PALETTE.T], axis=-1)
    return np.where(there[..., None], mixed, 40.0).round().astype(np.uint8)


def enlarge(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """The picture in another size, every pixel taken from the nearest one."""
    rows, columns = (
        np.arange(new) * old // new for new, old in zip((height, width), image.shape, strict=False)
    )
    return image[rows][:, columns].copy()


def dots(image: np.ndarray, places: np.ndarray, radius: float, colour: Colour) -> None:
    """Discs at `places` [n, 2]."""
    reach = int(np.ceil(radius))
    near = np.stack(
        np.meshgrid(*[np.arange(-reach, reach + 1)] * 2, indexing="ij"), axis=-1
    ).reshape(-1, 2)
    near = near[np.linalg.norm(near, axis=1) <= radius]
    pixels = (np.round(places).astype(int)[:, None] + near[None]).reshape(-1, 2)
    inside = np.all((pixels >= 0) & (pixels < image.shape[:2]), axis=1)
    image[pixels[inside, 0], pixels[inside, 1]] = colour


def line(
    image: np.ndarray, begin: np.ndarray, end: np.ndarray, width: float, colour: Colour
) -> None:
    """A straight line of round ends."""
    count = 2 * int(np.ceil(np.linalg.norm(end - begin))) + 1
    dots(image, begin + np.linspace(0.0, 1.0, count)[:, None] * (end - begin), 0.5 * width, colour)


def arrow(
    image: np.ndarray, begin: np.ndarray, end: np.ndarray, width: float, colour: Colour
) -> None:
    """A line with a head at its end, a third as long."""
    line(image, begin, end, width, colour)
    for turn in (2.6, -2.6):  # rad, off the direction of the arrow
        cos, sin = np.cos(turn), np.sin(turn)
        line(
            image,
            end,
            end + np.array([[cos, -sin], [sin, cos]]) @ (end - begin) / 3.0,
            width,
            colour,
        )


def write(image: np.ndarray, place: tuple[int, int], text: str, scale: int, colour: Colour) -> None:
    """A line of text, its upper left corner at `place`; all in capitals, a gap for what is no
    letter."""
    row, column = place
    blank = np.zeros((5, 3), bool)
    shapes = [np.pad(LETTERS.get(letter, blank), ((0, 0), (0, 1))) for letter in text.upper()]
    if not shapes:
        return
    large = np.kron(np.concatenate(shapes, axis=1), np.ones((scale, scale), bool))
    pixels = np.argwhere(large) + np.array([row, column])
    inside = np.all((pixels >= 0) & (pixels < image.shape[:2]), axis=1)
    image[pixels[inside, 0], pixels[inside, 1]] = colour


def strip(text: str, width: int, lines: int, scale: int) -> np.ndarray:
    """Text on black, [lines of it, width, 3], broken between words; what does not fit is left
    out."""
    image = np.zeros(((lines * LINE + 1) * scale, width, 3), np.uint8)
    broken = textwrap.wrap(text, max((width - 2 * scale) // (ADVANCE * scale), 1))[:lines]
    for number, part in enumerate(broken):
        write(image, ((number * LINE + 1) * scale, scale), part, scale, (230, 230, 230))
    return image
