"""Every Python block of README and docs runs."""

import re
import runpy
import shlex
from pathlib import Path

import pytest

import csac_jax
from csac_jax import cli, presets

ROOT = Path(csac_jax.__file__).parents[1]
# Their commands make the files of their blocks.
ROBOT, OBJECTS = (ROOT / "docs" / name for name in ("robot.md", "objects.md"))
PAGES = [
    page
    for page in (ROOT / "README.md", *ROOT.glob("docs/**/*.md"))
    if "```python" in page.read_text() and page not in (ROBOT, OBJECTS)
]
NUMBERS = re.compile(r"\b(episodes|seeds)\s*=\s*\d+")


def blocks(page: Path) -> list[str]:
    """The Python code of a page, block by block."""
    return re.findall(r"^```python\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)


def test_readme_has_an_example():
    """Claim: the test below has something to run."""
    assert ROOT / "README.md" in PAGES


@pytest.mark.mjx
@pytest.mark.optax
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_blocks_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: the blocks of a page run, one after the other, with a small preset for `quick`, few
    episodes and few seeds."""
    monkeypatch.chdir(tmp_path)
    small = presets.smoke().change(sim={"physics": "auto"})  # as in `quick`
    monkeypatch.setattr(presets, "quick", lambda: small)
    monkeypatch.setitem(presets.PRESETS, "quick", lambda: small)
    namespace = {"__name__": page.stem}
    for block in blocks(page):
        exec(compile(NUMBERS.sub(r"\1=2", block), page.name, "exec"), namespace)


def _run_command(line: str) -> None:
    """Runs a line of a page: a file of examples/, or csac-jax."""
    program, *arguments = shlex.split(line, comments=True)
    if program == "python":
        runpy.run_path(str(ROOT / arguments[0]))["main"](*arguments[1:])
    else:
        assert program == "csac-jax"
        assert cli.main(arguments) == 0, line


def _run_page(page: Path) -> int:
    """Runs the commands and Python blocks of a page in their order; returns their number."""
    step = r"(?ms)^```python\n(.*?)^```|^    ((?:python|csac-jax) [^\n]*)"
    steps = re.findall(step, re.sub(r"(?ms)^```py\n.*?^```", "", page.read_text()))
    namespace = {"__name__": page.stem}
    for block, command in steps:
        if command:
            _run_command(command)
        else:
            exec(compile(block, page.name, "exec"), namespace)
    return len(steps)


def test_robot_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: the commands and Python blocks of docs/robot.md run in their order, but those that
    need hardware, which are marked `py`."""
    for module in ("flatbuffers", "onnx", "onnxruntime"):
        pytest.importorskip(module)
    monkeypatch.chdir(tmp_path)
    assert _run_page(ROBOT) >= 6
    assert Path("demo/decision.png").exists()


@pytest.mark.slow
@pytest.mark.mjx
def test_objects_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: the commands and Python blocks of docs/objects.md run in their order, given a folder
    of meshes in millimetres."""
    pytest.importorskip("coacd")
    trimesh = pytest.importorskip("trimesh")
    monkeypatch.chdir(tmp_path)
    Path("meshes").mkdir()
    trimesh.creation.box((30, 40, 50)).export("meshes/box.stl")
    assert _run_page(OBJECTS) >= 7
    for name in ("own.png", "cup.png", "pile.png", "result.json"):
        assert Path("objects", name).exists()
