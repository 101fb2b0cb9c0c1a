"""README and docs: their code runs or parses, their links lead somewhere, README stays short."""

import importlib.util
import json
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import matplotlib
import pytest
import yaml

import csac_jax
from csac_jax import algorithms, cli, presets
from csac_jax.cli import parsing, sweep
from csac_jax.evaluation import suites
from csac_jax.io import checkpoint, configs
from experiments import index

ROOT = Path(csac_jax.__file__).parents[1]
README = ROOT / "README.md"
METRICS = ("completion", "grasp_success", "action_efficiency")
ROBOT = ROOT / "docs" / "robot.md"  # its commands make the files of its blocks
OBJECTS = ROOT / "docs" / "objects.md"  # likewise
GRIPPERS = ROOT / "docs" / "grippers.md"
TUTORIAL = ROOT / "docs" / "tutorial" / "first-training.md"
RECORD = "quick/csac_beta/seed-0/metrics.jsonl"
ALL = [README, ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("docs/**/*.md"))]
PAGES = [page for page in ALL if "```python" in page.read_text() and page not in (ROBOT, OBJECTS)]
NUMBERS = re.compile(r"\b(episodes|seeds)\s*=\s*\d+")
SHELL = re.compile(r"^```sh\n(.*?)^```", re.DOTALL | re.MULTILINE)
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
PROGRAMS = ("csac-jax", "make", "pip", "python", "jupyter", "source", "srun")
WORDS, LINES, SENTENCE = 1000, 150, 20  # of README
names = pytest.mark.parametrize("page", ALL, ids=lambda page: str(page.relative_to(ROOT)))


def blocks(page: Path) -> list[str]:
    """The Python code of a page, block by block."""
    return re.findall(r"^```python\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)


def commands(page: Path) -> Iterator[list[str]]:
    """The words of each command in a page's indented blocks and scripts."""
    text = page.read_text()
    bare = re.sub(r"(?ms)^```.*?^```", "", text)
    code = re.findall(r"(?m)^    (.*)$", bare) + "\n".join(SHELL.findall(text)).splitlines()
    for line in "\n".join(code).replace("\\\n", " ").splitlines():
        if line.split()[:1] and line.split()[0] in PROGRAMS:
            words = shlex.split(line.replace("$", "").split(";")[0], comments=True)
            yield words[1:] if words[0] == "srun" else words


def test_readme_has_an_example():
    """Claim: the test below has something to run."""
    assert README in PAGES


@pytest.mark.mjx
@pytest.mark.optax
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_blocks_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: the blocks of a page run, one after the other, with a small preset for `quick`, few
    episodes and few seeds, in a folder with a recorded run."""
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    (tmp_path / "runs" / "first").mkdir(parents=True)
    log = index.contents(index.RESULTS / "quick.tar.xz")[RECORD]
    (tmp_path / "runs" / "first" / "metrics.jsonl").write_bytes(log)
    small = presets.smoke().change(sim={"physics": "auto"})  # as in `quick`
    monkeypatch.setattr(presets, "quick", lambda: small)
    monkeypatch.setattr(presets, "PRESETS", {**presets.PRESETS, "quick": lambda: small})
    for module, name in ((algorithms, "ALGORITHMS"), (suites, "SUITES")):  # pages register theirs
        monkeypatch.setattr(module, name, dict(getattr(module, name)))
    namespace = {"__name__": page.stem}
    for block in blocks(page):
        exec(compile(NUMBERS.sub(r"\1=2", block), page.name, "exec"), namespace)


class Parsed(BaseException):
    """Arguments were read; nothing runs."""


@pytest.fixture
def parses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands end once they have read their arguments, in a folder with the files that pages name.
    Every run is one of `quick`."""
    parse = parsing.parse
    monkeypatch.chdir(tmp_path)
    for folder in ("runs/NAME", "RUN/best"):
        Path(folder).mkdir(parents=True)
    Path("experiments").symlink_to(ROOT / "experiments")
    Path("my.toml").write_text('preset = "quick"')
    Path("runs/NAME/config.json").write_text(json.dumps(configs.to_dict(presets.quick())))

    def stop(*args, **kwargs):
        parse(*args, **kwargs)
        raise Parsed

    monkeypatch.setattr(parsing, "parse", stop)
    monkeypatch.setattr(checkpoint, "load_config", lambda folder, at=None: presets.quick())


def _check(words: list[str], extras: set[str], targets: set[str]) -> None:
    """Fails for a command that is none."""
    program, *arguments = words
    if program == "csac-jax" and arguments[0] == "bench":
        assert (ROOT / "experiments" / "bench" / f"{arguments[1]}.py").exists()
    elif program == "csac-jax":
        with pytest.raises(Parsed):
            assert cli.main(arguments) == 0, words
    elif program == "make":
        assert arguments[0] in targets
    elif program == "pip":
        named = re.findall(r"\[([\w,]+)\]", " ".join(arguments))
        assert {extra for one in named for extra in one.split(",")} <= extras | {"k8s"}
    elif program == "python" and arguments[0] == "-m":
        assert importlib.util.find_spec(arguments[1]) is not None
    elif program in ("python", "jupyter"):
        assert (ROOT / arguments[-1 if program == "jupyter" else 0]).exists()


@names
def test_commands_are_those_of_the_package(page: Path, parses: None):
    """Claim: the real parser reads every csac-jax command of a page; targets of make, extras of
    pip, modules and files of python are there."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    targets = set(re.findall(r"(?m)^([a-z-]+):", (ROOT / "Makefile").read_text()))
    for words in commands(page):
        _check(words, set(project["optional-dependencies"]), targets)


def test_commands_are_found():
    """Claim: the test above reads the commands that are there, continued lines too."""
    found = [words for page in ALL for words in commands(page)]
    assert len(found) > 40
    assert sum(words[1:2] == ["sweep"] and words.count("--vary") == 3 for words in found) == 1


@pytest.mark.slow
def test_sweeps_can_be_planned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: what the pages on sweeps vary are settings, of values that they can have."""
    monkeypatch.chdir(tmp_path)
    pages = (ROOT / "docs" / "how-to" / name for name in ("sweeps.md", "scenes.md"))
    lines = [words[2:] for page in pages for words in commands(page) if words[1] == "sweep"]
    plans = [sweep.read(words)[1] for words in lines if "--resume" not in words]
    assert [len(plan.points) for plan in plans] == [2, 48, 7, 4]


@names
def test_other_blocks_parse(page: Path):
    """Claim: every fenced block names its language, and is Python, a script, JSON, TOML, YAML,
    BibTeX or text."""
    for language, code in FENCE.findall(page.read_text()):
        if language in ("python", "py"):
            compile(code, page.name, "exec")
        elif language == "json":
            json.loads(code)
        elif language == "toml":
            tomllib.loads(code)
        elif language == "yaml":
            list(yaml.safe_load_all(code))
        elif language == "sh":
            subprocess.run(["bash", "-n"], input=code, text=True, check=True)
        else:
            assert language in ("text", "bibtex"), f"{page}: {language!r}"


def _run_command(line: str) -> None:
    """Runs a line of a page: a file of examples/, or csac-jax; in a process of its own what draws,
    since OpenGL ends one that has loaded CoACD."""
    program, *arguments = shlex.split(line, comments=True)
    if program == "python":
        runpy.run_path(str(ROOT / arguments[0]))["main"](*arguments[1:])
    elif arguments[0] == "play":
        subprocess.run([sys.executable, "-m", "csac_jax", *arguments], check=True)
    else:
        assert program == "csac-jax"
        assert cli.main(arguments) == 0, line


@pytest.mark.slow
@pytest.mark.optax
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
@pytest.mark.optax
def test_tutorial_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: the commands of the tutorial run in their order, with a small preset for `quick`."""
    monkeypatch.chdir(tmp_path)
    small = presets.smoke().change(sim={"physics": "c"})
    monkeypatch.setitem(presets.PRESETS, "quick", lambda: small)
    ran = [words for words in commands(TUTORIAL) if words[0] == "csac-jax"]
    for words in ran:
        assert cli.main(words[1:]) == 0, words
    assert [words[1] for words in ran] == ["doctor", "train", "eval", "play", "report"]
    assert Path("first.webp").exists()
    assert "CSAC-beta (quick)" in Path("first.md").read_text()


def _sentences(page: Path) -> list[list[str]]:
    """The words of each sentence of a page's text, without code, tables and titles."""
    text = re.sub(r"(?ms)^(```|\$\$).*?^(```|\$\$)", "", page.read_text())
    kept = [line for line in text.splitlines() if not re.match(r"    |\||#|!|\s*$|\d+\. ", line)]
    bare = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", "\n".join(kept).replace("\n- ", "\n"))
    return [sentence.split() for sentence in re.split(r"(?<=[.:!?])\s+", bare) if sentence.strip()]


def test_readme_is_short():
    """Claim: README has at most 150 lines, 1,000 words, and sentences of 20 words."""
    text = README.read_text()
    assert len(text.splitlines()) <= LINES
    assert len(text.split()) <= WORDS
    long = [" ".join(words) for words in _sentences(README) if len(words) > SENTENCE]
    assert not long


@pytest.mark.parametrize("folder", ["tutorial", "how-to", "reference", "explanation"])
def test_sentences_of_pages_are_short(folder: str):
    """Claim: no sentence of these pages has more than 20 words."""
    pages = (ROOT / "docs" / folder).glob("*.md")
    sentences = [words for page in pages for words in _sentences(page)]
    assert len(sentences) > 10
    assert not [" ".join(words) for words in sentences if len(words) > SENTENCE]


@pytest.mark.parametrize(
    ("policy", "record"),
    [
        ("shipped", {"random10": "fast/shipped/seed-0/eval-random10-c.json"}),
        (
            "shipped_clutter",
            {
                "cases": "fast/clutter/seed-1/eval-cases-high.json",
                "random30": "fast/clutter/seed-1/eval-random30-high.json",
            },
        ),
        ("shipped_objects", {"pile": "objects/gpu_cones/seed-7/eval-pile.json"}),
    ],
)
def test_readme_has_the_recorded_numbers(policy: str, record: dict[str, str]):
    """Claim: what README says of the shipped policies is what was recorded."""
    lines = README.read_text().splitlines()
    rows = [row.split("|")[3:6] for row in lines if f"**{policy}**" in row]
    for (name, path), row in zip(record.items(), rows, strict=True):
        said = [[float(number) for number in re.findall(r"[\d.]+", cell)] for cell in row]
        measured = index.record(path)
        parts = measured.get("parts", {name: measured}).values()
        for metric, shown, cell in zip(METRICS, said, row, strict=True):
            per_cent = 100 if "%" in cell else 1
            values = [per_cent * part[metric]["value"] for part in parts]
            least = 0.0051 if per_cent == 1 else 0.06 if "." in cell else 0.5
            assert [shown[0], shown[-1]] == pytest.approx([min(values), max(values)], abs=least)


@pytest.mark.mjx
@pytest.mark.optax
@pytest.mark.slow
def test_grippers_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: the blocks and commands of docs/grippers.md run in their order, with two episodes and
    a short training; the gripper of its five steps is one that `eval` takes."""
    monkeypatch.chdir(tmp_path)
    few = {"scene": {"pool": 16}, "train": {"actions": 320, "save_every": 2}}
    short = presets.grippers().change(**few)
    monkeypatch.setitem(presets.PRESETS, "grippers", lambda: short)
    page = re.sub(r"--episodes \d+", "--episodes 2", GRIPPERS.read_text())
    page = re.sub(r"(?m)^csac-jax .* \.\.\.$", "", page)  # what else it takes is in robot.md
    steps = re.findall(r"(?ms)^```python\n(.*?)^```|^(?:    )?(csac-jax [^\n]*)", page)
    namespace = {"__name__": "grippers"}
    for block, command in steps:
        if command:
            _run_command(command)
        else:
            exec(compile(block, "grippers.md", "exec"), namespace)
    assert len(steps) == 10


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
