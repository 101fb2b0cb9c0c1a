"""`csac-jax play` from the arguments to the files, with our rays."""

import json
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest

from csac_jax import cli
from csac_jax.cli import play
from csac_jax.render import episode, gl

pytestmark = pytest.mark.mjx

PLACE = {"position": [0.05, 0.0, 0.025], "quaternion": [1, 0, 0, 0]}
CUBE = {"shape": "cube", "colour": "red", **PLACE}


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A folder with the case of one cube, on a machine with no OpenGL."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(gl, "choose", lambda: None)
    (tmp_path / "cube.json").write_text(json.dumps({"name": "cube", "blocks": [CUBE]}))
    return tmp_path


def test_episode_of_one_block(here: Path, capsys: pytest.CaptureFixture):
    """Claim: without OpenGL, the planner takes a cube: lines, picture, whole video, JSON."""
    files = ["--png", "a/b.png", "--video", "a/b.mp4", "--json", "a/b.json"]
    assert cli.main(["play", "--scene", "cube.json", "--size", "96", "64", *files]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2
    assert "grasp at x " in lines[0]
    assert "lifted (red); reward +1.00; 0 blocks left" in lines[0]
    assert lines[1] == "the table is clear after 1 action: 1 block taken"
    result = json.loads((here / "a" / "b.json").read_text())
    wanted = {"actions": 1, "cleared": 1, "completed": True, "renderer": "rays", "blocks_lost": 0}
    assert result == result | wanted
    # 4 ms a substep, 25 a second
    assert imageio_ffmpeg.count_frames_and_secs("a/b.mp4")[0] == 1 + 190 // 10 + episode.HOLD
    frames = imageio_ffmpeg.read_frames("a/b.mp4")
    width, height = next(frames)["size"]
    assert (width, height) == (96 + 56, 64 + 4)  # the height map to the right, text below
    flat = (np.frombuffer(frame, np.uint8) for frame in frames)
    pictures = [frame.reshape(height, width, 3)[:64, :96] for frame in flat]
    red = [np.argwhere(_is_red(image)) for image in pictures]
    row = [places[:, 0].mean() for places in red]
    assert row[-1] < row[0] - 5  # the cube is seen to rise


def _is_red(image: np.ndarray) -> np.ndarray:
    return image[..., 0] > 40 + image[..., 1:].max(axis=2).astype(int)


@pytest.mark.parametrize(("scene", "kind"), [("enclosed", "target"), ("blocked", "clear")])
def test_policies_without_networks_have_the_task_of_the_scene(scene: str, kind: str):
    """Claim: the planner gets the marked block in a suite that marks one, else it clears."""
    policy = play._policy(play.PlayOptions(scene=scene, policy="planner"))
    assert policy.cfg.task.kind == kind
