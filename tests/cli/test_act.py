"""`csac-jax act`: files in, decisions out as text, JSON and picture; bad files are one line."""

import json
import re
import subprocess
import sys
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest

from csac_jax import cli
from csac_jax.config import CameraConfig
from csac_jax.deploy import CameraPolicy
from csac_jax.deploy.image_files import encode
from tests.deploy import image_files, scenes

POSES = np.array([[0.1, 0.09, 0.4], [-0.1, -0.09, 1.0]])
IMAGE = image_files.rounded(scenes.take(scenes.blocks_at(POSES)))
EMPTY = scenes.take(scenes.blocks_at([[3.0, 3.0, 0.0]]))


@pytest.fixture
def given(tiny: str, tmp_path: Path) -> list[str]:
    """The policy and the files of an image of two blocks."""
    return [tiny, *image_files.write(tmp_path, IMAGE)]


def test_decides(given: list[str], tmp_path: Path, capsys: pytest.CaptureFixture):
    """Claim: the command prints and writes what `CameraPolicy.decide` returns, and draws it. An
    empty table is no failure: no decision, and a picture that says so."""
    files = ["--json", str(tmp_path / "out.json"), "--png", str(tmp_path / "out.png")]
    assert cli.main(["act", *given, "--top", "2", *files]) == 0
    printed = capsys.readouterr()
    assert "trained with view maps from above, not noisy images of an obl" in printed.err
    lines = printed.out.splitlines()
    result = json.loads((tmp_path / "out.json").read_text())
    wanted = CameraPolicy.load(given[0]).decide(*IMAGE, top=2)
    assert len(lines) == len(result["decisions"]) == 2
    for line, found, decision in zip(lines, result["decisions"], wanted, strict=True):
        assert f"{decision.primitive} at x {found['position'][0]:+.3f}" in line
        np.testing.assert_allclose(found["position"], decision.position, atol=1e-4)
        assert found["primitive"] == decision.primitive
    assert {"device", "versions", "commit", "config"} <= set(result)
    assert imageio.imread(tmp_path / "out.png").shape == (640, 1248, 3)
    (tmp_path / "out.png").unlink()
    empty = image_files.write(tmp_path / "empty", EMPTY)
    assert cli.main(["act", given[0], *empty, *files[2:]]) == 0
    assert capsys.readouterr().out == "nothing to act on\n"
    assert (tmp_path / "out.png").stat().st_size > 10_000


def test_mask_and_workspace(given: list[str], tmp_path: Path):
    """Claim: --mask chooses the object: each half of the image has its own block. --workspace is
    where the tool's poses are counted from; positions stay."""
    workspace = np.eye(4)
    workspace[2, 3] = 0.3
    (tmp_path / "w.json").write_text(json.dumps({"matrix": workspace.tolist()}))
    options = ["--mask", "mask.png", "--workspace", "w.json", "--json", "o.json"]
    files = [str(tmp_path / option) if "." in option else option for option in options]
    for block, keep in enumerate((np.s_[:, :320], np.s_[:, 320:])):
        mask = np.zeros((480, 640), np.uint8)
        mask[keep] = 255
        imageio.imwrite(tmp_path / "mask.png", mask)
        assert cli.main(["act", *given, *files]) == 0
        (decision,) = json.loads((tmp_path / "o.json").read_text())["decisions"]
        place = decision["position"]
        assert np.linalg.norm(POSES[:, :2] - place[:2], axis=1).argmin() == block
        tool = np.array(decision["waypoints"][1]["tool"])
        np.testing.assert_allclose(tool[:3, 3], np.add(place, [0.0, 0.0, 0.3]), atol=1e-6)


def test_record_decides_the_same(given: list[str], tmp_path: Path, capsys: pytest.CaptureFixture):
    """Claim: --record keeps an image whose files are those of the command, depth as an .npy of
    metres: it decides on them as before. Images that are refused are not kept."""
    record, out = tmp_path / "record", tmp_path / "out.json"
    assert cli.main(["act", *given, "--record", str(record), "--json", str(out)]) == 0
    first, line = capsys.readouterr().out.splitlines()
    assert line == f"recorded as {record}/000001"
    assert json.loads(out.read_text())["id"] == "000001"
    names = ("rgb.png", "depth.npy", "intrinsics.json", "pose.json")
    paths = [record / "000001" / name for name in names]
    files = [part for path in paths for part in (f"--{path.stem}", str(path))]
    assert cli.main(["act", given[0], *files]) == 0
    assert capsys.readouterr().out.splitlines() == [first]
    depth = imageio.imread(tmp_path / "depth.png")
    imageio.imwrite(tmp_path / "depth.png", (10 * depth.clip(0, 6000)).astype(np.uint16))
    assert cli.main(["act", *given, "--record", str(record)]) == 1
    assert "multiply it by 0.1" in capsys.readouterr().err
    assert sorted(path.name for path in record.iterdir()) == ["000001", "record.json"]


def test_check_of_the_empty_table(tiny: str, tmp_path: Path, capsys: pytest.CaptureFixture):
    """Claim: --check accepts a right pose; it refuses one that is 2 cm off, a table with blocks,
    and a camera that sees too little, each by one line."""
    low = EMPTY.pose + np.diag([0, 0, 0.02], 1)
    aside = CameraConfig(focal=(900.0, 900.0), look_at=(0.0, 0.15, 0.0))
    beside = scenes.take(scenes.blocks_at([[3.0, 3.0, 0.0]]), aside)
    for image, code, line in (
        (EMPTY, 0, "pose and intrinsics fit"),
        (EMPTY._replace(pose=low), 1, "the table is not at z = 0"),
        (IMAGE, 1, "the table is not empty"),
        (beside, 1, "too little of the workspace is seen"),
    ):
        options, json_file = image_files.write(tmp_path, image), tmp_path / "report.json"
        assert cli.main(["act", tiny, *options, "--check", "--json", str(json_file)]) == code
        captured = capsys.readouterr()
        assert line in captured.out + captured.err
        assert re.search(r"^table +[-+]\d+\.\d mm from z = 0, tilted by", captured.out)
        assert bool(json.loads(json_file.read_text())["faults"]) == bool(code)


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("rgb.png", None, "there is no file"),
        ("rgb.png", encode(IMAGE.rgb[::2, ::2]), "rgb 320 x 240, depth 640 x 480"),
        ("depth.png", encode(IMAGE.rgb[..., 0]), "depth.png: depth: is uint8; give a PNG"),
        ("pose.json", b"1 0 0 0", "pose.json: Invalid JSON"),
    ],
)
def test_bad_files_are_one_line(
    given: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture,
    file: str,
    content: bytes | None,
    message: str,
):
    """Claim: what is wrong with a file is one line that names it."""
    (tmp_path / file).unlink()
    if content is not None:
        (tmp_path / file).write_bytes(content)
    assert cli.main(["act", *given]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert message in captured.err


def test_command_needs_no_mujoco(given: list[str], tmp_path: Path):
    """Claim: the command decides, draws and writes without MuJoCo installed; a run's folder, which
    needs it, gets one line."""
    start = "import sys; sys.modules['mujoco'] = None; from csac_jax import cli; "
    files = ["--json", str(tmp_path / "o.json"), "--png", str(tmp_path / "o.png")]
    command = [sys.executable, "-c", f"{start}sys.exit(cli.main())", "act", *given, *files]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert " 1 grasp at x " in done.stdout
    command[4] = str(tmp_path)
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "needs mujoco" in done.stderr
