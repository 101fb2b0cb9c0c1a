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
import binascii
import secrets
import struct
import threading
import time
import warnings
from collections.abc import Awaitable, Callable
from typing import Any

import fastapi
import numpy as np
import pydantic
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse

from csac_jax.deploy import CameraPolicy, image_files, images
from csac_jax.deploy.image_files import PoseBody
from csac_jax.deploy.record import Recorder, ReportedOutcome
from csac_jax.errors import DataWarning, SettingsError, ViewError
from csac_jax.runtime import provenance

LARGEST_BODY = 16 * 2**20  # bytes: two images of 1280 x 720 px take a third
MOST_DISCARDED = 8 * LARGEST_BODY
SLOWEST_BODY = 30.0  # s, to send one
OPEN = "/health"  # the path that needs no token
_PNG = struct.Struct(">8s4x4sII")  # signature, first chunk, width, height

Message = dict[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Any], Awaitable[None]]


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


class AuthMiddleware:
    """Middleware that asks for the token and refuses bodies that are too large or too slow."""

    def __init__(self, app: Any, token: str | None) -> None:
        self._app, self._token = app, token

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = {name.lower(): value for name, value in scope["headers"]}
        if scope["path"] != OPEN and not self._knows(headers.get(b"authorization", b"")):
            await _refuse(scope, receive, send, 401, "send the header Authorization: Bearer TOKEN")
            return
        try:
            async with asyncio.timeout(SLOWEST_BODY):
                body = await _body(receive)
        except TimeoutError:
            await _refuse(
                scope, receive, send, 408, f"the body took more than {SLOWEST_BODY:.0f} s"
            )
            return
        if body is None:
            text = f"the body is larger than {LARGEST_BODY >> 20} MiB; send smaller images"
            await _refuse(scope, receive, send, 413, text)
            return
        await self._app(scope, _replay(body, receive), send)

    def _knows(self, authorisation: bytes) -> bool:
        wanted = f"Bearer {self._token}".encode()
        return self._token is None or secrets.compare_digest(authorisation, wanted)


async def _body(receive: Receive) -> bytes | None:
    """Reads the whole body; returns None if it is larger than LARGEST_BODY.

    Of a larger body up to MOST_DISCARDED is read: a client that still sends sees no answer.
    """
    body, more, size = bytearray(), True, 0
    while more and size <= MOST_DISCARDED:
        message = await receive()
        piece = message.get("body", b"")
        more, size = message.get("more_body", False), size + len(piece)
        body += piece if size <= LARGEST_BODY else b""
    return bytes(body) if size <= LARGEST_BODY else None


def _replay(body: bytes, receive: Receive) -> Receive:
    """Returns the body once, then the connection's messages."""
    waiting = [body]

    async def first() -> Message:
        if waiting:
            return {"type": "http.request", "body": waiting.pop(), "more_body": False}
        return await receive()

    return first


async def _refuse(scope: Message, receive: Receive, send: Send, status: int, text: str) -> None:
    headers = {"connection": "close"}  # the rest of the body is not read
    await JSONResponse({"detail": text}, status, headers)(scope, receive, send)


def make(
    policy: CameraPolicy, source: str, token: str | None = None, recorder: Recorder | None = None
) -> Any:
    """Builds the service of a policy as an ASGI application.

    /version names the `source`. A `recorder` stores images, decisions and outcomes.
    """
    app, turn = fastapi.FastAPI(openapi_url=None), threading.Lock()
    app.add_exception_handler(SettingsError, lambda _, error: _one_line(400, error))
    app.add_exception_handler(ViewError, lambda _, error: _one_line(422, error))
    app.add_exception_handler(RequestValidationError, lambda _, error: _invalid(error))
    app.add_exception_handler(FileNotFoundError, lambda _, error: _one_line(404, error))
    app.add_exception_handler(OSError, lambda _, error: _one_line(507, error))

    @app.get(OPEN)
    def health() -> dict[str, str]:
        return {"status": "ok"}

    @app.get("/version")
    def version() -> dict[str, Any]:
        extent, task = policy.cfg.heightmap.extent, policy.cfg.task.kind
        about = {"policy": source, "task": task, "extent": extent}
        return {**about, "versions": provenance.versions()}

    @app.post("/decide")
    def decide(request: DecideRequest) -> dict[str, Any]:
        image = _arrays(request)
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

    @app.post("/outcome")
    def post_outcome(request: OutcomeRequest) -> dict[str, Any]:
        if recorder is None:
            raise FileNotFoundError("the service records nothing; start it with a record")
        outcome = ReportedOutcome(**request.model_dump(exclude={"id"}))
        with turn:
            recorder.post(request.id, outcome)
        return {"id": request.id}

    return AuthMiddleware(app, token)


def _one_line(status: int, error: Exception) -> JSONResponse:
    return JSONResponse({"detail": " ".join(str(error).split())}, status)


def _invalid(error: Any) -> JSONResponse:
    """Returns the first fault of a body, without the body."""
    first = error.errors()[0]
    place = ".".join(map(str, first["loc"][:4]))
    return JSONResponse({"detail": f"{place}: {first['msg'][:200]}"}, 422)


def _arrays(request: DecideRequest) -> tuple[Any, Any, Any, Any, Any]:
    """Decodes the arguments of `CameraPolicy.decide` but `top`."""
    rgb, depth = _pixels(request.rgb, "rgb"), _pixels(request.depth, "depth")
    mask = None if request.mask is None else _pixels(request.mask, "mask")
    metres = image_files.metres(depth, "depth")
    return rgb, metres, request.intrinsics, request.pose.matrix, mask


def _pixels(text: str, name: str) -> np.ndarray:
    """Decodes a PNG in base64. Raises SettingsError for anything else, and for one too large."""
    try:
        content = base64.b64decode(text, validate=True)
        signature, kind, width, height = _PNG.unpack_from(content)
    except (binascii.Error, ValueError, struct.error):
        raise SettingsError(f"{name}: must be a PNG in base64") from None
    if signature != b"\x89PNG\r\n\x1a\n" or kind != b"IHDR":
        raise SettingsError(f"{name}: must be a PNG in base64")
    if max(width, height) > images.MOST_PIXELS:
        raise SettingsError(f"{name}: at most {images.MOST_PIXELS} px a side")
    return image_files.decode(content)
