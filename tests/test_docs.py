"""Every Python block of README and docs runs."""

import re
import runpy
import shlex
from pathlib import Path

import pytest

import csac_jax
from csac_jax import cli, presets

ROOT = Path(csac_jax.__file__).parents[1]
ROBOT = ROOT / "docs" / "robot.md"  # its commands make the files of its blocks
PAGES = [
    page
    for page in (ROOT / "README.md", *ROOT.glob("docs/**/*.md"))
    if "```python" in page.read_text() and page != ROBOT
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


@pytest.mark.slow
def test_robot_page_trains(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: the policy of docs/robot.md learns from the page's own record, in a few updates, and
    the next command takes it. The commands that train from nothing are good ones."""
    from csac_jax.cli import train

    monkeypatch.chdir(tmp_path)
    page = ROBOT.read_text().replace("\\\n", " ")
    lines = re.findall(r"^ *((?:python|csac-jax) .*)$", page, re.MULTILINE)
    record = [line for line in lines if "--record record" in line]
    for line in [one for one in lines if "camera_image.py" in one] + record:
        if "--board" not in line:
            _run_command(line)
    (tmp_path / "record/000001/outcome.json").write_text('{"outcome": "lifted"}')
    for line in [one for one in lines if "mine.safetensors" in one]:
        few = line.replace("finetune shipped", "finetune shipped --updates 10 --batch 2")
        _run_command(few)
    training = [shlex.split(line)[2:] for line in lines if line.startswith("csac-jax train")]
    assert len(training) == 2
    for arguments in training:
        _, cfg = train.read(arguments)
        assert cfg.heightmap.view == "oblique"
        assert cfg.sensor.kind == "d415"


def test_robot_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: the commands and Python blocks of docs/robot.md run in their order, but those that
    need hardware, which are marked `py`."""
    for module in ("flatbuffers", "onnx", "onnxruntime"):
        pytest.importorskip(module)
    monkeypatch.chdir(tmp_path)
    step = r"(?ms)^```python\n(.*?)^```|^    ((?:python|csac-jax) [^\n]*)"
    steps = re.findall(step, re.sub(r"(?ms)^```py\n.*?^```", "", ROBOT.read_text()))
    namespace = {"__name__": "robot"}
    for block, command in steps:
        if command:
            _run_command(command)
        else:
            exec(compile(block, "robot.md", "exec"), namespace)
    assert len(steps) >= 6
    assert Path("demo/decision.png").exists()
