"""Times decisions over HTTP, as JSON: `csac-jax bench serve [--requests N] [--clients N]`.

Starts `csac-jax serve shipped` in its own process. One client asks again and again, then many at
once. Times are the client's, from sending the images to having the answer.
"""

import base64
import concurrent.futures
import http.client
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from examples import camera_image
from experiments.bench._options import timed

PATIENCE = 300.0  # s, until it has compiled


def body() -> bytes:
    """Builds a request with the images of examples/camera_image.py, 640 x 480 px."""
    with tempfile.TemporaryDirectory() as folder:
        camera_image.main(folder)
        files = {path.name: path.read_bytes() for path in Path(folder).iterdir()}
    request: dict[str, Any] = {
        name: base64.b64encode(files[f"{name}.png"]).decode() for name in ("rgb", "depth")
    }
    request |= {name: json.loads(files[f"{name}.json"]) for name in ("intrinsics", "pose")}
    return json.dumps(request).encode()


def ask(port: int, content: bytes) -> tuple[float, float]:
    """Sends a request; returns its seconds and the decision's own."""
    begun = time.perf_counter()
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE)
    connection.request("POST", "/decide", content, {"Content-Type": "application/json"})
    answer = connection.getresponse()
    found = json.loads(answer.read())
    connection.close()
    if answer.status != 200 or not found["decisions"]:
        raise RuntimeError(f"status {answer.status}: {found}")
    return time.perf_counter() - begun, 1e-3 * found["milliseconds"]


def _until_ready(port: int, process: subprocess.Popen[bytes]) -> None:
    begun = time.perf_counter()
    while process.poll() is None and time.perf_counter() - begun < PATIENCE:
        try:
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
            connection.request("GET", "/health")
            connection.getresponse().read()
            return
        except OSError:
            time.sleep(0.1)
    raise RuntimeError("the service does not answer")


def _summary(seconds: list[tuple[float, float]]) -> dict[str, float]:
    whole, own = 1e3 * np.array(seconds).T
    levels = {"p50_ms": (whole, 50), "p99_ms": (whole, 99), "decision_p50_ms": (own, 50)}
    return {name: float(np.percentile(values, level)) for name, (values, level) in levels.items()}


def measure(requests: int, clients: int, port: int) -> dict[str, Any]:
    """Measures one client, then `clients` at once."""
    command = [sys.executable, "-m", "csac_jax", "serve", "shipped", "--port", str(port)]
    content, begun = body(), time.perf_counter()
    process = subprocess.Popen(command)
    try:
        _until_ready(port, process)
        started = time.perf_counter() - begun
        first, _ = ask(port, content)
        one = [ask(port, content) for _ in range(requests)]
        begun = time.perf_counter()
        with concurrent.futures.ThreadPoolExecutor(clients) as pool:
            many = list(pool.map(lambda _: ask(port, content), range(requests)))
        rate = requests / (time.perf_counter() - begun)
    finally:
        process.terminate()
        process.wait()
    result: dict[str, Any] = {"requests": requests, "body_bytes": len(content)}
    result |= {"started_s": started, "first_request_s": first}
    together = {"clients": clients, "answered": len(many), "per_second": rate, **_summary(many)}
    return {**result, "one_client": _summary(one), "many_clients": together}


def main(arguments: list[str]) -> None:
    """Prints the result."""
    timed("serve", arguments, measure, requests=200, clients=50, port=8765)
