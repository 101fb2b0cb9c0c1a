"""The page "In the browser", driven in Chromium from the file system, and the package."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import csac_jax
from csac_jax.agent import actor_critic, policy
from csac_jax.deploy import decision
from csac_jax.robot.primitives import Action

for module in ("mkdocs", "jax2onnx"):
    pytest.importorskip(module)
export = pytest.importorskip("docs.browser.export")
ROOT = Path(csac_jax.__file__).parents[1]
BUILT = ROOT / "build" / "browser"
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
PROGRAMS = {"node": shutil.which("node"), "npm": shutil.which("npm"), "chromium": CHROMIUM}
MISSING = [name for name, path in PROGRAMS.items() if path is None]
GRASPS = 20
BRICK = "".join(f"v {x} {y} {z}\n" for x in (90, 130) for y in (0, 50) for z in (-20, 10))

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(MISSING), reason=f"the browser's test needs {', '.join(MISSING)}"),
]


def _run(*command: str | Path) -> None:
    """Runs a command at the root of the repository."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Builds the page as `make docs` does; returns its file."""
    BUILT.mkdir(parents=True, exist_ok=True)
    for name in ("package.json", "package-lock.json"):
        shutil.copy(ROOT / "docs" / "browser" / name, BUILT)
    _run("npm", "ci", "--prefix", BUILT)
    _run(sys.executable, "-m", "docs.browser.export", BUILT)
    _run("node", ROOT / "docs" / "browser" / "build.mjs", BUILT)
    site = tmp_path_factory.mktemp("site")
    _run(sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", site)
    return site / "browser.html"


@pytest.fixture(scope="module")
def wanted() -> list[dict[str, Any]]:
    """Returns heights, decision, a random grasp and its outcome in each scene, by the package."""
    env, camera_policy = export.environment()
    cfg, params = camera_policy.cfg, camera_policy.params
    frames = actor_critic.make(cfg).frames
    reset, step = jax.jit(env.reset_to), jax.jit(env.step)
    look = jax.jit(lambda obs: decision.dense_maps(cfg, params, obs, False))
    draw = jax.jit(lambda key, valid: policy.random_grasp(key, frames, valid))

    def scene(number: int) -> dict[str, Any]:
        state = reset(export.scene_at(env, number))
        obs = jax.device_get(state.obs)
        ((decided,),) = camera_policy.decide_each([obs], [1], False)
        action: Action = draw(jax.random.key(number), look(obs).valid)
        after = step(state, action)
        return {
            "height": obs.height,
            "decision": decided,
            "pose": action.pose.tolist(),
            "outcome": int(after.info.outcome),
            "left": after.scene.in_play.tolist(),
        }

    return [scene(number) for number in range(GRASPS)]


@pytest.fixture(scope="module")
def measured(page: Path, wanted: list[dict[str, Any]]) -> dict[str, Any]:
    """Drives the page; returns what the driver measured."""
    mesh, results, job = (page.parent / name for name in ("brick.obj", "results.json", "job.json"))
    mesh.write_text(BRICK)
    paths = {"modules": BUILT, "chromium": CHROMIUM, "page": page, "mesh": mesh, "results": results}
    poses = {"grasps": [scene["pose"] for scene in wanted]}
    job.write_text(json.dumps({name: str(path) for name, path in paths.items()} | poses))
    _run("node", ROOT / "tests" / "browser.mjs", job)
    content: dict[str, Any] = json.loads(results.read_text())
    return content


def test_heights(measured: dict[str, Any], wanted: list[dict[str, Any]]):
    """Claim: the heights of the page's view agree with the package's to 0.1 mm."""
    heights = [scene["height"] for scene in measured["seen"]]
    np.testing.assert_allclose(heights, [one["height"].ravel() for one in wanted], atol=1e-4)


def test_decisions(measured: dict[str, Any], wanted: list[dict[str, Any]]):
    """Claim: the page decides as the ONNX file and as `CameraPolicy` with the best cell."""
    for scene, one in zip(measured["seen"], wanted, strict=True):
        for own in (scene["decision"], scene["exported"]):
            assert ("push", "grasp")[own["primitive"]] == one["decision"].primitive
            place = *one["decision"].position[:2], one["decision"].yaw
            np.testing.assert_allclose(own["pose"], place, atol=1e-5)
            np.testing.assert_allclose(own["score"], one["decision"].score, atol=1e-3)


def test_grasps(measured: dict[str, Any], wanted: list[dict[str, Any]]):
    """Claim: 19 of 20 random grasps have the same outcome and leave the same blocks as in the
    package, among them grasps that fail."""
    assert 5 <= sum(one["outcome"] == 4 for one in wanted) <= 15
    pairs = zip(measured["grasps"], wanted, strict=True)
    same = [own == {"outcome": one["outcome"], "left": one["left"]} for own, one in pairs]
    assert sum(same) >= 19


def test_clears(measured: dict[str, Any]):
    """Claim: the page clears a scene of four blocks by its button, and four that were dropped. It
    draws 20 frames/s and decides within a second, in the median."""
    clearing = measured["clearing"]
    assert clearing["before"] == 4
    assert measured["dropped"] == {"before": 4, "after": 0}
    assert np.median(clearing["frames"]) >= 20.0
    assert np.median(clearing["decisions"]) < 1000.0


def test_mesh(measured: dict[str, Any]):
    """Claim: a brick of an OBJ file, 30 x 40 x 50 mm, away from its origin, comes to rest on the
    table, and the view shows its upper face."""
    mesh = measured["mesh"]
    assert mesh["inPlay"]
    np.testing.assert_allclose(mesh["height"], 2.0 * mesh["centre"], atol=1e-3)
    assert np.min(np.abs(mesh["centre"] - np.array([0.015, 0.02, 0.025]))) < 1e-3


def test_works_offline(measured: dict[str, Any]):
    """Claim: the page loads from the file system without an error and without a request to a
    host; the site's search works there, too."""
    assert measured["faults"] == []
    assert any(link.startswith("file:") for link in measured["found"])
