"""The exam of a peer: its shares, its page, and what is missing."""

import json
import sys
from pathlib import Path

import pytest

from csac_jax.cli import main
from experiments import index
from experiments.peers import clutter_removal, exam
from experiments.peers.exam import Round

ASIDE = ("oblique", "obliquefit", "generaloblique")
NOTES = {"clearance": ", tips 4 mm low", **dict.fromkeys(ASIDE, ", oblique")}


def test_shares_are_those_of_the_protocol():
    """Claim: GSR is lifted over tried, DR lifted over presented, each over all rounds."""
    found = exam.summarise([Round(5, 6, 4), Round(3, 2, 0, unseen=1), Round(4, 4, 4)])
    assert found["grasp_success"]["value"] == pytest.approx(8 / 12)
    assert found["declutter_rate"]["value"] == pytest.approx(8 / 12)
    assert found["declutter_rate"]["low"] < 8 / 12 < found["declutter_rate"]["high"]
    ends = {"unseen": 1, "refused": 0}
    assert found["counts"] == {"rounds": 3, "presented": 12, "tried": 12, "lifted": 8, **ends}


def test_page_has_the_recorded_shares():
    """Claim: the page's table of the exam is the record of `shipped`, which it calls by its former
    name, and of the baselines: lifted / taken of scenes and openings."""
    shares: dict[str, dict[str, str]] = {}
    for name, record in json.loads((index.RESULTS / "bench" / "peers.json").read_text()).items():
        scene, kind = name.split("-")
        for row in record["rows"]:
            values = [100 * row[one]["value"] for one in ("grasp_success", "declutter_rate")]
            policy = row["policy"].removesuffix("_general")
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
