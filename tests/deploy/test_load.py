"""The HTTP service under load, with a policy that only waits: many, slow and hostile clients."""

import base64
import concurrent.futures
import http.client
import json
import random
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from csac_jax import presets
from csac_jax.deploy import image_files as files, record
from csac_jax.deploy.record import Recorder
from csac_jax.errors import SettingsError
from tests.deploy import image_files

pytest.importorskip("uvicorn")
pytest.importorskip("fastapi")

from csac_jax.deploy import batching, decider, requests, server, service  # isort: skip
from tests.deploy.running import Running  # isort: skip

PNG = files.encode(np.zeros((16, 16, 3), np.uint8))
DEPTH = files.encode(np.ones((16, 16), np.uint16))
LENS = {"width": 16, "height": 16, "fx": 9.0, "fy": 9.0, "cx": 8.0, "cy": 8.0}
BODY: dict[str, Any] = {
    "rgb": base64.b64encode(PNG).decode(),
    "depth": base64.b64encode(DEPTH).decode(),
    "intrinsics": LENS,
    "pose": {"matrix": np.eye(4).tolist()},
}


class SlowPolicy:
    """A policy that takes its time for a batch, and decides nothing."""

    cfg = presets.smoke()

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.batches: list[list[int]] = []  # the `top` of each question

    def inspect(self, *image: Any) -> tuple[Any, list[str]]:
        """Sees nothing."""
        return image[0], []

    def decide_each(self, observations: list[Any], tops: list[int], _: bool) -> list[list[Any]]:
        """Waits."""
        self.batches.append(tops)
        time.sleep(self.seconds)
        return [[] for _ in observations]


class Service(Running):
    """The service of a slow policy."""

    def __init__(self, seconds: float, folder: Path | None = None) -> None:
        self.policy: Any = SlowPolicy(seconds)
        recorder = None if folder is None else Recorder(folder, "slow")
        super().__init__(service.make(self.policy, "slow", None, recorder, (16, 16)))


@pytest.fixture
def start() -> Iterator[Callable[..., Service]]:
    """Starts services, and stops them after the test."""
    services: list[Service] = []

    def make(seconds: float = 0.0, folder: Path | None = None) -> Service:
        services.append(Service(seconds, folder))
        return services[-1]

    yield make
    for one in services:
        one.stop()


def _until(holds: Callable[[], bool]) -> None:
    end = time.perf_counter() + 10.0
    while not holds():
        assert time.perf_counter() < end, "it takes too long"
        time.sleep(0.01)


HOSTILE = {
    "keys": b"{" + b",".join(b'"%d":0' % i for i in range(1_200_000)) + b"}",
    "rows": b'{"pose":{"matrix":[' + b",".join([b"[]"] * 4_000_000) + b"]}}",
    "depth": b"[" * 14_000_000,
    "digits": b'{"top":' + b"1" * 14_000_000 + b"}",
    "spaces": b" " * 16_000_000,
    "escapes": b'{"rgb":"' + b"\\u0041" * 2_300_000 + b'"}',
    "base64": json.dumps({**BODY, "rgb": "A" * 15_000_000}).encode(),
}


@pytest.mark.parametrize("body", HOSTILE.values(), ids=HOSTILE)
def test_hostile_bodies_stop_nobody(start: Callable[..., Service], body: bytes):
    """Claim: a large body of many keys, rows or digits, or of great depth, is refused within 3 s by
    one line. Meanwhile /health answers within a second."""
    running, slowest = start(), 0.0
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        asked = pool.submit(running.timed, "/decide", body)
        while not asked.done():
            status, _, seconds = running.timed("/health")
            assert status == 200
            slowest = max(slowest, seconds)
    status, answer, seconds = asked.result()
    assert status in (400, 422)
    assert len(answer["detail"]) < 400
    assert seconds < 3.0
    assert slowest < 1.0


def test_parsing_stops_nobody(
    start: Callable[..., Service], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    """Claim: /health answers while bodies are parsed and while an outcome is written."""

    def slow(*_: Any) -> Any:
        time.sleep(1.0)
        raise SettingsError("slow")

    monkeypatch.setattr(requests, "question", slow)
    monkeypatch.setattr(Recorder, "post", slow)
    running = start(0.0, tmp_path)
    outcome = {"id": "000001", "outcome": "lifted"}
    for path, body in (("/decide", BODY), ("/outcome", outcome)):
        connection = running.send(path, body)
        time.sleep(0.2)
        assert running.timed("/health")[2] < 0.5
        assert connection.getresponse().status == 400


def test_waiting_requests_are_decided_together(
    start: Callable[..., Service], monkeypatch: pytest.MonkeyPatch
):
    """Claim: where batches pay, those that wait are decided together, in numbers that are compiled
    for. Each gets an answer, and masked images have their own batches."""
    monkeypatch.setattr(decider, "batches", lambda: (1, 4, 16))
    monkeypatch.setattr(batching, "LONGEST", 60.0)
    running = start(0.3)
    bodies = [{**BODY, "top": 1 + n % 8} for n in range(40)]
    bodies += [{**BODY, "mask": BODY["depth"], "top": 9}] * 4
    with concurrent.futures.ThreadPoolExecutor(len(bodies)) as pool:
        answers = list(pool.map(lambda body: running.timed("/decide", body), bodies))
    assert {status for status, *_ in answers} == {200}
    sizes = [len(batch) for batch in running.policy.batches]
    assert (set(sizes) <= {1, 4, 16}, max(sizes)) == (True, 16)
    decided = sorted(top for batch in running.policy.batches for top in batch)
    assert decided == sorted(body["top"] for body in bodies)
    assert all(set(batch) == {9} for batch in running.policy.batches if 9 in batch)


def test_batches_are_small(monkeypatch: pytest.MonkeyPatch):
    """Claim: the images of a batch of several have no more pixels than one image may have."""
    monkeypatch.setattr(decider, "batches", lambda: (1, 4, 16))
    small = requests.question(json.dumps(BODY).encode())
    large = small._replace(pixels=requests.MOST_PIXELS)
    assert [decider.batch_size([small] * n) for n in (1, 3, 4, 15, 99)] == [1, 1, 4, 4, 16]
    assert decider.batch_size([large, small, small, small]) == 1
    assert decider.batch_size([small, small, small, large]) == 1


def test_one_bad_image_spoils_no_batch(
    start: Callable[..., Service], monkeypatch: pytest.MonkeyPatch
):
    """Claim: of questions that are decided together, a bad one is refused and the others are
    answered."""
    monkeypatch.setattr(decider, "batches", lambda: (1, 4))
    monkeypatch.setattr(service, "THREADS", 1)
    running = start(0.5)
    damaged = {**BODY, "rgb": base64.b64encode(image_files.png_start((16, 16))).decode()}
    bodies = [BODY] * 3 + [damaged] * 2
    with concurrent.futures.ThreadPoolExecutor(9) as pool:
        first = pool.submit(running.timed, "/decide", BODY)
        _until(lambda: bool(running.policy.batches))
        answers = list(pool.map(lambda body: running.timed("/decide", body)[0], bodies))
    assert first.result()[0] == 200
    assert answers == [200] * 3 + [400] * 2
    assert max(map(len, running.policy.batches)) == 4


def test_failing_policy_stops_nothing(
    start: Callable[..., Service], monkeypatch: pytest.MonkeyPatch
):
    """Claim: where the policy itself fails, its batch gets the status 500, and the next is
    answered."""
    running = start()

    def fail(*_: Any) -> None:
        raise RuntimeError("out of memory")

    with monkeypatch.context() as patch:
        patch.setattr(running.policy, "decide_each", fail)
        for _ in range(2 * decider.THREADS):
            connection = running.send("/decide", BODY)
            assert connection.getresponse().status == 500
            connection.close()
    assert running.timed("/decide", BODY)[0] == 200


def test_full_queue_answers_at_once(start: Callable[..., Service], monkeypatch: pytest.MonkeyPatch):
    """Claim: of 200 clients each is answered or gets the status 429 within a second, in which
    /health answers too."""
    monkeypatch.setattr(batching, "LONGEST", 1e9)
    running = start(0.1)
    with concurrent.futures.ThreadPoolExecutor(200) as pool:
        asked = [pool.submit(running.timed, "/decide", BODY) for _ in range(200)]
        health = [running.timed("/health")[2] for _ in range(20)]
        replies = [future.result() for future in asked]
    refused = [reply for reply in replies if reply[0] == 429]
    assert {status for status, *_ in replies} == {200, 429}
    assert len(replies) - len(refused) >= batching.MOST_WAITING
    assert max(seconds for *_, seconds in refused) < 1.0
    assert "too many requests wait" in refused[0][1]["detail"]
    assert max(health) < 1.0


def test_queue_is_as_long_as_it_is_soon_answered(start: Callable[..., Service]):
    """Claim: once the pace is known, of forty clients each is answered within about a second, or
    gets the status 429."""
    running = start(0.1)
    for _ in range(12):
        assert running.timed("/decide", BODY)[0] == 200
    with concurrent.futures.ThreadPoolExecutor(40) as pool:
        replies = list(pool.map(lambda _: running.timed("/decide", BODY), range(40)))
    answered = [seconds for status, _, seconds in replies if status == 200]
    assert [status for status, *_ in replies].count(429) > 12
    assert len(answered) > 3 * decider.THREADS
    assert max(answered) < 1.5


def test_nobody_waits_nothing_is_decided(start: Callable[..., Service], tmp_path: Path):
    """Claim: requests whose clients have left are neither decided nor recorded."""
    running = start(0.5, tmp_path)
    connections = [running.send("/decide", BODY) for _ in range(20)]
    _until(lambda: len(running.policy.batches) == decider.THREADS)
    time.sleep(0.2)
    for connection in connections:
        connection.close()
    status, answer, seconds = running.timed("/decide", BODY)
    assert (status, answer["id"]) == (200, "000001")
    assert seconds < 1.5
    assert len(running.policy.batches) == decider.THREADS + 1
    assert len(record.read(tmp_path)) == 1


def test_memory_of_bodies_is_bounded(
    start: Callable[..., Service], monkeypatch: pytest.MonkeyPatch
):
    """Claim: bodies that are held have MOST_HELD bytes in all. What does not fit gets the status
    429 soon, though its client stalls; what was held by those that left is free again."""
    monkeypatch.setattr(service, "MOST_HELD", 2**20)
    running = start()
    slow, stalled = running.connect(), running.connect()
    for connection, size in ((slow, 900_000), (stalled, 200_000)):
        head = b"POST /decide HTTP/1.1\r\nhost: a\r\ncontent-length: 2000000\r\n\r\n"
        connection.sendall(head + bytes(size))
        time.sleep(0.3)
    assert stalled.recv(99).startswith(b"HTTP/1.1 429")
    large = {**BODY, "mask": "A" * 200_000}
    assert running.timed("/decide", large)[0] == 429
    assert running.timed("/decide", BODY)[0] == 200
    slow.close()
    _until(lambda: running.timed("/decide", large)[0] == 400)


def test_sizes_of_images_are_few(start: Callable[..., Service], monkeypatch: pytest.MonkeyPatch):
    """Claim: a service compiles for MOST_SIZES sizes of images at most, its own among them."""
    monkeypatch.setattr(decider, "MOST_SIZES", 2)
    running = start()
    rgb = [files.encode(np.zeros((16, width, 3), np.uint8)) for width in (16, 17, 18, 17)]
    bodies = [{**BODY, "rgb": base64.b64encode(content).decode()} for content in rgb]
    replies = [running.timed("/decide", body) for body in bodies]
    assert [status for status, *_ in replies] == [200, 200, 400, 200]
    assert "compiled for 2 other sizes" in replies[2][1]["detail"]


def test_slow_bodies_end(start: Callable[..., Service], monkeypatch: pytest.MonkeyPatch):
    """Claim: a body that takes too long gets the status 408, and its connection ends."""
    monkeypatch.setattr(service, "SLOWEST_BODY", 0.3)
    slow = start().connect()
    slow.sendall(b"POST /decide HTTP/1.1\r\nhost: a\r\ncontent-length: 2000\r\n\r\n{")
    answer = b"".join(iter(lambda: slow.recv(4096), b""))
    assert answer.startswith(b"HTTP/1.1 408")
    assert b"the body took more than" in answer


HEAD = b"GET /health HTTP/1.1\r\nhost: a\r\n"


@pytest.mark.parametrize("sent", [b"", HEAD, HEAD + b"\r\n", HEAD + b"\r\n" + HEAD])
def test_silent_connections_end(
    start: Callable[..., Service], monkeypatch: pytest.MonkeyPatch, sent: bytes
):
    """Claim: a connection ends whose client sends no head, or a part of one every tenth of a
    second, also after an answer."""
    monkeypatch.setattr(server, "SLOWEST_HEAD", 0.6)
    connection, begun = start().connect(), time.perf_counter()
    connection.settimeout(0.1)
    connection.sendall(sent)
    answer, ended = b"", False
    while not ended and time.perf_counter() - begun < 5.0:
        try:
            if sent and not sent.endswith(b"\r\n\r\n"):
                connection.sendall(b"x: 1\r\n")
            piece = connection.recv(4096)
            answer, ended = answer + piece, piece == b""
        except TimeoutError:
            pass
        except OSError:
            ended = True
    assert ended
    assert 0.4 < time.perf_counter() - begun < 3.0
    assert (b"200 OK" in answer) == (HEAD + b"\r\n" in sent)


def test_busy_connections_stay(start: Callable[..., Service], monkeypatch: pytest.MonkeyPatch):
    """Claim: a connection that asks again in time stays open, and one whose answers take longer
    than a head may, though it asked for two at once. One that takes far too long ends."""
    monkeypatch.setattr(server, "SLOWEST_HEAD", 0.6)
    running = start(1.0)
    kept = http.client.HTTPConnection("127.0.0.1", running.port, timeout=5)
    for _ in range(5):
        kept.request("GET", "/health")
        assert kept.getresponse().read() == b'{"status":"ok"}'
        port = kept.sock.getsockname()[1]
        time.sleep(0.3)
    assert kept.sock.getsockname()[1] == port
    content = json.dumps(BODY).encode()
    head = b"POST /decide HTTP/1.1\r\nhost: a\r\ncontent-length: %d\r\n\r\n" % len(content)
    with running.connect() as pipelined:
        pipelined.sendall(2 * (head + content))
        answers = b""
        while answers.count(b"milliseconds") < 2 and (piece := pipelined.recv(2**16)):
            answers += piece
    assert answers.count(b"200 OK") == 2
    monkeypatch.setattr(server, "SLOWEST_ANSWER", 0.1)
    with pytest.raises((http.client.RemoteDisconnected, ConnectionError)):
        running.timed("/decide", BODY)


def test_connections_are_limited(start: Callable[..., Service], monkeypatch: pytest.MonkeyPatch):
    """Claim: connections beyond MOST_CONNECTIONS end at once; as others end there is room again."""
    monkeypatch.setattr(server, "MOST_CONNECTIONS", 3)
    running = start()
    connections = [running.connect() for _ in range(3)]
    time.sleep(0.2)
    with pytest.raises((http.client.RemoteDisconnected, ConnectionError)):
        running.timed("/health")
    for connection in connections:
        connection.close()
    time.sleep(0.2)
    assert running.timed("/health")[0] == 200


def test_schema_is_published(start: Callable[..., Service]):
    """Claim: /openapi.json names every path, the fields of both bodies and the statuses of
    refusals. There are no pages of documentation."""
    running = start()
    status, schema, _ = running.timed("/openapi.json")
    assert status == 200
    assert set(schema["paths"]) == {"/decide", "/outcome", "/health", "/version"}
    asked = schema["paths"]["/decide"]["post"]
    fields = asked["requestBody"]["content"]["application/json"]["schema"]["properties"]
    assert set(fields) == set(requests.DecideRequest.model_fields)
    assert {"200", "400", "401", "413", "422", "429", "507"} <= set(asked["responses"])
    assert [running.timed(path)[0] for path in ("/docs", "/redoc")] == [404, 404]


KEYS = ("mask", "top", "distortion", "\ud83d", "x" * 300)


def _mutated(rng: random.Random) -> Any:
    """Returns the body with some parts left out, added or replaced by nonsense."""
    junk = (None, -1, 1e308, 10**30, "", "A" * 9, [], {}, [[]], True, "\ud800", "\0", PNG.hex())
    body = json.loads(json.dumps(BODY))
    places = [body, body["intrinsics"], body["pose"]]
    for _ in range(rng.randint(1, 3)):
        place = rng.choice(places)
        match rng.choice(("drop", "replace", "add")):
            case "drop" if place:
                place.pop(rng.choice(list(place)))
            case "replace" if place:
                place[rng.choice(list(place))] = rng.choice(junk)
            case _:
                place[rng.choice(KEYS)] = rng.choice(junk)
    return body


def test_random_bodies_are_answered(start: Callable[..., Service]):
    """Claim: 300 random changes of a body get a documented status and JSON, never a 500."""
    running, rng = start(), random.Random(0)
    statuses = []
    for _ in range(300):
        body = _mutated(rng)
        status, answer, _ = running.timed("/decide", body)
        assert status in (200, 400, 422), (status, answer, body)
        assert status == 200 or answer["detail"].count("\n") == 0
        statuses.append(status)
    assert set(statuses) == {200, 400, 422}
