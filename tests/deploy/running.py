"""An HTTP service in a thread, and its client."""

import http.client
import json
import socket
import threading
import time
from typing import Any

from csac_jax.deploy import server

TOKEN = "correct horse battery"


class Running:
    """A service of an application, on a port of its own."""

    def __init__(self, app: Any) -> None:
        self._server, listener = server.configured(app), server.claim("127.0.0.1", 0)
        self.port = listener.getsockname()[1]
        self._thread = threading.Thread(target=self._server.run, args=([listener],), daemon=True)
        self._thread.start()

    def send(self, path: str, body: Any, token: str = TOKEN) -> http.client.HTTPConnection:
        """Sends a request, GET if it has no body, and awaits no answer."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=120)
        content = body if isinstance(body, bytes | None) else json.dumps(body).encode()
        headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"}
        connection.request("GET" if body is None else "POST", path, content, headers)
        return connection

    def ask(self, path: str, body: Any = None, token: str = TOKEN) -> tuple[int, Any]:
        """Returns status and JSON of a request."""
        connection = self.send(path, body, token)
        answer = connection.getresponse()
        found = answer.status, json.loads(answer.read())
        connection.close()
        return found

    def timed(self, path: str, body: Any = None) -> tuple[int, Any, float]:
        """Returns status, JSON and seconds of a request."""
        begun = time.perf_counter()
        return *self.ask(path, body), time.perf_counter() - begun

    def connect(self) -> socket.socket:
        """Opens a connection."""
        return socket.create_connection(("127.0.0.1", self.port), timeout=5)

    def stop(self) -> None:
        """Stops as SIGTERM does."""
        self._server.should_exit = True
        self._thread.join(20)
