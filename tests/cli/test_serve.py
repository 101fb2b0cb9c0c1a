"""`csac-jax serve`: a real process, its port, its address on stdout, and SIGTERM."""

import concurrent.futures
import json
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

from csac_jax import cli
from csac_jax.cli.robot_options import RobotOptions
from examples import camera_image

pytest.importorskip("uvicorn")
pytest.importorskip("fastapi")

TOKEN = "correct horse battery"


def test_taken_port_is_told_first(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    """Claim: a port that is taken, and an address of another host, are one line and exit code 1,
    before the policy is loaded."""

    def fail(_: RobotOptions) -> None:
        raise AssertionError("it is loaded")

    monkeypatch.setattr(RobotOptions, "load", fail)
    (tmp_path / "token").write_text(TOKEN)
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = str(other.getsockname()[1])
        assert cli.main(["serve", "shipped", "--port", port]) == 1
    error = capsys.readouterr().err
    assert error == (
        f"csac-jax: 127.0.0.1:{port}: Address already in use; give another --port or --host\n"
    )
    options = ["--host", "192.0.2.1", "--port", port, "--token-file", str(tmp_path / "token")]
    assert cli.main(["serve", "shipped", *options]) == 1
    assert capsys.readouterr().err.startswith(f"csac-jax: 192.0.2.1:{port}: Cannot assign")


@pytest.mark.skipif(shutil.which("curl") is None, reason="needs curl")
def test_serves_until_it_is_stopped(tmp_path: Path):
    """Claim: the command prints its address and a call that works as printed. After SIGTERM it
    answers what it has accepted, and ends within 10 s."""
    token = tmp_path / "a token"
    token.write_text(f"{TOKEN}\n")
    camera_image.main(str(tmp_path))
    options = ["--port", "0", "--token-file", str(token)]
    command = [sys.executable, "-m", "csac_jax", "serve", "shipped", *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        where, call = process.stdout.readline(), process.stdout.readline()
        url = where.split()[2].rstrip(";")
        assert "/decide" in json.load(urllib.request.urlopen(f"{url}/openapi.json"))["paths"]
        shown = call.removeprefix("try: ").strip()
        assert shlex.split(shown)[-2:] == ["@request.json", f"{url}/decide"]
        done = subprocess.run(shown, shell=True, cwd=tmp_path, capture_output=True, text=True)
        assert len(json.loads(done.stdout)["decisions"]) == 1, done.stderr
        with concurrent.futures.ThreadPoolExecutor(10) as pool:
            content = (tmp_path / "request.json").read_bytes()
            head = {"Authorization": f"Bearer {TOKEN}"}
            request = urllib.request.Request(f"{url}/decide", content, head)
            asked = [pool.submit(urllib.request.urlopen, request) for _ in range(10)]
            time.sleep(0.3)
            begun = time.perf_counter()
            process.send_signal(signal.SIGTERM)
            assert [future.result().status for future in asked] == [200] * 10
        assert process.wait(10) == -signal.SIGTERM
        assert time.perf_counter() - begun < 10.0
    finally:
        process.kill()
        process.wait()
