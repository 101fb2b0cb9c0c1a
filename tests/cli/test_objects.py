"""`csac-jax objects`: what it writes and what it refuses, in one line."""

import dataclasses
import json
from pathlib import Path

import imageio.v2 as imageio
import pytest

from csac_jax import cli, grippers
from csac_jax.objects import importing, library

Capture = pytest.CaptureFixture[str]


def test_make_and_show(tmp_path: Path, capsys: Capture):
    """Claim: `make` writes a library, `show` lists it and draws a sheet; both write JSON."""
    lib, png, out = tmp_path / "new" / "lib", tmp_path / "sheet.png", tmp_path / "list.json"
    assert cli.main(["objects", "make", "--count", "14", "--out", str(lib)]) == 0
    assert len(library.load(lib).objects) == 14
    assert "14 objects, " in capsys.readouterr().out
    assert cli.main(["objects", "show", str(lib), "--png", str(png), "--json", str(out)]) == 0
    picture = imageio.imread(png)
    assert picture.shape[1] > picture.shape[0] > 100
    assert picture.std() > 5
    rows = json.loads(out.read_text())["objects"]
    assert rows[0]["name"] == "bottle-0-0"
    assert len(rows[0]["size_mm"]) == 3
    mixed = tmp_path / "mixed"
    assert cli.main(["objects", "make", "--mixed", "--count", "4", "--out", str(mixed)]) == 0
    names = [member.name for member in library.load(mixed).objects]
    assert names == ["bottle-0-0", "assembly-0-0", "bowl-0-1", "assembly-0-1"]


def test_what_is_too_wide_is_named(monkeypatch: pytest.MonkeyPatch, capsys: Capture):
    """Claim: objects that the hand cannot open for are named."""
    narrow = dataclasses.replace(grippers.load("rg2"), opening=(0.0, 0.03))
    monkeypatch.setattr(grippers, "load", lambda name: narrow)
    assert cli.main(["objects", "show", "procedural:0:14"]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("wider than the hand opens, 30 mm: ")


def test_without_the_extra_the_command_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
):
    """Claim: `import` without its extra names the command that installs it."""
    monkeypatch.setattr(importing, "MODULES", ("no_such_module",))
    assert cli.main(["objects", "import", str(tmp_path), "--out", str(tmp_path / "x")]) == 2
    assert "pip install 'csac-jax[objects]'" in capsys.readouterr().err
