"""A policy as an HTTP service: images in, decisions out, as JSON.

    POST /decide   {"rgb", "depth": PNG in base64, "intrinsics": {...}, "pose": {"matrix": 4 x 4},
                    "mask"?: PNG in base64, "top"?: 1}
                   -> {"decisions", "id", "warnings", "milliseconds"}; no id without a record
    POST /outcome  {"id", "outcome", "number"?: 1, "ended"?: false} -> {"id"}; see `record`
    GET /health    {"status": "ok"}, with no token
    GET /version   versions, task and workspace of the policy
    GET /openapi.json  the schema of all of them, with no token

Errors are {"detail": one line} with a status of 400 to 499, or 507 if the record's disc is full.
Requests that wait are decided together; too many get the status 429. Threads do all that takes
time, so /health answers at once.
"""

import asyncio
import functools
import secrets
from collections.abc import AsyncIterator, Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from typing import Annotated, Any

import fastapi
import pydantic
from fastapi import Depends, HTTPException, Request, Response
from fastapi.responses import JSONResponse
from fastapi.security import HTTPBearer
from starlette.requests import ClientDisconnect

import csac_jax
from csac_jax.deploy import CameraPolicy, requests
from csac_jax.deploy.batching import Batcher, FullError
from csac_jax.deploy.decider import THREADS, Decider, batch_size
from csac_jax.deploy.record import Recorder
from csac_jax.deploy.requests import LARGEST_BODY, LARGEST_OUTCOME
from csac_jax.errors import SettingsError, ViewError, first_fault
from csac_jax.runtime import provenance

MOST_HELD = 2**28  # bytes of bodies at a time
MOST_DISCARDED = 8 * LARGEST_BODY
SLOWEST_BODY = 10.0  # s, to send one
SLOWEST_REFUSAL = 0.8  # s, to read the rest of a body that is refused since too many wait
STATUS: dict[type[Exception], int] = {
    SettingsError: 400,
    ClientDisconnect: 400,
    FileNotFoundError: 404,
    ViewError: 422,
    pydantic.ValidationError: 422,
    FullError: 429,
    OSError: 507,
}
_FAULTS: dict[int | str, dict[str, Any]] = {
    status: {"model": requests.Fault} for status in sorted({401, 408, 413, *STATUS.values()})
}


class BodyReaders:
    """Readers of bodies of requests, within bounds of size, time and memory."""

    def __init__(self) -> None:
        self._held = 0  # bytes

    def reader(self, largest: int, is_full: Callable[[], bool] = lambda: False) -> Any:
        """Returns a dependency that reads a body and counts it until the request is answered."""

        async def read(request: Request) -> AsyncIterator[bytearray]:
            body = bytearray()
            try:
                await self._fill(body, request, largest, is_full())
                yield body
            finally:
                self._held -= len(body)

        return read

    async def _fill(self, body: bytearray, request: Request, largest: int, is_full: bool) -> None:
        """Reads the whole body. Of one that is refused it discards the rest, up to MOST_DISCARDED:
        a client that still sends sees no answer."""
        size, refusal, clock = 0, _too_many() if is_full else None, asyncio.get_running_loop().time
        try:
            async with asyncio.timeout(SLOWEST_REFUSAL if is_full else SLOWEST_BODY) as limit:
                async for piece in request.stream():
                    size += len(piece)
                    if refusal is None and size > largest:
                        text = f"the body is larger than {largest >> 10} KiB; send less"
                        refusal = _refused(413, text)
                    if refusal is None and self._held + len(piece) > MOST_HELD:
                        refusal = _too_many()
                        limit.reschedule(clock() + SLOWEST_REFUSAL)
                    if refusal is None:
                        body += piece
                        self._held += len(piece)
                    if size > MOST_DISCARDED:
                        break
        except TimeoutError:
            late = f"the body took more than {SLOWEST_BODY:.0f} s"
            raise refusal or _refused(408, late) from None
        if refusal is not None:
            raise refusal


def _refused(status: int, text: str) -> HTTPException:
    return HTTPException(status, text, {"connection": "close"})  # the rest of the body is not read


def _too_many() -> HTTPException:
    return _refused(429, "too many requests wait; ask again later")


async def unless_left(request: Request, work: Coroutine[Any, Any, Any]) -> Any:
    """Awaits `work`; cancels it and raises ClientDisconnect as soon as the client leaves."""

    async def left() -> None:
        while (await request.receive())["type"] != "http.disconnect":
            pass

    tasks = asyncio.ensure_future(work), asyncio.ensure_future(left())
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        if not tasks[0].done():
            raise ClientDisconnect
        return tasks[0].result()
    finally:
        for task in tasks:
            task.cancel()


def make(
    policy: CameraPolicy,
    source: str,
    token: str | None = None,
    recorder: Recorder | None = None,
    size: tuple[int, int] = (640, 480),
) -> Any:
    """Builds the service of a policy as an ASGI application.

    /version names the `source`. A `recorder` stores images, decisions and outcomes. The policy is
    warm for images of `size`, px.
    """

    async def check_token(request: Request) -> None:
        sent, wanted = request.headers.get("authorization", ""), f"Bearer {token}"
        if token is not None and not secrets.compare_digest(sent.encode(), wanted.encode()):
            raise _refused(401, "send the header Authorization: Bearer TOKEN")

    batcher = Batcher(Decider(policy, recorder, size).answer, batch_size, THREADS)
    bodies, parsers = BodyReaders(), ThreadPoolExecutor(2, "parse")
    disc = ThreadPoolExecutor(1, "disc")
    about = {"task": policy.cfg.task.kind, "extent": policy.cfg.heightmap.extent}
    versions = {"policy": source, **about, "versions": provenance.versions()}
    app = fastapi.FastAPI(
        title="csac-jax serve", version=csac_jax.__version__, docs_url=None, redoc_url=None
    )
    for kind, status in STATUS.items():
        app.add_exception_handler(kind, functools.partial(_one_line, status))
    guards = [Depends(check_token)]
    guards += [] if token is None else [Depends(HTTPBearer(auto_error=False))]
    router = fastapi.APIRouter(dependencies=guards, responses=_FAULTS)

    @app.get("/health")
    async def health() -> dict[str, str]:
        return {"status": "ok"}

    @router.get("/version")
    async def version() -> dict[str, Any]:
        return versions

    question = Depends(bodies.reader(LARGEST_BODY, lambda: batcher.is_full))
    answer: dict[int | str, dict[str, Any]] = {200: {"model": requests.DecideAnswer}}
    sent = requests.schema(requests.DecideRequest)

    @router.post("/decide", openapi_extra=sent, responses=answer)
    async def decide(request: Request, body: Annotated[bytearray, question]) -> Response:
        loop = asyncio.get_running_loop()
        asked = await loop.run_in_executor(parsers, requests.question, body)
        content = await unless_left(request, batcher.ask(asked))
        return Response(content, media_type="application/json")

    report = Depends(bodies.reader(LARGEST_OUTCOME))

    @router.post("/outcome", openapi_extra=requests.schema(requests.OutcomeRequest))
    async def post_outcome(body: Annotated[bytearray, report]) -> dict[str, str]:
        if recorder is None:
            raise FileNotFoundError("the service records nothing; start it with a record")
        name, reported = requests.outcome(body)
        await asyncio.get_running_loop().run_in_executor(disc, recorder.post, name, reported)
        return {"id": name}

    app.include_router(router)
    return app


async def _one_line(status: int, _: Request, error: Exception) -> JSONResponse:
    text = first_fault(error) if isinstance(error, pydantic.ValidationError) else str(error)
    return JSONResponse({"detail": " ".join(text.split())}, status)
