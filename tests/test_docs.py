"""README and docs: their code runs, their commands parse, their sentences are short."""

import base64
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
from typing import Any

import jax
import matplotlib
import pytest
import yaml

import csac_jax
from csac_jax import algorithms, cli, presets
from csac_jax.cli import parsing, sweep
from csac_jax.evaluation import suites
from csac_jax.io import checkpoint, configs, policy_file
from experiments import index
from tests.networks import random_params

ROOT = Path(csac_jax.__file__).parents[1]
README, DOCS = ROOT / "README.md", ROOT / "docs"
ROBOT, OBJECTS, GRIPPERS = (DOCS / name for name in ("robot.md", "objects.md", "grippers.md"))
EXTEND = DOCS / "how-to" / "extend.md"
MINE = DOCS / "how-to" / "my-robot.md"
COMPARE = DOCS / "how-to" / "compare-my-part.md"
AGENTS, LEARNER = ROOT / "AGENTS.md", DOCS / "how-to" / "own-jax-learner.md"
ROOTS = [README, AGENTS, ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md"]
ALL = [*ROOTS, *sorted(DOCS.glob("**/*.md"))]
WHOLE = (ROBOT, OBJECTS, COMPARE, LEARNER)  # that have tests of their own
PAGES = [page for page in ALL if "```python" in page.read_text() and page not in WHOLE]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
NUMBERS = re.compile(r"\b(episodes|seeds)\s*=\s*\d+")
PROGRAMS = ("csac-jax", "make", "pip", "python", "jupyter", "source", "srun")
WORDS = {"README.md": 900, "CHANGELOG.md": 1500, "CONTRIBUTING.md": 900}
SENTENCE = 30  # most words
names = pytest.mark.parametrize("page", ALL, ids=lambda page: str(page.relative_to(ROOT)))


def record(name: str) -> str:
    """Returns the text of a recorded file, FAMILY/VARIANT/..., from the archive of its family."""
    return index.contents(index.RESULTS / f"{name.partition('/')[0]}.tar.xz")[name].decode()


def fenced(page: Path, language: str) -> list[str]:
    """Returns the fenced blocks of a language, in their order."""
    return [code for name, code in FENCE.findall(page.read_text()) if name == language]


def commands(page: Path) -> Iterator[list[str]]:
    """Yields the words of each command in a page's indented blocks and scripts."""
    bare = FENCE.sub("", page.read_text())
    code = re.findall(r"(?m)^    (.*)$", bare) + "\n".join(fenced(page, "sh")).splitlines()
    for line in "\n".join(code).replace("\\\n", " ").splitlines():
        if line.split()[:1] and line.split()[0] in PROGRAMS:
            words = shlex.split(line.replace("$", "").split(";")[0], comments=True)
            yield words[1:] if words[0] == "srun" else words


@pytest.fixture
def shipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Puts a tiny policy of both tasks, which grasps, in the place of `shipped`."""
    grasps = {"policy": {"primitive": "grasp"}, "explore": {"push_fraction": 0.0}}
    cfg = presets.smoke().change(task={"kind": "both"}, **grasps)
    path = tmp_path / "shipped.safetensors"
    policy_file.save(path, random_params(cfg), cfg)
    monkeypatch.setitem(policy_file.SHIPPED, "shipped", path)


@pytest.mark.mjx
@pytest.mark.optax
@pytest.mark.usefixtures("shipped")
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_blocks_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: the blocks of a page run, one after the other, with a small preset for `quick` and a
    tiny policy for `shipped`, few episodes and few seeds, in a folder with a recorded run;
    `train_fn` is traced alone."""
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    (tmp_path / "runs" / "first").mkdir(parents=True)
    log = record("quick/csac_beta/seed-0/metrics.jsonl")
    (tmp_path / "runs" / "first" / "metrics.jsonl").write_text(log)
    small = presets.smoke().change(sim={"physics": "auto"})  # as in `quick`
    monkeypatch.setattr(presets, "quick", lambda: small)
    monkeypatch.setattr(presets, "PRESETS", {**presets.PRESETS, "quick": lambda: small})
    for module, name in ((algorithms, "ALGORITHMS"), (suites, "SUITES")):  # pages register theirs
        monkeypatch.setattr(module, name, dict(getattr(module, name)))
    namespace = {"__name__": page.stem}
    for block in fenced(page, "python"):
        with jax.debug_key_reuse("train_fn" not in block):  # a vmapped transpose of keys is no use
            exec(compile(_shortened(block), page.name, "exec"), namespace)


def _shortened(block: str) -> str:
    """Returns a block with small numbers, and with `train_fn` traced in place of compiled."""
    block = re.sub(r"jax\.jit\((.*train_fn.*)\)\((\w+)\)", r"jax.eval_shape(\1, \2)", block)
    return NUMBERS.sub(r"\1=2", block)


class Parsed(BaseException):
    """Arguments were read; nothing runs."""


@pytest.fixture
def parses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ends each command after its arguments, in a folder with the files that pages name."""
    parse = parsing.parse
    monkeypatch.chdir(tmp_path)
    for folder in ("runs/NAME", "RUN/best"):
        Path(folder).mkdir(parents=True)
    Path("experiments").symlink_to(ROOT / "experiments")
    Path("my.toml").write_text('preset = "quick"')
    for path in ("runs/NAME/config.json", "config.json"):
        Path(path).write_text(json.dumps(configs.to_dict(presets.quick())))

    def stop(*args: Any, **kwargs: Any) -> None:
        parse(*args, **kwargs)
        raise Parsed

    monkeypatch.setattr(parsing, "parse", stop)
    monkeypatch.setattr(checkpoint, "load_config", lambda *_, **__: presets.quick())


def _check(words: list[str], extras: set[str], targets: set[str]) -> None:
    """Fails for a command that is not there."""
    program, *arguments = words
    if program == "csac-jax" and arguments[0] == "bench":
        assert (ROOT / "experiments" / "bench" / f"{arguments[1]}.py").exists()
    elif program == "csac-jax":
        try:
            code = cli.main(arguments)
        except Parsed:
            return
        pytest.fail(f"{' '.join(words)}: exit code {code}")
    elif program == "make":
        assert arguments[0] in targets
    elif program == "pip":
        wanted = re.findall(r"\[([\w,]+)\]", " ".join(arguments))
        assert set(",".join(wanted).split(",")) <= extras | {"k8s", ""}
    elif program == "python" and arguments[0] == "-m":
        assert importlib.util.find_spec(arguments[1]) is not None
    elif program in ("python", "jupyter"):
        assert (ROOT / arguments[-1 if program == "jupyter" else 0]).exists()


def test_commands_are_those_of_the_package(parses: None):
    """Claim: the real parser reads every csac-jax command of the pages; targets of make, extras of
    pip, modules and files of python are there."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    targets = set(re.findall(r"(?m)^([a-z-]+):", (ROOT / "Makefile").read_text()))
    found = [words for page in ALL for words in commands(page)]
    assert len(found) > 40
    for words in found:
        _check(words, set(project["optional-dependencies"]), targets)


@pytest.mark.slow
def test_sweeps_can_be_planned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: the pages on sweeps vary settings, by values that these can have."""
    monkeypatch.chdir(tmp_path)
    pages = (DOCS / "how-to" / name for name in ("sweeps.md", "scenes.md"))
    lines = [words[2:] for page in pages for words in commands(page) if words[1] == "sweep"]
    plans = [sweep.read(words)[1] for words in lines if "--resume" not in words]
    assert [len(plan.points) for plan in plans] == [2, 48, 7, 4]


@names
def test_other_blocks_parse(page: Path):
    """Claim: every fenced block names its language, and is Python, a script, JSON, TOML, YAML,
    BibTeX or text."""
    parsers = {"json": json.loads, "toml": tomllib.loads}
    parsers["yaml"] = lambda text: [*yaml.safe_load_all(text)]
    for language, code in FENCE.findall(page.read_text()):
        if language in ("python", "py"):
            compile(code, page.name, "exec")
        elif language == "sh":
            subprocess.run(["bash", "-n"], input=code, text=True, check=True)
        elif language not in ("text", "bibtex"):
            parsers[language](code)


def _run_command(line: str) -> None:
    """Runs a line of a page. Drawing gets its own process: OpenGL fails after CoACD is loaded."""
    program, *arguments = shlex.split(line, comments=True)
    if program == "python":
        runpy.run_path(str(ROOT / arguments[0]))["main"](*arguments[1:])
    elif arguments[0] == "play":
        subprocess.run([sys.executable, "-m", "csac_jax", *arguments], check=True)
    else:
        assert program == "csac-jax"
        assert cli.main(arguments) == 0, line


def _run_page(text: str, text_blocks: bool = False) -> int:
    """Runs a page's commands and Python blocks in their order; returns their number. Commands in
    ```text blocks run on request, ```py blocks never."""
    text = re.sub(r"(?ms)^```(py|sh)\n.*?^```", "", text)
    indent = "(?:    )?" if text_blocks else "    "
    steps = re.findall(rf"(?ms)^```python\n(.*?)^```|^{indent}((?:python|csac-jax) [^\n]*)", text)
    namespace = {"__name__": "page"}
    for block, command in steps:
        if command:
            _run_command(command)
        else:
            exec(compile(block, "page", "exec"), namespace)
    return len(steps)


@pytest.mark.usefixtures("shipped")
def test_robot_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: the commands and Python blocks of docs/robot.md run in their order, with a tiny policy
    for `shipped`, and maps of its size for those of `shipped`."""
    for module in ("jax2onnx", "onnxruntime"):
        pytest.importorskip(module)
    monkeypatch.chdir(tmp_path)
    assert _run_page(ROBOT.read_text().replace("(96, 96", "(32, 32")) >= 6
    assert Path("demo/decision.png").exists()


@pytest.mark.slow
@pytest.mark.mjx
def test_my_robot_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: the commands and the block of the page on one's own objects, hand and camera run in
    their order, with two episodes; it ends in an arm's set-points."""
    monkeypatch.chdir(tmp_path)
    assert _run_page(re.sub(r"--episodes \d+", "--episodes 2", MINE.read_text())) == 9
    for name in ("my_objects.png", "pile.png", "decision.png", "decision.json"):
        assert Path(name).stat().st_size > 0


@pytest.mark.slow
@pytest.mark.optax
def test_robot_page_trains(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: the policy of docs/robot.md learns from the page's own record, in a few updates, and
    the next command takes it. The commands that train from nothing are good ones."""
    from csac_jax.cli import train

    monkeypatch.chdir(tmp_path)
    page = ROBOT.read_text().replace("\\\n", " ")
    lines = re.findall(r"^ *((?:python|csac-jax) .*)$", page, re.MULTILINE)
    images = [line for line in lines if "08_camera_image.py" in line and "--board" not in line]
    for line in images + [line for line in lines if "--record record" in line]:
        _run_command(line)
    (tmp_path / "record/000001/outcome.json").write_text('{"outcome": "lifted"}')
    for line in [line for line in lines if "mine.safetensors" in line]:
        _run_command(line.replace(" record --out", " record --updates 10 --batch 2 --out"))
    training = [shlex.split(line)[2:] for line in lines if line.startswith("csac-jax train")]
    assert len(training) == 2
    for arguments in training:
        _, cfg = train.read(arguments)
        assert (cfg.heightmap.view, cfg.sensor.kind) == ("oblique", "d415")


@pytest.mark.slow
@pytest.mark.mjx
@pytest.mark.optax
def test_tutorial_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: the commands of the tutorial run in their order, with a small preset for `quick`."""
    monkeypatch.chdir(tmp_path)
    small = presets.smoke().change(sim={"physics": "c"})
    monkeypatch.setitem(presets.PRESETS, "quick", lambda: small)
    found = commands(DOCS / "tutorial" / "first-training.md")
    ran = [words[1:] for words in found if words[0] == "csac-jax"]
    for words in ran:
        assert cli.main(words) == 0, words
    assert [words[0] for words in ran] == ["doctor", "train", "eval", "play", "report"]
    assert Path("first.webp").exists()
    assert "CSAC-beta (quick)" in Path("first.md").read_text()


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
    page = re.sub(r"(?m)^csac-jax .* \.\.\.$", "", page)  # the rest of it is in robot.md
    assert _run_page(page, text_blocks=True) == 10


@pytest.mark.slow
@pytest.mark.mjx
@pytest.mark.optax
def test_compare_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: the blocks and the command of the page on own parts run in their order, with a small
    preset, two seeds and two episodes; the report has one figure with the part and CSAC-beta."""
    monkeypatch.chdir(tmp_path)
    small = presets.smoke().change(sim={"physics": "c"})
    monkeypatch.setattr(presets, "quick", lambda: small)
    assert _run_page(NUMBERS.sub(r"\1=2", COMPARE.read_text())) == 4
    page = Path("page/index.html").read_text()
    (svg,) = re.findall(
        r'Training of smoke: variants.*?src="data:image/svg\+xml;base64,([^"]+)', page, re.DOTALL
    )
    drawn = base64.b64decode(svg).decode()
    assert "CSAC-beta (2)" in drawn
    assert "RankExponential(share=0.2)" in drawn
    difference = re.search("Differences in training.*?</table>", page, re.DOTALL)
    assert difference is not None
    assert "RankExponential" in difference[0]


@pytest.mark.slow
@pytest.mark.mjx
@pytest.mark.optax
def test_learner_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: PPO of the page has at most 81 lines, and trains two seeds in one program, which
    differ; blocks per action are shares."""
    monkeypatch.chdir(tmp_path)
    small = presets.smoke().change(sim={"physics": "c"})
    monkeypatch.setattr(presets, "quick", lambda: small)
    learner, run = fenced(LEARNER, "python")
    assert len(learner.splitlines()) <= 81
    namespace: dict[str, Any] = {"__name__": "page"}
    exec(compile(learner, "page", "exec"), namespace)
    with jax.debug_key_reuse(False):
        exec(compile(run.replace("20, 2", "2, 2"), "page", "exec"), namespace)
    curves = namespace["curves"]
    assert curves.shape == (2, 2)
    assert 0.0 <= curves.min() <= curves.max() <= 1.0


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
    page, training = OBJECTS.read_text(), r"(?m)^    csac-jax train .*$"
    assert _run_page(re.sub(training, "", page)) >= 7
    for name in ("own.png", "cup.png", "pile.png", "result.json"):
        assert Path("objects", name).exists()


def _sentences(page: Path) -> list[list[str]]:
    """Returns the words of each sentence of a page's text, without code, tables and titles."""
    text = re.sub(r"(?ms)^(```|\$\$|---$).*?^(```|\$\$|---)|<!--.*?-->", "", page.read_text())
    text = re.sub(r"(?m)^(    |\||#|!|:::).*$", "", text)
    text = re.sub(r"(?m)^ *(- |\d+\. )", "\n\n", text)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    return [part.split() for part in re.split(r"\n\s*\n|(?<=[.:!?])\s+", text) if part.strip()]


@names
def test_pages_and_sentences_are_short(page: Path):
    """Claim: no sentence of README, CHANGELOG, CONTRIBUTING and docs has more than 30 words. README
    has at most 900, CHANGELOG 1,500, CONTRIBUTING 900."""
    assert not [" ".join(words) for words in _sentences(page) if len(words) > SENTENCE]
    assert len(page.read_text().split()) <= WORDS.get(page.name, 5000)


def _named(page: Path) -> set[str]:
    return set(re.findall(r"`([\w./]+/[\w./]+)`", page.read_text()))


def test_pages_for_assistants_are_short_and_lead_somewhere():
    """Claim: AGENTS.md has at most 60 lines; the paths that it and llms.txt name are there."""
    assert len(AGENTS.read_text().splitlines()) <= 60
    index = (ROOT / "llms.txt").read_text()
    linked = re.findall(r"\]\(([^)]+)\)", index)
    assert len(linked) > 15
    assert not [path for path in [*linked, *_named(AGENTS)] if not (ROOT / path).exists()]
    assert index.startswith("# csac_jax\n\n> ")


def test_contributing_names_files_that_exist():
    """Claim: the files that CONTRIBUTING and its page tell to change are there."""
    named = _named(ROOT / "CONTRIBUTING.md") | _named(EXTEND)
    assert len(named) > 40
    assert not [path for path in named if "NAME" not in path and not (ROOT / path).exists()]


def test_every_module_that_tells_primitives_apart_is_named():
    """Claim: the page on a new primitive names every module that compares pushes and grasps."""
    sources = (ROOT / "csac_jax").rglob("*.py")
    compare = re.compile(r"Primitive\.(PUSH|GRASP)")
    found = [path for path in sources if compare.search(path.read_text())]
    text = EXTEND.read_text()
    assert len(found) > 15
    names = {path.relative_to(ROOT).as_posix() for path in found}
    names -= {f"csac_jax/baselines/{name}.py" for name in ("antipodal", "oracle")}  # in one row
    assert not [name for name in names if name not in text]


@pytest.mark.parametrize(
    ("name", "path"),
    [
        ("shipped", "general/fit/seed-1/eval-pile.json"),
        ("shipped_clutter", "fast/clutter/seed-1/eval-random30-high.json"),
    ],
)
def test_listed_policies_have_the_recorded_numbers(
    name: str, path: str, capsys: pytest.CaptureFixture
):
    """Claim: `csac-jax policies` has each policy's task, hand, view and recorded result."""
    measured = json.loads(record(path))
    assert cli.main(["policies"]) == 0
    head, result = capsys.readouterr().out.split(f"{name} ", 1)[1].splitlines()[:2]
    shares = [f"{100 * measured[one]['value']:.1f} %" for one in ("grasp_success", "completion")]
    assert re.findall(r"[\d.]+ %", result) == shares
    assert result.split(":")[0].strip() == measured["suite"]
    cfg = configs.from_dict(measured["config"])
    assert ("marked" in head) == (name == "shipped")
    assert ("objects" in head) == cfg.scene.has_objects
    assert "maps from above" in head
    assert f"hand {'any' if cfg.net.gripper else 'rg2'};" in head
