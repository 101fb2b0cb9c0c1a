"""Every file of examples/ runs, and is short."""

import importlib
from pathlib import Path
from types import ModuleType

import pytest

import csac_jax
from csac_jax import presets

FOLDER = Path(csac_jax.__file__).parents[1] / "examples"
NOTEBOOK = FOLDER / "01_first_grasp.ipynb"
TRAINERS = {"03_own_sampler", "04_own_network", "05_own_learner"}
OTHERS = {"02_random_agent", "06_gym_policy_gradient", "07_optuna_search"}
LONG = {  # see test_robot_examples and test_docs
    "08_camera_image",
    "09_realsense",
    "10_franka",
    "11_ur_rtde",
    "12_ros2_node",
}
pytestmark = [pytest.mark.mjx, pytest.mark.optax]


def _module(name: str) -> ModuleType:
    return importlib.import_module(f"examples.{name}")


def test_examples_are_short_and_tested():
    """Claim: an example has at most 60 lines, one for a robot or its camera 100; all are tested.
    They are numbered, and each is named on a page."""
    paths = {path.stem: path for path in FOLDER.glob("*.py")}
    assert paths.keys() == TRAINERS | OTHERS | LONG
    pages = "".join(page.read_text() for page in (FOLDER.parent / "docs").rglob("*.md"))
    names = sorted(path.name for path in FOLDER.iterdir() if path.is_file())
    assert [int(name[:2]) for name in names] == list(range(1, len(names) + 1))
    assert [name for name in names if f"examples/{name}" not in pages] == []
    for name, path in paths.items():
        assert len(path.read_text().splitlines()) <= (100 if name in LONG else 60), name


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> str:
    """Registers a small preset that compiles fast, and returns its name."""
    cfg = presets.smoke().change(sim={"physics": "c"})
    monkeypatch.setitem(presets.PRESETS, "small", lambda: cfg)
    return "small"


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(TRAINERS))
def test_own_parts_train(small: str, name: str, tmp_path: Path):
    """Claim: a user's own part trains a run to its end, and the run's policy acts with it."""
    run = _module(name).main(small, tmp_path / "run")
    assert (run.summary.actions, run.summary.stopped_by) == (64, None)
    table = csac_jax.evaluate(run.policy, suite="in_distribution", episodes=2)
    assert table["counts"]["episodes"] == 2


def test_random_agent_runs(small: str):
    """Claim: the environment runs in a scan of a vmap, with finished scenes replaced."""
    assert 0.0 <= _module("02_random_agent").main(small, "6") <= 1.0


@pytest.mark.slow
def test_policy_gradient_learns(monkeypatch: pytest.MonkeyPatch):
    """Claim: the learner in one file takes more blocks in the end than at first, among single cubes
    in a small workspace."""
    cfg = presets.smoke().change(
        scene={"slots": ("box",), "min_blocks": 1, "pool": 16, "drop_extent": (0.05, 0.05)},
        sim={"physics": "c"},
        heightmap={"extent": 0.16},
        task={"max_actions": 1},
    )
    monkeypatch.setitem(presets.PRESETS, "easy", lambda: cfg)
    returns = _module("06_gym_policy_gradient").main("easy", "150", "16")
    assert sum(returns[-50:]) > 1.3 * sum(returns[:50])


@pytest.mark.slow
def test_search_tries_settings(small: str, tmp_path: Path):
    """Claim: the search trains each trial into its own folder, keeps its results, and continues."""
    pytest.importorskip("optuna")
    search = _module("07_optuna_search").main
    assert len(search(small, tmp_path / "search", "1", "2").trials) == 1
    study = search(small, tmp_path / "search", "1", "2")
    assert [trial.state.name for trial in study.trials] == ["COMPLETE"] * 2
    for number, trial in enumerate(study.trials):
        assert 0.0 <= trial.value <= 1.0
        cfg = csac_jax.load_config(tmp_path / f"search/trial-{number}/config.json")
        assert cfg.learn.tau == trial.params["tau"]


def test_notebook_has_no_outputs():
    """Claim: the notebook is kept without outputs, compiles, and installs the package first."""
    notebook = pytest.importorskip("nbformat").read(NOTEBOOK, as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert not [cell for cell in cells if cell.outputs or cell.execution_count]
    assert "pip" in cells[0].source
    for cell in cells:
        compile(cell.source, NOTEBOOK.name, "exec")


@pytest.mark.slow
def test_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: the notebook runs from its first to its last cell, trains, and shows three figures and
    a video; here with fewer actions."""
    nbclient = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    monkeypatch.setenv("PYTHONPATH", str(FOLDER.parent))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path))
    text = NOTEBOOK.read_text().replace(r"\"actions\": 480", r"\"actions\": 160")
    text = text.replace(r"\"480\", \"360\"", r"\"96\", \"64\"")
    notebook = pytest.importorskip("nbformat").reads(text, as_version=4)
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=900, resources=resources).execute()
    outputs = [out for cell in notebook.cells for out in cell.get("outputs", ())]
    shown = [kind for out in outputs for kind in out.get("data", ()) if kind.startswith("image/")]
    assert shown == ["image/png"] * 3 + ["image/gif"]
    assert "160 actions, success" in "".join(out.get("text", "") for out in outputs)
