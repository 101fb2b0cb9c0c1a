"""The record of images, decisions and outcomes: what is read is what was seen and done."""

import concurrent.futures
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from csac_jax.deploy import record
from csac_jax.deploy.decision import Decision
from csac_jax.deploy.record import Recorder, ReportedOutcome
from csac_jax.errors import SettingsError
from csac_jax.io import files

RNG = np.random.default_rng(0)
LENS = {"width": 64, "height": 48, "fx": 60.0, "fy": 61.0, "cx": 31.5, "cy": 23.5}
POSE = np.array([[0, -1, 0, 0.1], [-1, 0, 0, 0.2], [0, 0, -1, 0.7], [0, 0, 0, 1]], float)
GRASP = Decision("grasp", (0.01, -0.02, 0.03), 0.4, 0.11, 1.9, ())
PUSH = Decision("push", (0.1, 0.2, 0.03), 5.4, 0.0, 0.9, ())


def _image(mask: bool = False) -> record.Image:
    """Draws an image with holes in its depth."""
    depth = RNG.uniform(0.5, 0.9, (48, 64)).astype(np.float32)
    depth[3:5, 7], depth[8, 9] = np.nan, 0.0
    rgb = RNG.integers(0, 256, (48, 64, 3), np.uint8)
    return rgb, depth, LENS, POSE, RNG.random((48, 64)) > 0.5 if mask else None


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A record of two entries, of which the first has an outcome."""
    recorder = Recorder(tmp_path / "record", "shipped")
    recorder.add(_image(), [GRASP, PUSH])
    recorder.add(_image(mask=True), [PUSH])
    recorder.post("000001", ReportedOutcome(outcome="dropped"))
    return tmp_path / "record"


@pytest.mark.parametrize("mask", [False, True])
def test_what_is_read_is_what_was_given(tmp_path: Path, mask: bool):
    """Claim: colours, depths, lens, pose and mask come back bit for bit, decisions with them."""
    given = _image(mask)
    name = Recorder(tmp_path, "mine").add(given, [GRASP, PUSH])
    (entry,) = record.read(tmp_path)
    assert entry.path.name == name == "000001"
    rgb, depth, lens, pose, marked = entry.image
    np.testing.assert_array_equal(rgb, given[0])
    np.testing.assert_array_equal(depth, given[1])
    assert [getattr(lens, key) for key in LENS] == list(LENS.values())
    np.testing.assert_array_equal(pose, POSE)
    assert marked is None if given[4] is None else np.array_equal(marked, given[4])
    assert entry.decisions == json.loads(json.dumps([GRASP.to_dict(), PUSH.to_dict()]))
    assert entry.outcome is None
    assert json.loads((tmp_path / name / "decision.json").read_text())["policy"] == "mine"


def test_outcome_names_what_was_done(folder: Path):
    """Claim: an outcome chooses the decision that was carried out; a later one takes its place."""
    first, second = record.read(folder)
    assert first.outcome == ReportedOutcome(outcome="dropped")
    assert first.action == ("grasp", [0.01, -0.02, 0.4])
    assert second.outcome is None
    later = ReportedOutcome(outcome="pushed", number=2, ended=True)
    Recorder(folder, "shipped").post("000001", later)
    first, _ = record.read(folder)
    assert first.outcome == later
    assert first.action == ("push", [0.1, 0.2, 5.4])


def test_recorders_side_by_side_lose_nothing(tmp_path: Path):
    """Claim: entries of several recorders at once get different numbers, none is lost or mixed."""
    given = [_image() for _ in range(24)]
    recorders = [Recorder(tmp_path, str(number)) for number in range(4)]
    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        added = [pool.submit(recorders[i % 4].add, one, [GRASP]) for i, one in enumerate(given)]
        names = [future.result() for future in added]
    assert sorted(names) == [f"{number:06d}" for number in range(1, 25)]
    for name, one in zip(names, given, strict=True):
        np.testing.assert_array_equal(record.read(tmp_path)[int(name) - 1].image[0], one[0])


def test_full_disc_leaves_no_half_entry(folder: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: an entry that cannot be written whole is not there; the next one is."""
    write = files.replace

    def full(path: Path, content: object) -> None:
        if path.name == "intrinsics.json":
            raise OSError(28, "No space left on device")
        write(path, content)

    recorder = Recorder(folder, "shipped")
    with monkeypatch.context() as broken:
        broken.setattr(files, "replace", full)
        with pytest.raises(OSError, match="No space"):
            recorder.add(_image(), [GRASP])
    assert sorted(path.name for path in folder.iterdir()) == ["000001", "000002", "record.json"]
    assert recorder.add(_image(), [GRASP]) == "000003"


def test_new_entries_come_last(folder: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: an entry gets the number after the last one, so that the order is that of time; an
    entry that another process has just made stays."""
    before, recorder = record.read(folder), Recorder(folder, "shipped")
    with monkeypatch.context() as blind:
        blind.setattr(record, "is_name", lambda name: False)  # none is seen yet
        assert recorder.add(_image(), [GRASP]) == "000003"
    assert record.read(folder)[:2] == before
    for name in ("000001", "000002"):
        shutil.rmtree(folder / name)
    assert recorder.add(_image(), [GRASP]) == "000004"


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("record.json", None, "is no record: it has no record.json"),
        ("record.json", '{"format": 2}', "format 2 is unknown, this version reads 1; update"),
        ("000001/decision.json", '{"decisions": [{"prim', "000001/decision.json: Invalid JSON"),
        ("000001/outcome.json", '{"outcome": "good"}', "json: 'outcome' should be 'nothing'"),
        ("000001/outcome.json", '{"outcome": "lifted", "number": 0}', "'number' should be greater"),
    ],
)
def test_damaged_records_are_refused(folder: Path, file: str, content: str | None, message: str):
    """Claim: what is wrong with a record is one line that names the file."""
    (folder / file).unlink()
    if content is not None:
        (folder / file).write_text(content)
    with pytest.raises(SettingsError, match=message) as found:
        record.read(folder)
    assert "\n" not in str(found.value)
