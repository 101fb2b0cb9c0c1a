"""Every file of examples/ runs, and is short."""

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import csac_jax
from csac_jax import presets

FOLDER = Path(csac_jax.__file__).parents[1] / "examples"
NOTEBOOK = FOLDER / "first_grasp.ipynb"
ROBOTS = ("ros2_node", "ur_rtde")  # see test_robot_examples
BY_PAGE = ("camera_image",)  # run by docs/robot.md, see test_docs
TRAINERS = ("own_sampler", "own_network", "own_learner")


def _module(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_example_is_tested():
    """Claim: the tests below run all of them."""
    assert {path.stem for path in FOLDER.glob("*.py")} == {
        *TRAINERS,
        *BY_PAGE,
        *ROBOTS,
        "random_agent",
        "gym_policy_gradient",
        "optuna_search",
    }


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_examples_are_short(path: Path):
    """Claim: an example has at most 60 lines, one for a robot or its camera 100."""
    long = path.stem in (*ROBOTS, "camera_image")
    assert len(path.read_text().splitlines()) <= (100 if long else 60)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> str:
    """Name of a small preset of C's physics, which compile fast."""
    cfg = presets.smoke().change(sim={"physics": "c"})
    monkeypatch.setitem(presets.PRESETS, "small", lambda: cfg)
    return "small"


@pytest.mark.mjx
@pytest.mark.optax
@pytest.mark.slow
@pytest.mark.parametrize("name", TRAINERS)
def test_own_parts_train(small: str, name: str, tmp_path: Path):
    """Claim: a part of one's own trains a run to its end, and the run's policy acts with it."""
    run = _module(name).main(small, tmp_path / "run")
    assert run.summary.actions == 64
    assert run.summary.stopped_by is None
    table = csac_jax.evaluate(run.policy, suite="in_distribution", episodes=2)
    assert table["counts"]["episodes"] == 2


@pytest.mark.mjx
def test_random_agent_runs(small: str):
    """Claim: the environment runs in a scan of a vmap, with finished scenes replaced."""
    assert 0.0 <= _module("random_agent").main(small, "6") <= 1.0


def _notebook() -> Any:
    return pytest.importorskip("nbformat").read(NOTEBOOK, as_version=4)


def test_notebook_has_no_outputs():
    """Claim: the notebook is kept without what it printed and drew, and installs itself first."""
    cells = [cell for cell in _notebook().cells if cell.cell_type == "code"]
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
    notebook, fewer = (
        _notebook(),
        {'"actions": 480': '"actions": 160', '"480", "360"': '"96", "64"'},
    )
    for cell in notebook.cells:
        for long, short in fewer.items():
            cell.source = cell.source.replace(long, short)
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=900, resources=resources).execute()
    outputs = [out for cell in notebook.cells for out in cell.get("outputs", ())]
    shown = [kind for out in outputs for kind in out.get("data", ()) if kind.startswith("image/")]
    assert shown == ["image/png"] * 3 + ["image/gif"]
    text = "".join(out.get("text", "") for out in outputs)
    assert "160 actions, success" in text


@pytest.mark.mjx
@pytest.mark.optax
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
    returns = _module("gym_policy_gradient").main("easy", "150", "16")
    assert sum(returns[-50:]) > 1.3 * sum(returns[:50])


@pytest.mark.mjx
@pytest.mark.optax
@pytest.mark.slow
def test_search_tries_settings(small: str, tmp_path: Path):
    """Claim: the search trains each trial into a folder of its own, keeps what it found, and goes
    on with it."""
    pytest.importorskip("optuna")
    search = _module("optuna_search").main
    assert len(search(small, tmp_path / "search", "1", "2").trials) == 1
    study = search(small, tmp_path / "search", "1", "2")
    assert [trial.state.name for trial in study.trials] == ["COMPLETE"] * 2
    assert all(0.0 <= trial.value <= 1.0 for trial in study.trials)
    for number, trial in enumerate(study.trials):
        cfg = csac_jax.load_config(tmp_path / f"search/trial-{number}/config.json")
        assert cfg.learn.tau == trial.params["tau"]
