"""The content of a case file as pydantic models. Imported late: pydantic is slow to import.

    {"name": "pair", "blocks": [
        {"shape": "cube", "colour": "red", "position": [0.03, 0, 0.025],
         "quaternion": [1, 0, 0, 0], "target": true}, ...]}

An object of a library has `"object": "NAME", "library": "LIB"` in place of a shape; see
`tables.find`, folders are relative to that of the file. A position is that of the centre of the
bounding box, m. A quaternion (w, x, y, z) is normalised.
"""

import json
import re
from collections import Counter
from typing import Annotated, Any, Literal, Self

import pydantic
from pydantic import BaseModel, Field

from csac_jax.errors import first_fault
from csac_jax.section import shown
from csac_jax.world import blocks

_BLOCK = re.compile(r"'blocks\.(\d+)(' |\.)")  # in a fault: a block, or a key of it
_Shape: Any = Literal[tuple(blocks.SHAPES)]
_Colour: Any = Literal[blocks.COLOUR_NAMES]
_Number = Annotated[float, Field(ge=-10, le=10)]  # more than any place needs; no NaN
_PRINTABLE = r"^[^\p{C}\p{Zl}\p{Zp}]*$"
_Text = Annotated[str, Field(min_length=1, max_length=1000)]


class CaseBlock(BaseModel, extra="forbid", strict=True):
    """A block of the set, or an object of a library, at its place."""

    shape: _Shape | None = None
    object: _Text | None = None
    library: _Text | None = None
    colour: _Colour
    position: Annotated[list[_Number], Field(min_length=3, max_length=3)]
    quaternion: Annotated[list[_Number], Field(min_length=4, max_length=4)]
    target: bool = False

    @pydantic.model_validator(mode="after")
    def _check(self) -> Self:
        present = [value is not None for value in (self.shape, self.object, self.library)]
        if present not in ([True, False, False], [False, True, True]):
            raise ValueError('give a "shape", or an "object" and its "library"')
        if sum(value**2 for value in self.quaternion) <= 1e-12:
            raise ValueError('"quaternion" must not be all zero')
        return self


class CaseFile(BaseModel, extra="forbid", strict=True):
    """All of a case file."""

    name: Annotated[str, Field(min_length=1, max_length=100, pattern=_PRINTABLE)]
    blocks: Annotated[list[CaseBlock], Field(min_length=1, max_length=32)]


def parse(text: str) -> CaseFile:
    """Parses a case file. Raises ValueError, one line with the block (the first is 1) and key."""
    try:
        return CaseFile.model_validate(json.loads(text, object_pairs_hook=_unique))
    except (json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"is not a JSON file: {error}") from None
    except pydantic.ValidationError as error:
        raise ValueError(_BLOCK.sub(_block, first_fault(error))) from None


def _block(match: re.Match) -> str:
    quote = "'" if match[2] == "." else ""
    return f"block {int(match[1]) + 1}: {quote}"


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    for key, number in Counter(key for key, _ in pairs).items():
        if number > 1:
            raise ValueError(f"key {shown(key)} is given twice in one object; remove one")
    return dict(pairs)
