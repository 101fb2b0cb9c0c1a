"""Times decisions over HTTP, as JSON: `csac-jax bench serve [--seconds N] [--port N]`.

Starts `csac-jax serve shipped` in its own process. Then 1, 10, 50 and 200 clients ask again and
again for SECONDS (60) each; one that is refused waits for half a second. Times are the client's,
from sending the images to having the answer. Then 10 ask beside a hostile client. At the end
SIGTERM comes as 50 requests wait.
"""

import concurrent.futures
import http.client
import importlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from csac_jax.errors import FailedError
from experiments.bench._options import timed

camera_image = importlib.import_module("examples.08_camera_image")
PATIENCE = 300.0  # s, until it has compiled
CLIENTS = (1, 10, 50, 200)
BOTHERED = 10  # clients beside a hostile one
LAST = 50  # clients as it is stopped
REST = 0.5  # s, after a refusal


class Reply(NamedTuple):
    """The answer to one request."""

    status: int
    seconds: float
    own: float  # s, of the decision; those decided together share it


def body() -> bytes:
    """Builds a request with the images of examples/08_camera_image.py, 640 x 480 px."""
    with tempfile.TemporaryDirectory() as folder:
        camera_image.main(folder)
        return (Path(folder) / "request.json").read_bytes()


def ask(port: int, content: bytes) -> Reply:
    """Sends a request."""
    begun = time.perf_counter()
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE)
    connection.request("POST", "/decide", content, {"Content-Type": "application/json"})
    answer = connection.getresponse()
    found = json.loads(answer.read())
    connection.close()
    if answer.status not in (200, 429):
        raise RuntimeError(f"status {answer.status}: {found}")
    own = 1e-3 * found.get("milliseconds", 0.0)
    return Reply(answer.status, time.perf_counter() - begun, own)


def _ask_until(end: float, port: int, content: bytes) -> list[Reply]:
    replies = []
    while time.perf_counter() < end:
        replies.append(ask(port, content))
        time.sleep(REST if replies[-1].status == 429 else 0.0)
    return replies


def _until_ready(port: int, process: subprocess.Popen[bytes], errors: IO[bytes]) -> None:
    """Waits until the service answers. Raises FailedError with the last line of its `errors`."""
    begun = time.perf_counter()
    while process.poll() is None and time.perf_counter() - begun < PATIENCE:
        try:
            _health(port)
            return
        except OSError:
            time.sleep(0.1)
    code = process.poll()
    fate = f"no answer in {PATIENCE:.0f} s" if code is None else f"exit code {code}"
    errors.seek(0)
    *_, last = ["no line on stderr", *errors.read().decode(errors="replace").splitlines()]
    raise FailedError(f"the service did not start ({fate}): {last}")


def _health(port: int) -> float:
    """Returns the seconds that /health takes."""
    begun = time.perf_counter()
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    connection.request("GET", "/health")
    connection.getresponse().read()
    connection.close()
    return time.perf_counter() - begun


def _milliseconds(name: str, seconds: list[float]) -> dict[str, float]:
    if not seconds:
        return {}
    levels = {50: "p50", 99: "p99", 100: "most"}
    values = np.percentile(1e3 * np.array(seconds), list(levels))
    named = zip(levels.values(), values, strict=True)
    return {f"{name}_{level}_ms": round(float(value), 1) for level, value in named}


def _bother(end: float, port: int) -> None:
    """Sends each second a body of 14 MB with a million keys, and half of a head."""
    body, silent = b"{" + b",".join(b'"%d":0' % i for i in range(1_200_000)) + b"}", []
    while time.perf_counter() < end:
        silent.append(socket.create_connection(("127.0.0.1", port)))
        silent[-1].sendall(b"POST /decide HTTP/1.1\r\n")
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE)
        connection.request("POST", "/decide", body)
        connection.getresponse().read()
        time.sleep(1.0)


def load(
    port: int, content: bytes, clients: int, seconds: float, process: int, hostile: bool = False
) -> dict[str, Any]:
    """Measures `clients` that ask at once, and /health as they do; maybe with a hostile one."""
    begun, health, worked = time.perf_counter(), [], _cpu_seconds(process)
    with concurrent.futures.ThreadPoolExecutor(clients + 1) as pool:
        end = begun + seconds
        bothering = pool.submit(_bother, end if hostile else begun, port)
        asking = [pool.submit(_ask_until, end, port, content) for _ in range(clients)]
        while time.perf_counter() < end:
            health.append(_health(port))
            time.sleep(0.1)
        replies = [reply for future in asking for reply in future.result()]
        bothering.result()
    answered = [reply for reply in replies if reply.status == 200]
    refused = [reply.seconds for reply in replies if reply.status == 429]
    return {
        "clients": clients,
        "answered": len(answered),
        "refused": len(refused),
        "per_second": len(answered) / (time.perf_counter() - begun),
        "cpu_s_each": (_cpu_seconds(process) - worked) / max(len(answered), 1),
        **_milliseconds("answer", [reply.seconds for reply in answered]),
        **_milliseconds("decision", [reply.own for reply in answered]),
        **_milliseconds("refusal", refused),
        **_milliseconds("health", health),
    }


def _stop(port: int, content: bytes, process: subprocess.Popen[bytes]) -> dict[str, Any]:
    """Stops the process while requests wait."""
    with concurrent.futures.ThreadPoolExecutor(LAST) as pool:
        asking = [pool.submit(ask, port, content) for _ in range(LAST)]
        time.sleep(REST)
        begun = time.perf_counter()
        process.send_signal(signal.SIGTERM)
        replies = [future.result().status for future in asking]
    process.wait()
    seconds = time.perf_counter() - begun
    return {"answered": replies.count(200), "refused": replies.count(429), "seconds": seconds}


def _cpu_seconds(process: int) -> float:
    """Returns what a process has had of all cores; NaN where Linux does not tell it."""
    status = Path(f"/proc/{process}/stat")
    ticks = status.read_text().rpartition(")")[2].split()[11:13] if status.exists() else ["nan"]
    return sum(map(float, ticks)) / os.sysconf("SC_CLK_TCK")


def _peak_mib(process: subprocess.Popen[bytes]) -> float | None:
    """Returns the process's largest memory, where Linux tells it."""
    status = Path(f"/proc/{process.pid}/status")
    lines = status.read_text().splitlines() if status.exists() else []
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM")), None)


def measure(seconds: int, port: int) -> dict[str, Any]:
    """Measures all numbers of clients, then a stop."""
    command = [sys.executable, "-m", "csac_jax", "serve", "shipped", "--port", str(port)]
    content, begun = body(), time.perf_counter()
    errors = tempfile.TemporaryFile()  # noqa: SIM115  the process keeps it open
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=errors)
    try:
        _until_ready(port, process, errors)
        started = time.perf_counter() - begun
        first = ask(port, content).seconds
        loads = [load(port, content, clients, seconds, process.pid) for clients in CLIENTS]
        hostile = load(port, content, BOTHERED, seconds, process.pid, hostile=True)
        memory = _peak_mib(process)
        stop = _stop(port, content, process)
    finally:
        process.kill()
        process.wait()
    result = {"body_bytes": len(content), "started_s": started, "first_request_s": first}
    return {**result, "peak_mib": memory, "loads": loads, "hostile": hostile, "stop": stop}


def main(arguments: list[str]) -> None:
    """Prints the result."""
    timed("serve", arguments, measure, seconds=60, port=8765)
