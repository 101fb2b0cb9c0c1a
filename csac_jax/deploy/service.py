"""A policy as an HTTP service: images in, decisions out, as JSON.

    POST /decide   {"rgb", "depth": PNG in base64, "intrinsics": {...}, "pose": {"matrix": 4 x 4},
                    "mask"?: PNG in base64, "top"?: 1}
                   -> {"decisions", "id", "warnings", "milliseconds"}; no id without a record
    POST /outcome  {"id", "outcome", "number"?: 1, "ended"?: false} -> {"id"}; see `record`
    GET /health    {"status": "ok"}, with no token
    GET /version   versions, task and workspace of the policy

Errors are {"detail": one line} with a status of 400 to 499, or 507 if the record's disc is full.
Decisions are taken one by one, and requests wait for their turn.
"""

import asyncio
import base64
import functools
import secrets
import struct
import threading
import time
import warnings
from typing import Annotated, Any

import fastapi
import numpy as np
import pydantic
from fastapi import Depends, HTTPException, Request
from fastapi.responses import JSONResponse
from starlette.requests import ClientDisconnect

from csac_jax.deploy import CameraPolicy, image_files, images
from csac_jax.deploy.image_files import PoseBody
from csac_jax.deploy.record import Image, Recorder, ReportedOutcome
from csac_jax.errors import DataWarning, SettingsError, ViewError, first_fault
from csac_jax.runtime import provenance
from csac_jax.section import require

LARGEST_BODY = 16 * 2**20  # bytes: two images of 1280 x 720 px take a third
MOST_DISCARDED = 8 * LARGEST_BODY
SLOWEST_BODY = 30.0  # s, to send one
STATUS: dict[type[Exception], int] = {
    SettingsError: 400,
    ClientDisconnect: 400,
    FileNotFoundError: 404,
    ViewError: 422,
    pydantic.ValidationError: 422,
    OSError: 507,
}
_PNG, _PNG_START = struct.Struct(">16sII"), b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"
"""The start of a PNG: signature, length and name of the first chunk; then width and height."""


class DecideRequest(pydantic.BaseModel, extra="forbid"):
    """The body of /decide."""

    rgb: str
    depth: str
    intrinsics: dict[str, Any]
    pose: PoseBody
    mask: str | None = None
    top: int = 1


class OutcomeRequest(ReportedOutcome, frozen=True):
    """The body of /outcome."""

    id: str


async def read_body(request: Request) -> bytes:
    """Reads the whole body; refuses one that is too large or too slow.

    Of a larger body up to MOST_DISCARDED is read: a client that still sends sees no answer.
    """
    body, size = bytearray(), 0
    try:
        async with asyncio.timeout(SLOWEST_BODY):
            async for piece in request.stream():
                size += len(piece)
                body += piece if size <= LARGEST_BODY else b""
                if size > MOST_DISCARDED:
                    break
    except TimeoutError:
        raise _refused(408, f"the body took more than {SLOWEST_BODY:.0f} s") from None
    if size > LARGEST_BODY:
        text = f"the body is larger than {LARGEST_BODY >> 20} MiB; send smaller images"
        raise _refused(413, text)
    return bytes(body)


def _refused(status: int, text: str) -> HTTPException:
    return HTTPException(status, text, {"connection": "close"})  # the rest of the body is not read


Body = Annotated[bytes, Depends(read_body)]


def make(
    policy: CameraPolicy, source: str, token: str | None = None, recorder: Recorder | None = None
) -> Any:
    """Builds the service of a policy as an ASGI application.

    /version names the `source`. A `recorder` stores images, decisions and outcomes.
    """

    def check_token(request: Request) -> None:
        sent, wanted = request.headers.get("authorization", ""), f"Bearer {token}"
        if token is not None and not secrets.compare_digest(sent.encode(), wanted.encode()):
            raise _refused(401, "send the header Authorization: Bearer TOKEN")

    app, turn = fastapi.FastAPI(openapi_url=None), threading.Lock()
    for kind, status in STATUS.items():
        app.add_exception_handler(kind, functools.partial(_one_line, status))
    router = fastapi.APIRouter(dependencies=[Depends(check_token)])

    @app.get("/health")
    def health() -> dict[str, str]:
        return {"status": "ok"}

    @router.get("/version")
    def version() -> dict[str, Any]:
        extent, task = policy.cfg.heightmap.extent, policy.cfg.task.kind
        about = {"policy": source, "task": task, "extent": extent}
        return {**about, "versions": provenance.versions()}

    @router.post("/decide")
    def decide(body: Body) -> dict[str, Any]:
        request = DecideRequest.model_validate_json(body)
        image = _image(request)
        with turn, warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", DataWarning)
            begun = time.perf_counter()
            decisions = policy.decide(*image, request.top)
            seconds = time.perf_counter() - begun
            entry = None if recorder is None else recorder.add(image, decisions)
        return {
            "decisions": [decision.to_dict() for decision in decisions],
            "id": entry,
            "warnings": [str(warning.message) for warning in caught],
            "milliseconds": round(1e3 * seconds, 1),
        }

    @router.post("/outcome")
    def post_outcome(body: Body) -> dict[str, Any]:
        if recorder is None:
            raise FileNotFoundError("the service records nothing; start it with a record")
        request = OutcomeRequest.model_validate_json(body)
        with turn:
            recorder.post(request.id, ReportedOutcome(**request.model_dump(exclude={"id"})))
        return {"id": request.id}

    app.include_router(router)
    return app


def _one_line(status: int, _: Request, error: Exception) -> JSONResponse:
    text = first_fault(error) if isinstance(error, pydantic.ValidationError) else str(error)
    return JSONResponse({"detail": " ".join(text.split())}, status)


def _image(request: DecideRequest) -> Image:
    rgb, depth = _pixels(request.rgb, "rgb"), image_files.metres(_pixels(request.depth, "depth"))
    mask = None if request.mask is None else _pixels(request.mask, "mask")
    return rgb, depth, request.intrinsics, request.pose.matrix, mask


def _pixels(text: str, name: str) -> np.ndarray:
    """Decodes a PNG in base64. Raises SettingsError for anything else, and for one too large."""
    try:
        content = base64.b64decode(text, validate=True)
        start, width, height = _PNG.unpack_from(content)
    except (ValueError, struct.error):
        start, width, height = b"", 0, 0
    require(start == _PNG_START, f"{name}: must be a PNG in base64")
    fits = max(width, height) <= images.MOST_PIXELS
    require(fits, f"{name}: at most {images.MOST_PIXELS} px a side")
    return image_files.decode(content)
