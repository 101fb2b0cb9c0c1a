"""A peer's exam, with a simulator of a few lines in the peer's place: a box on a table, which is
lifted if the hand would close on it."""

import json
import sys
import types
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from csac_jax.cli import main
from experiments import index
from experiments.peers import clutter_removal, exam
from experiments.peers.clutter_removal import Peer, View
from experiments.peers.exam import Options, Round

TABLE = 0.05  # m, height of its table
SIZE = np.array([0.10, 0.04, 0.05])  # m, of the box: held across its middle side
LENS = types.SimpleNamespace(width=320, height=240, fx=270.0, fy=270.0, cx=160.0, cy=120.0)
TIPS = 0.0584 + 0.0538 - 0.04  # m, by hand.urdf: joint and finger from the flange, less the centre


class Pose(NamedTuple):
    """Its class of a pose."""

    matrix: np.ndarray

    @classmethod
    def from_matrix(cls, matrix: np.ndarray) -> "Pose":
        return cls(matrix)


class Grasp(NamedTuple):
    """Its class of a grasp."""

    pose: Pose
    width: float


class Camera:
    """Its camera: OpenGL's pixels, whose centres lie half a pixel inside."""

    intrinsic, far = LENS, 2.0

    def __init__(self, sim: "Simulator"):
        self.sim = sim

    def render(self, extrinsic: Pose) -> tuple[np.ndarray, np.ndarray]:
        """Returns colour and depth of table and box, by the rays of its pixels."""
        eye = np.linalg.inv(extrinsic.matrix)
        column, row = np.meshgrid(np.arange(LENS.width) + 0.5, np.arange(LENS.height) + 0.5)
        x, y = (column - LENS.cx) / LENS.fx, (row - LENS.cy) / LENS.fy
        rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ eye[:3, :3].T
        with np.errstate(divide="ignore"):
            depth = (TABLE - eye[2, 3]) / rays[..., 2]
        depth = np.where((depth > 0.0) & (depth < self.far), depth, self.far)
        if self.sim.num_objects:
            turn, half = self.sim.turn, 0.5 * SIZE
            with np.errstate(divide="ignore"):
                ends = (np.array([-half, half]) - (eye[:3, 3] - self.sim.centre) @ turn)[
                    :, None, None
                ]
                first, last = np.sort(ends / (rays @ turn), axis=0)
            hit, leave = first.max(axis=-1), last.min(axis=-1)
            depth = np.where(hit < leave, hit, depth)
        return np.full((*depth.shape, 3), 120, np.uint8), depth.astype(np.float32)


class Simulator:
    """Its simulator, with one box at a place and a yaw that its random numbers give."""

    size = 0.3
    gripper = types.SimpleNamespace(finger_depth=TABLE, max_opening_width=0.08)
    rng: Any

    def __init__(self) -> None:
        self.camera, self.num_objects = Camera(self), 0
        self.grasps: list[tuple[np.ndarray, np.ndarray, np.ndarray, float]] = []

    def reset(self, count: int) -> None:
        self.num_objects = count
        x, y = self.rng.uniform(0.1, 0.2, 2)
        yaw = self.rng.uniform(0.0, np.pi)
        self.centre = np.array([x, y, TABLE + 0.5 * SIZE[2]])
        cos, sin = np.cos(yaw), np.sin(yaw)
        self.turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])

    def execute_grasp(self, grasp: Grasp) -> tuple[int, float]:
        """Lifts the box if both fingers miss it on the way down and then close on it."""
        pose = grasp.pose.matrix
        tips = (pose[:3] @ [0.0, 0.0, TIPS, 1.0] - self.centre) @ self.turn
        closing, ahead = pose[:3, 1] @ self.turn, pose[:3, 2]
        self.grasps.append((tips, closing, ahead, grasp.width))
        beside = abs(closing[1]) > 0.95 and abs(tips[1]) < 0.5 * (grasp.width - SIZE[1])
        held = beside and abs(tips[0]) < 0.5 * SIZE[0] and abs(tips[2]) < 0.5 * SIZE[2]
        lifted = held and ahead[2] < -0.999
        self.num_objects -= int(lifted)
        return int(lifted), 0.0


PEER = Peer(Simulator, Grasp, Pose, "")
ASIDE = ("oblique", "obliquefit")
NOTES = {"clearance": ", tips 4 mm low", **dict.fromkeys(ASIDE, ", oblique")}
HAND = {"gripper": "franka_hand", "opening": "full"}


def _play(policy: str, view: View = "above", noise: float = 0.0, opening: str = "full") -> Any:
    sim = Simulator()
    decide = exam.decider(policy, sim, HAND | {"opening": opening})
    options = Options(view, noise, objects=1, rounds=4, seed=2)
    return [exam.play(PEER, sim, decide, options, number) for number in range(4)], sim


@pytest.mark.parametrize(("view", "noise"), [("above", 0.0), ("oblique", 0.0008)])
def test_decisions_arrive_where_the_image_shows_the_object(view: View, noise: float):
    """Claim: through either camera the geometric policy grasps a box at its middle, across, 35 mm
    below its top and at most as wide as the hand; all are lifted."""
    rounds, sim = _play("geometric", view, noise)
    assert [one.lifted for one in rounds] == [1] * 4
    for tips, closing, ahead, width in sim.grasps:
        assert abs(tips[1]) < 0.008
        assert abs(tips[0]) < 0.03
        assert tips[2] == pytest.approx(0.5 * SIZE[2] - 0.035, abs=0.002)
        assert abs(closing[1]) > 0.97
        np.testing.assert_allclose(ahead, [0.0, 0.0, -1.0], atol=1e-6)
        assert width == pytest.approx(0.08)


def test_random_is_worse_and_rounds_do_not_depend_on_the_policy():
    """Claim: a round ends with the second failure in a row; each policy meets the same box."""
    rounds, sim = _play("random")
    assert sum(one.lifted for one in rounds) < 4
    assert all(one.tried <= 2 for one in rounds)
    assert len(sim.grasps) == sum(one.tried for one in rounds)
    blind = Simulator()
    exam.play(PEER, blind, lambda *_: None, Options("above", 0.0, 1, 4, 2), 3)
    np.testing.assert_array_equal(blind.centre, sim.centre)


def test_shares_are_those_of_the_protocol():
    """Claim: GSR is lifted over tried, DR lifted over presented, each over all rounds."""
    found = exam.summarise([Round(5, 6, 4), Round(3, 2, 0, unseen=1), Round(4, 4, 4)])
    assert found["grasp_success"]["value"] == pytest.approx(8 / 12)
    assert found["declutter_rate"]["value"] == pytest.approx(8 / 12)
    assert found["declutter_rate"]["low"] < 8 / 12 < found["declutter_rate"]["high"]
    ends = {"unseen": 1, "refused": 0}
    assert found["counts"] == {"rounds": 3, "presented": 12, "tried": 12, "lifted": 8, **ends}


def test_page_has_the_recorded_shares():
    """Claim: the page's table of the exam is the record of `shipped` and of the baselines: lifted /
    taken of scenes and openings."""
    shares: dict[str, dict[str, str]] = {}
    for name, record in json.loads((index.RESULTS / "bench" / "peers.json").read_text()).items():
        scene, kind = name.split("-")
        for row in record["rows"]:
            values = [100 * row[one]["value"] for one in ("grasp_success", "declutter_rate")]
            policy = row["policy"]
            if policy not in ("shipped", *exam.BASELINES):
                continue
            cells = shares.setdefault(f"`{policy}`{NOTES.get(kind, '')}", {})
            cells[f"{scene} {row['opening']}"] = "{:.1f}/{:.1f}".format(*values)
    columns = ("pile full", "pile fit", "packed full", "packed fit")
    rows = {head: [cells.get(one, "") for one in columns] for head, cells in shares.items()}
    page = (index.ROOT / "docs" / "benchmarks" / "policies.md").read_text()
    table = page.split("| packed, fitted |\n")[1].split("\n\n")[0].splitlines()[1:]
    assert {head: cells for head, *cells in map(_cells, table)} == rows


def _cells(row: str) -> list[str]:
    return [cell.strip() for cell in row.strip("|").split("|")]


def test_what_is_missing_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """Claim: without a clone, or without PyBullet, the exam ends by one line and exit code 2."""
    assert main(["bench", "peers", str(tmp_path)]) == 2
    assert "is no clone of Edge-Grasp-Network: it has no simulator/" in _line(capsys)
    path = tmp_path / clutter_removal.SIMULATOR
    path.parent.mkdir()
    path.write_text("import pybullet")
    monkeypatch.setitem(sys.modules, "pybullet", None)
    before = {*sys.modules}
    assert main(["bench", "peers", str(tmp_path)]) == 2
    assert _line(capsys).endswith("needs pybullet: pip install pybullet")
    assert not {*sys.modules} - before & {*clutter_removal.UNUSED}


def _line(capsys: pytest.CaptureFixture[str]) -> str:
    out, err = capsys.readouterr()
    assert out == ""
    (line,) = err.splitlines()
    return line
