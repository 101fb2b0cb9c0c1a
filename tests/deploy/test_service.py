"""The HTTP service, on a real socket: decisions, refusals, many clients."""

import base64
import concurrent.futures
import contextlib
import http.client
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from csac_jax.deploy import CameraPolicy, record
from csac_jax.deploy.image_files import encode
from csac_jax.deploy.record import Recorder
from tests.deploy import image_files, scenes

pytest.importorskip("uvicorn")
pytest.importorskip("fastapi")

from csac_jax.deploy import batching, decider, service  # isort: skip
from tests.deploy.running import TOKEN, Running  # isort: skip

IMAGE = image_files.rounded(scenes.take(scenes.blocks_at([[0.1, 0.09, 0.4], [-0.1, -0.09, 1.0]])))
CLIENTS = 50


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()


PNG = encode(IMAGE.rgb)
HUGE = image_files.png_start((9000, 9000))
TWICE = image_files.png_start((640, 480), (4000, 4000))
BODY: dict[str, Any] = {
    "rgb": _base64(PNG),
    "depth": _base64(encode(np.round(1000 * IMAGE.depth).astype(np.uint16))),
    "intrinsics": IMAGE.intrinsics,
    "pose": {"matrix": IMAGE.pose.tolist()},
}


@pytest.fixture(scope="module")
def policy(tiny: str) -> CameraPolicy:
    loaded = CameraPolicy.load(tiny)
    loaded.warm_up(640, 480, decider.batches())
    return loaded


@pytest.fixture(scope="module", name="server")
def _server(policy: CameraPolicy) -> Iterator[Running]:
    running = Running(service.make(policy, "tiny", TOKEN))
    yield running
    running.stop()


@pytest.fixture
def recording(policy: CameraPolicy, tmp_path: Path) -> Iterator[Running]:
    """Starts a service that records into the test's folder."""
    running = Running(service.make(policy, "tiny", TOKEN, Recorder(tmp_path, "tiny")))
    yield running
    running.stop()


def test_records_images_decisions_and_outcomes(recording: Running, tmp_path: Path):
    """Claim: with a record, /decide names an entry, which holds what was sent and answered, and
    /outcome adds to it, with and without a mask."""
    mask = np.zeros((480, 640), np.uint8)
    mask[:, 320:] = 255
    _, first = recording.ask("/decide", {**BODY, "top": 2})
    marked = {**BODY, "mask": _base64(encode(mask))}
    _, second = recording.ask("/decide", marked)
    assert [first["id"], second["id"]] == ["000001", "000002"]
    assert second["decisions"][0]["position"][1] < -0.03  # the block at y = -0.09
    outcome = {"id": "000001", "outcome": "dropped", "number": 2.0, "ended": True}
    assert recording.ask("/outcome", outcome) == (200, {"id": "000001"})
    one, two = record.read(tmp_path)
    assert one.outcome == record.ReportedOutcome(outcome="dropped", number=2, ended=True)
    assert two.outcome is None
    assert one.decisions == first["decisions"]
    np.testing.assert_array_equal(two.image[4], mask > 0)
    for entry in (one, two):
        for stored, sent in zip(entry.image[:2], IMAGE[:2], strict=True):
            np.testing.assert_array_equal(stored, sent)
        np.testing.assert_array_equal(entry.image[3], IMAGE.pose)


@pytest.mark.parametrize(
    ("body", "status", "detail"),
    [
        ({"id": "../../etc", "outcome": "lifted"}, 404, "there is no decision ../../etc"),
        ({"id": "1" * 256, "outcome": "lifted"}, 404, "there is no decision 1111"),
        ({"id": "000001", "outcome": "good"}, 422, "'outcome' should be 'nothing'"),
        ({"id": "000001", "outcome": "lifted", "number": "1"}, 422, "'number' should be"),
        ({"id": "000001", "outcome": "pushed"}, 400, "outcome: of a grasp it is nothing, empty"),
        ({"id": "000001", "outcome": "lifted", "number": 3}, 400, "there are 1 decisions, not 3"),
    ],
)
def test_bad_outcomes_are_refused(
    recording: Running, tmp_path: Path, body: Any, status: int, detail: str
):
    """Claim: an outcome that fits no decision gets a status of 400 to 499 and one line, and changes
    nothing."""
    assert recording.ask("/decide", BODY)[0] == 200
    found, answer = recording.ask("/outcome", body)
    assert found == status, answer
    assert detail in answer["detail"]
    assert record.read(tmp_path)[0].outcome is None


def test_full_disc_is_told(recording: Running, monkeypatch: pytest.MonkeyPatch):
    """Claim: a decision that cannot be recorded is not answered as if it were."""

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Recorder, "add", full)
    status, answer = recording.ask("/decide", BODY)
    assert status == 507
    assert "No space left on device" in answer["detail"]


def test_decides_as_the_library(server: Running, policy: CameraPolicy):
    """Claim: /decide answers what `CameraPolicy.decide` returns; without a record there is no id,
    and no outcome is taken. Colours that seem to be swapped are warned of."""
    status, answer = server.ask("/decide", {**BODY, "top": 2})
    assert status == 200
    for found, decision in zip(answer["decisions"], policy.decide(*IMAGE, top=2), strict=True):
        assert found["primitive"] == decision.primitive
        np.testing.assert_allclose(found["position"], decision.position, atol=1e-4)
    assert (answer["warnings"], answer["id"]) == ([], None)
    assert answer["milliseconds"] > 0
    status, answer = server.ask("/outcome", {"id": "000001", "outcome": "lifted"})
    assert status == 404
    assert "the service records nothing" in answer["detail"]
    swapped = {**BODY, "rgb": _base64(encode(IMAGE.rgb[..., ::-1]))}
    _, answer = server.ask("/decide", swapped)
    assert "red and blue seem to be swapped" in answer["warnings"][0]


def test_health_and_version(server: Running):
    """Claim: /health needs no token; /version names policy and versions."""
    assert server.ask("/health", token="") == (200, {"status": "ok"})
    status, answer = server.ask("/version")
    assert (status, answer["policy"]) == (200, "tiny")
    assert {"python", "jax", "csac-jax"} <= set(answer["versions"])


@pytest.mark.parametrize("token", ["", TOKEN[:-1], TOKEN + "x"])
@pytest.mark.parametrize("path", ["/decide", "/outcome", "/version"])
def test_token_is_asked_for(server: Running, path: str, token: str):
    """Claim: without the token nothing is decided or told."""
    status, answer = server.ask(path, None if path == "/version" else BODY, token)
    assert status == 401
    assert "Authorization" in answer["detail"]


@pytest.mark.parametrize(
    ("body", "status", "detail"),
    [
        (b"", 422, "Invalid JSON"),
        (b"{", 422, "Invalid JSON"),
        (b"\xff\xfe\x00", 422, ""),
        ({}, 422, "'rgb' is missing"),
        ({**BODY, "speed": 1}, 422, "'speed' is unknown"),
        ({**BODY, "top": 1000}, 400, "top: must lie in 1 .. 64, not 1000"),
        ({**BODY, "rgb": "%%%"}, 400, "rgb: must be a PNG in base64"),
        ({**BODY, "rgb": _base64(b"GIF89a" * 9)}, 400, "rgb: must be a PNG"),
        ({**BODY, "rgb": _base64(HUGE)}, 400, "rgb: has 9000 x 9000 px; at most 4,194,304"),
        ({**BODY, "rgb": _base64(PNG[:3000])}, 400, "the image is damaged"),
        ({**BODY, "rgb": _base64(TWICE)}, 400, "rgb: has 4000 x 4000 px; at most 4,194,304"),
        ({**BODY, "depth": BODY["rgb"]}, 400, "depth: is uint8; give a PNG of 16 bits"),
        ({**BODY, "intrinsics": {"fx": 1}}, 400, "intrinsics: 'width' is missing"),
        ({**BODY, "pose": {"matrix": [[1.0]]}}, 400, "camera_pose: must be a 4 x 4 matrix"),
        ({**BODY, "pose": {"matrix": np.eye(4).tolist()}}, 422, "camera_pose: the workspace's cen"),
        (b'{"rgb": ' + b"[" * 100_000, 400, "the body has more than 1000 keys and values"),
        (b" " * (16 * 2**20 + 1), 413, "the body is larger than 16384 KiB"),
    ],
    ids=lambda value: value if isinstance(value, int) else "",
)
def test_bad_requests_are_refused(server: Running, body: Any, status: int, detail: str):
    """Claim: a malformed or oversized request gets a status of 400 to 499 and one line, and the
    service goes on."""
    found, answer = server.ask("/decide", body)
    assert found == status, answer
    assert detail in answer["detail"]
    assert len(answer["detail"]) < 400
    assert server.ask("/health") == (200, {"status": "ok"})


@pytest.mark.slow
def test_answers_are_those_of_the_schema(server: Running, tmp_path: Path):
    """Claim: of the requests that schemathesis makes of the schema, good and bad ones, all get an
    answer that the schema has. That bytes are a whole PNG no schema can say."""
    pytest.importorskip("schemathesis")
    run = "from schemathesis.cli import schemathesis; schemathesis()"
    options = ["-H", f"Authorization: Bearer {TOKEN}", "--checks", "all", "--seed", "0"]
    options += ["--exclude-checks", "positive_data_acceptance"]
    where = f"http://127.0.0.1:{server.port}/openapi.json"
    command = [sys.executable, "-c", run, "run", where, *options]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("token", [TOKEN, "wrong"])
def test_body_without_a_length_is_limited(server: Running, token: str):
    """Claim: a chunked body that never ends is cut off."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
    connection.putrequest("POST", "/decide")
    connection.putheader("Authorization", f"Bearer {token}")
    connection.putheader("Transfer-Encoding", "chunked")
    connection.endheaders()
    piece = b"%x\r\n" % 2**20 + b" " * 2**20 + b"\r\n"
    sent = 0
    with contextlib.suppress(OSError):  # it hangs up
        while sent < 300:
            connection.send(piece)
            sent += 1
    assert sent < 300
    assert server.ask("/health") == (200, {"status": "ok"})


def test_many_clients_lose_nothing(server: Running, monkeypatch: pytest.MonkeyPatch):
    """Claim: 50 clients that may wait, each with its own `top`, all get their own answer."""
    monkeypatch.setattr(batching, "LONGEST", 1e9)
    tops = [1 + number % 3 for number in range(CLIENTS)]
    with concurrent.futures.ThreadPoolExecutor(CLIENTS) as pool:
        asked = [pool.submit(server.ask, "/decide", {**BODY, "top": n}) for n in tops]
        answers = [future.result() for future in asked]
    assert [status for status, _ in answers] == [200] * CLIENTS
    assert [len(answer["decisions"]) for _, answer in answers] == tops
