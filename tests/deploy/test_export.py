"""Exported policies: run by jax alone and by onnxruntime alone, they decide as the policy does."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax import cli, presets
from csac_jax.agent import actor_critic
from csac_jax.config import Config
from csac_jax.deploy import CameraPolicy, export, program
from csac_jax.io import policy_file
from csac_jax.vision.heightmap import Observation
from tests.deploy import scenes

pytest.importorskip("flatbuffers")
onnxruntime = pytest.importorskip("onnxruntime")
pytest.importorskip("onnx")

TOLERANCE = 1e-4  # largest difference of any number
NAMES = ("primitive", "pose", "score", "valid", "stations")
IMAGE = scenes.take(scenes.blocks_at([[0.1, 0.09, 0.4], [-0.1, -0.02, 1.0], [0.05, -0.12, 2.0]]))
LENS = np.float32([IMAGE.intrinsics[name] for name in ("fx", "fy", "cx", "cy")])

# A process that may import one runtime and NumPy, but nothing of this package or under it.
_ALONE = """
import sys
for name in ("csac_jax", "mujoco", "flax", "optax", "orbax", "chex", {others}):
    sys.modules[name] = None
import json
import numpy as np
given = np.load(sys.argv[2])
arrays = {{name: given[name] for name in given.files}}
{call}
print(json.dumps([np.asarray(one).tolist() for one in found]))
"""
_BY_JAX = _ALONE.format(
    others="",
    call="from jax import export\nblob = bytearray(open(sys.argv[1], 'rb').read())\n"
    "found = export.deserialize(blob).call(*arrays.values())",
)
_BY_ONNXRUNTIME = _ALONE.format(
    others="'jax', 'jaxlib', 'onnx'",
    call="import onnxruntime\nfound = onnxruntime.InferenceSession(sys.argv[1]).run(None, arrays)",
)


def _alone(script: str, file: Path, **arrays: np.ndarray) -> list[Any]:
    """What an exported file returns in a process of its own."""
    np.savez(file.with_suffix(".npz"), **arrays)
    command = [sys.executable, "-c", script, str(file), str(file.with_suffix(".npz"))]
    env = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    done = subprocess.run(command, capture_output=True, text=True, cwd=file.parent, env=env)
    assert done.returncode == 0, done.stderr
    return [np.array(one) for one in json.loads(done.stdout)]


@pytest.fixture(scope="module")
def policy() -> CameraPolicy:
    return CameraPolicy.load("shipped")


@pytest.fixture(scope="module")
def obs(policy: CameraPolicy) -> Observation:
    view = IMAGE.rgb.reshape(-1, 3), IMAGE.depth
    depth = np.nan_to_num(view[1])
    points = np.asarray(export._points(depth, LENS, IMAGE.pose.astype(np.float32))).reshape(-1, 3)
    seen = jax.jit(lambda *pixels: program.observe(policy.cfg, *pixels, None))
    return jax.device_get(seen(points, depth.reshape(-1) > 0, view[0]))


def _assert_close(found: list[Any], wanted: Any) -> None:
    for name, one, other in zip(NAMES, found, wanted, strict=False):
        np.testing.assert_allclose(one, np.asarray(other), atol=TOLERANCE, rtol=0, err_msg=name)


def test_stablehlo_of_maps(policy: CameraPolicy, obs: Observation, tmp_path: Path, capsys: Any):
    """Claim: jax alone computes from maps what the policy does, to 1e-4."""
    file = tmp_path / "policy.stablehlo"
    assert cli.main(["export", "shipped", str(file), "--format", "stablehlo"]) == 0
    assert f"wrote {file}, {file.stat().st_size} bytes" in capsys.readouterr().out
    found = _alone(_BY_JAX, file, colour=obs.colour, height=obs.height)
    decide, _ = export.from_maps(policy.cfg, policy.params)
    _assert_close(found, jax.jit(decide)(obs.colour, obs.height))


@pytest.mark.slow
def test_stablehlo_of_an_image(policy: CameraPolicy, tmp_path: Path):
    """Claim: jax alone computes from an image what `CameraPolicy.decide` returns."""
    file, depth = tmp_path / "policy.stablehlo", np.nan_to_num(IMAGE.depth)
    options = ["--format", "stablehlo", "--input", "image"]
    assert cli.main(["export", "shipped", str(file), *options]) == 0
    pose = IMAGE.pose.astype(np.float32)
    found = _alone(_BY_JAX, file, rgb=IMAGE.rgb, depth=depth, lens=LENS, pose=pose)
    (decision,) = policy.decide(*IMAGE)
    assert ("push", "grasp")[int(found[0])] == decision.primitive
    np.testing.assert_allclose(found[1][:2], decision.position[:2], atol=1e-3)
    np.testing.assert_allclose(found[2], decision.score, atol=1e-3)
    places = [waypoint.position for waypoint in decision.waypoints]
    np.testing.assert_allclose(found[4][:, :3], places, atol=1e-3)


def test_onnx(policy: CameraPolicy, obs: Observation, tmp_path: Path):
    """Claim: onnxruntime alone computes Q and the best cell's action as the policy, to 1e-4."""
    file = tmp_path / "policy.onnx"
    assert cli.main(["export", "shipped", str(file), "--format", "onnx"]) == 0
    found = _alone(_BY_ONNXRUNTIME, file, colour=obs.colour, height=obs.height)
    cfg = policy.cfg.change(policy={"place": "argmax"})
    decide, _ = export.from_maps(cfg, policy.params)
    _assert_close(found, jax.jit(decide)(obs.colour, obs.height))
    state = jax.jit(lambda o: program.dense_maps(cfg, policy.params, o, False))(obs)
    np.testing.assert_allclose(found[5], state.q, atol=TOLERANCE, rtol=0)


def _random(cfg: Config, seed: int) -> tuple[Any, Observation]:
    """Networks that no training gives, and a map with boxes in it, half of them targets."""
    rng, size = np.random.default_rng(seed), cfg.heightmap.size
    blank = actor_critic.abstract_params(cfg)
    params = jax.tree.map(lambda leaf: rng.normal(0.0, 0.2, leaf.shape).astype("f4"), blank)
    height = rng.uniform(0.0, 0.009, (size, size)).astype(np.float32)  # seen, too low to act on
    target = np.zeros((size, size), bool)
    for number in range(4):
        row, col = rng.integers(2, size - 10, 2)
        height[row : row + 8, col : col + 6] = rng.uniform(0.02, 0.08)
        target[row : row + 8, col : col + 6] = number % 2 == 0
    colour = rng.uniform(size=(size, size, 3)).astype(np.float32)
    return params, Observation(colour, height, target, program.fingers(cfg))


SETTINGS: dict[str, dict[str, Any]] = {
    "quick": {"heightmap": {"size": 64}},
    "target": {"task": {"kind": "target"}, "learn": {"critics": 2}},
    "heights": {"net": {"colour": False, "stride": 4, "subcells": 2, "dilations": (1, 2)}},
    "gripper": {"net": {"gripper": True}, "task": {"kind": "target"}, "sim": {"gripper": "2f85"}},
    "mirrored": {"policy": {"augment": True}, "learn": {"critics": 2}, "net": {"subcells": 2}},
    "topmost": {"policy": {"height_bonus": 3.0}, "net": {"growth": 4, "stem": 4}},
    "anywhere": {"policy": {"cells": "all"}, "net": {"growth": 4, "stem": 4}},
    "grasp": {
        "policy": {"primitive": "grasp"},
        "explore": {"push_fraction": 0.0},
        "net": {"growth": 4, "stem": 4, "margin": 0.5},
    },
}


@pytest.mark.parametrize("name", SETTINGS)
@pytest.mark.parametrize("empty", [False, True])
def test_onnx_of_other_nets(name: str, empty: bool):
    """Claim: so it does with other tasks, strides, groups and inputs, to 1e-4 of the largest Q;
    and on the empty table nothing is valid, unless actions may begin anywhere."""
    from csac_jax.deploy import onnx_graph

    cfg = presets.smoke().change(**SETTINGS[name])
    cfg = cfg.change(policy={"place": "argmax"})
    can_act = not empty or cfg.policy.cells == "all"
    params, obs = _random(cfg, 3)
    if empty:
        obs = obs.replace(height=np.zeros_like(obs.height))
    shown = [obs.colour, obs.height, *([obs.target] if cfg.task.kind == "target" else [])]
    session = onnxruntime.InferenceSession(onnx_graph.make(cfg, params))
    inputs = dict(zip(("colour", "height", "target"), shown, strict=False))
    found = session.run(None, inputs)
    decide, shapes = export.from_maps(cfg, params)
    assert len(shapes) == len(shown)
    look = jax.jit(lambda o: program.dense_maps(cfg, params, o, False))
    state = look(jax.tree.map(jnp.asarray, obs))
    q = state.q
    np.testing.assert_array_equal(found[6], state.valid)
    scale = max(1.0, float(jnp.abs(q).max()))
    np.testing.assert_allclose(found[5], q, atol=TOLERANCE * scale, rtol=0)
    primitive, pose, score, valid, stations = jax.jit(decide)(*shown)
    assert bool(found[3]) == bool(valid) == can_act
    if can_act:
        assert int(found[0]) == int(primitive)
        np.testing.assert_allclose(found[1], pose, atol=TOLERANCE)
        np.testing.assert_allclose(found[2], score, atol=TOLERANCE * scale)
        np.testing.assert_allclose(found[4], stations, atol=TOLERANCE)


def test_policy_file_of_a_policy_file(policy: CameraPolicy, tmp_path: Path):
    """Claim: safetensors of the shipped policy is the shipped policy, with a digest."""
    file = tmp_path / "copy.safetensors"
    assert cli.main(["export", "shipped", str(file)]) == 0
    cfg, params = policy_file.load(file)
    assert cfg == policy.cfg
    jax.tree.map(np.testing.assert_array_equal, params, jax.device_get(policy.params))


def test_policy_file_that_decides_otherwise(policy: CameraPolicy, tmp_path: Path):
    """Claim: a policy file is written with what --augment, --height-bonus and --retry ask for."""
    file = tmp_path / "high.safetensors"
    asked = ["--augment=on", "--height-bonus=3", "--retry=0.1"]
    assert cli.main(["export", "shipped", str(file), *asked]) == 0
    cfg, params = policy_file.load(file)
    assert cfg == policy.cfg.change(policy={"augment": True, "height_bonus": 3.0, "retry": 0.1})
    jax.tree.map(np.testing.assert_array_equal, params, jax.device_get(policy.params))


def test_average_of_policies(policy: CameraPolicy, tmp_path: Path):
    """Claim: `--average` writes the mean of each number of two policies, and the config of one."""
    other, file = tmp_path / "other.safetensors", tmp_path / "mean.safetensors"
    tripled = jax.tree.map(lambda leaf: 3.0 * leaf, policy.params)
    policy_file.save(other, tripled, policy.cfg.change(seed=7))
    assert cli.main(["export", "shipped", str(file), "--average", str(other)]) == 0
    cfg, params = policy_file.load(file)
    assert cfg == policy.cfg
    jax.tree.map(
        lambda mean, one: np.testing.assert_array_equal(mean, 2.0 * one), params, policy.params
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("p.safetensors --average shipped_target", "--average shipped_target: has critic.params."),
        ("p.safetensors --height-bonus 200", "policy.height_bonus: must lie in 0 .. 100"),
        ("p.safetensors --retry 20", "policy.retry: must lie in 0 .. 10"),
        ("p.onnx", "p.onnx: the name of a policy file ends in .safetensors, see --format"),
        ("p.bin --format onnx", "p.bin: the name of a program ends in .onnx, see --format"),
        ("p.onnx --format onnx --input image", "--input image: needs --format stablehlo"),
        ("p.stablehlo --format stablehlo --size 8 8", "--size: both numbers must lie in 16"),
    ],
)
def test_bad_options_of_export(
    capsys: pytest.CaptureFixture, tmp_path: Path, monkeypatch: Any, arguments: str, message: str
):
    """Claim: a format that does not fit is refused with exit code 2, and nothing is written."""
    monkeypatch.chdir(tmp_path)
    assert cli.main(["export", "shipped", *arguments.split()]) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_densenet_has_no_onnx():
    """Claim: a net that the graph does not know is refused by name."""
    from csac_jax.deploy import onnx_graph
    from csac_jax.errors import SettingsError

    with pytest.raises(SettingsError, match=r"knows --net\.kind small only; take stablehlo"):
        onnx_graph.make(presets.paper(), None)
