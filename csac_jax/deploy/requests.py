"""Bodies of requests to the service: their form, and bounds that hold before anything is built."""

import base64
from typing import Annotated, Any, NamedTuple

import pydantic
from pydantic import WithJsonSchema

from csac_jax import deploy
from csac_jax.deploy import image_files
from csac_jax.deploy.image_files import PoseBody
from csac_jax.deploy.images import Intrinsics
from csac_jax.deploy.record import Image, ReportedOutcome
from csac_jax.section import require

LARGEST_BODY = 16 * 2**20  # bytes: two images of 1280 x 720 px take a third
LARGEST_OUTCOME = 2**12  # bytes
MOST_PIXELS = 2**22  # of an image: as many as a body can hold of a photograph
MOST_MARKS = 1000  # of MARKS in a body: some 100 are needed
MARKS = (b'"', b",", b"[", b"{")  # every key and value of JSON has one; base64 has none
_PNG = b"\x89PNG\r\n\x1a\n"

_BASE64 = {"contentEncoding": "base64", "contentMediaType": "image/png", "pattern": "^iVBORw0KGgo"}
_Png = Annotated[str, WithJsonSchema({"type": "string", **_BASE64})]
_Lens = WithJsonSchema(pydantic.TypeAdapter(Intrinsics).json_schema())
_Top = WithJsonSchema({"type": "integer", "minimum": 1, "maximum": deploy.MOST_ALTERNATIVES})


class DecideRequest(pydantic.BaseModel, extra="forbid"):
    """The body of /decide."""

    rgb: _Png
    depth: _Png
    intrinsics: Annotated[dict[str, Any], _Lens]
    pose: PoseBody
    mask: _Png | None = None
    top: Annotated[int, _Top] = 1


class DecideAnswer(pydantic.BaseModel):
    """The answer of /decide."""

    decisions: list[dict[str, Any]]
    id: str | None
    warnings: list[str]
    milliseconds: float


class OutcomeRequest(ReportedOutcome, frozen=True):
    """The body of /outcome."""

    id: str


class Fault(pydantic.BaseModel):
    """The answer to a bad request."""

    detail: str


class Question(NamedTuple):
    """A request for decisions, checked; its images are not decoded yet."""

    rgb: bytes
    depth: bytes
    mask: bytes | None
    intrinsics: dict[str, Any]
    pose: list[list[float]]
    top: int
    size: tuple[int, int]  # width and height of `rgb`, px
    pixels: int  # of the largest image

    def image(self) -> Image:
        """Decodes the arguments of `CameraPolicy.decide`."""
        rgb, depth = (
            image_files.decode(self.rgb),
            image_files.metres(image_files.decode(self.depth)),
        )
        mask = None if self.mask is None else image_files.decode(self.mask)
        return rgb, depth, self.intrinsics, self.pose, mask


def question(body: bytes | bytearray) -> Question:
    """Parses a body of /decide. Raises SettingsError or pydantic.ValidationError."""
    _check_marks(body)
    request = DecideRequest.model_validate_json(body)
    deploy.check_top(request.top)
    names = ("rgb", "depth") if request.mask is None else ("rgb", "depth", "mask")
    images = {name: _png(getattr(request, name), name) for name in names}
    sizes = [image_files.size(content) for content in images.values()]
    for name, (cols, rows) in zip(names, sizes, strict=True):
        text = f"{name}: has {cols} x {rows} px; at most {MOST_PIXELS:,} px are taken"
        require(cols * rows <= MOST_PIXELS, text)
    lens, pose, mask = request.intrinsics, request.pose.matrix, images.get("mask")
    pixels = max(cols * rows for cols, rows in sizes)
    return Question(images["rgb"], images["depth"], mask, lens, pose, request.top, sizes[0], pixels)


def outcome(body: bytes | bytearray) -> tuple[str, ReportedOutcome]:
    """Parses a body of /outcome: the entry's name and what is reported."""
    _check_marks(body)
    request = OutcomeRequest.model_validate_json(body)
    return request.id, ReportedOutcome(**request.model_dump(exclude={"id"}))


def _check_marks(body: bytes | bytearray) -> None:
    """Raises SettingsError for a body of many values, which would be slow to parse."""
    fault = f"the body has more than {MOST_MARKS} keys and values; send only what is needed"
    require(sum(map(body.count, MARKS)) <= MOST_MARKS, fault)


def _png(text: str, name: str) -> bytes:
    try:
        content = base64.b64decode(text, validate=True)
    except ValueError:
        content = b""
    require(content.startswith(_PNG), f"{name}: must be a PNG in base64")
    return content


def schema(model: type[pydantic.BaseModel]) -> dict[str, Any]:
    """Returns the JSON schema of a body without references, as a part of an OpenAPI document."""
    whole = model.model_json_schema()
    parts = {f"#/$defs/{name}": part for name, part in whole.pop("$defs", {}).items()}
    fields = {key: parts.get(one.get("$ref"), one) for key, one in whole["properties"].items()}
    content = {"application/json": {"schema": {**whole, "properties": fields}}}
    return {"requestBody": {"required": True, "content": content}}
