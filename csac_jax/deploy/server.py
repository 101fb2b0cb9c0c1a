"""The process that serves: its port, and connections that may be slow, silent or many."""

import asyncio
import socket
from typing import Any

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from csac_jax.errors import FailedError

SLOWEST_HEAD = 10.0  # s, from a connection, or from an answer, to the next request's headers
SLOWEST_ANSWER = 60.0  # s, until a client has read it
LAST_ANSWERS = 9  # s, for those that wait when the process is stopped
MOST_CONNECTIONS = 512


class Connection(H11Protocol):
    """A connection that ends if its client is silent; uvicorn has no such bound."""

    _timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        """Accepts a connection, unless there are too many."""
        super().connection_made(transport)
        if len(self.connections) > MOST_CONNECTIONS:
            transport.abort()
        self._expire_after(SLOWEST_HEAD, None)

    def on_response_complete(self) -> None:
        """Waits for the next request, which may be there already."""
        answered = self.cycle
        super().on_response_complete()
        self._expire_after(SLOWEST_HEAD, answered)

    def _expire_after(self, seconds: float, request: Any) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self.loop.call_later(seconds, self._expire, request)

    def _expire(self, request: Any) -> None:
        """Ends the connection if it has had no new request since `request`."""
        if self.cycle is request:
            self.transport.abort()
        else:
            self._expire_after(SLOWEST_ANSWER, self.cycle)


def claim(host: str, port: int) -> socket.socket:
    """Takes a port, so that nobody else does. Raises FailedError if it is taken."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen()
    except OSError as error:
        listener.close()
        text = f"{host}:{port}: {error.strerror}; give another --port or --host"
        raise FailedError(text) from None
    return listener


def configured(app: Any) -> uvicorn.Server:
    """Builds a server of the application, which runs on a claimed port."""
    return uvicorn.Server(
        uvicorn.Config(
            app,
            http=Connection,
            ws="none",
            lifespan="off",
            log_level="warning",
            timeout_graceful_shutdown=LAST_ANSWERS,
        )
    )
