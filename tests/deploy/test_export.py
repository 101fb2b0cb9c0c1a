"""Exported policies: run by jax alone and by onnxruntime alone, they decide as the policy does."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from csac_jax import cli, geometry, presets
from csac_jax.config import Config
from csac_jax.deploy import CameraPolicy, decision, stablehlo
from csac_jax.errors import SettingsError
from csac_jax.io import policy_file
from csac_jax.vision.heightmap import Observation
from tests.deploy import scenes
from tests.networks import random_params

pytest.importorskip("jax2onnx")
onnxruntime = pytest.importorskip("onnxruntime")
onnxruntime.set_default_logger_severity(3)

TOLERANCE = 1e-4  # largest difference of any number
NAMES = ("primitive", "pose", "score", "valid", "stations")
IMAGE = scenes.take(scenes.blocks_at([[0.1, 0.09, 0.4], [-0.1, -0.02, 1.0], [0.05, -0.12, 2.0]]))
DEPTH, POSE = np.nan_to_num(IMAGE.depth), IMAGE.pose.astype(np.float32)
LENS = np.float32([IMAGE.intrinsics[name] for name in ("fx", "fy", "cx", "cy")])

# A process that may import one runtime and NumPy, but nothing of this package or under it.
_ALONE = """
import json, sys
for name in ("csac_jax", "mujoco", "flax", "optax", "orbax", "chex", {others}):
    sys.modules[name] = None
import numpy as np
arrays = dict(np.load(sys.argv[2]))
{call}
print(json.dumps([np.asarray(result).tolist() for result in results]))
"""
_BY_JAX = _ALONE.format(
    others="",
    call="from jax import export\nblob = bytearray(open(sys.argv[1], 'rb').read())\n"
    "results = export.deserialize(blob).call(*arrays.values())",
)
_BY_ONNXRUNTIME = _ALONE.format(
    others="'jax', 'jaxlib', 'onnx'",
    call="import onnxruntime\nsession = onnxruntime.InferenceSession(sys.argv[1])\n"
    "results = session.run(None, arrays)",
)


def _alone(
    policy: str, script: str, file: Path, *options: str, **arrays: np.ndarray
) -> list[np.ndarray]:
    """Exports a policy and runs the file in a process of its own."""
    assert cli.main(["export", policy, str(file), *options]) == 0
    np.savez(file.with_suffix(".npz"), **arrays)
    command = [sys.executable, "-c", script, str(file), str(file.with_suffix(".npz"))]
    env = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    done = subprocess.run(command, capture_output=True, text=True, cwd=file.parent, env=env)
    assert done.returncode == 0, done.stderr
    return [np.array(result) for result in json.loads(done.stdout)]


@pytest.fixture(scope="module")
def policy(tiny: str) -> CameraPolicy:
    return CameraPolicy.load(tiny)


@pytest.fixture(scope="module")
def shown(policy: CameraPolicy) -> dict[str, np.ndarray]:
    obs = jax.device_get(policy.observe(*IMAGE))
    return {"colour": obs.colour, "height": obs.height}


def _assert_close(results: list[Any], cfg: Config, params: Any, *maps: Any, scale: float) -> None:
    """Compares with the policy in jax."""
    wanted = jax.jit(stablehlo.from_maps(cfg, params)[0])(*maps)
    for name, result, value in zip(NAMES, results, wanted, strict=False):
        atol = TOLERANCE * (scale if name == "score" else 1.0)
        np.testing.assert_allclose(result, value, atol=atol, rtol=0, err_msg=name)


def test_stablehlo_of_maps(
    policy: CameraPolicy, shown: Any, tiny: str, tmp_path: Path, capsys: Any
):
    """Claim: jax alone computes from maps what the policy does, to 1e-4."""
    file = tmp_path / "policy.stablehlo"
    results = _alone(tiny, _BY_JAX, file, "--format", "stablehlo", **shown)
    assert f"wrote {file}, {file.stat().st_size} bytes" in capsys.readouterr().out
    _assert_close(results, policy.cfg, policy.params, *shown.values(), scale=1.0)


@pytest.mark.slow
def test_stablehlo_of_an_image(policy: CameraPolicy, tiny: str, tmp_path: Path):
    """Claim: jax alone computes from an image what `CameraPolicy.decide` returns."""
    options = ["--format", "stablehlo", "--input", "image"]
    image = {"rgb": IMAGE.rgb, "depth": DEPTH, "lens": LENS, "pose": POSE}
    results = _alone(tiny, _BY_JAX, tmp_path / "policy.stablehlo", *options, **image)
    (decision,) = policy.decide(*IMAGE)
    assert ("push", "grasp")[int(results[0])] == decision.primitive
    np.testing.assert_allclose(results[1][:2], decision.position[:2], atol=1e-3)
    np.testing.assert_allclose(results[2], decision.score, atol=1e-3)
    places = [waypoint.position for waypoint in decision.waypoints]
    np.testing.assert_allclose(results[4][:, :3], places, atol=1e-3)


def test_onnx(policy: CameraPolicy, shown: Any, tiny: str, tmp_path: Path):
    """Claim: onnxruntime alone computes Q and the best cell's action as the policy, to 1e-4."""
    results = _alone(tiny, _BY_ONNXRUNTIME, tmp_path / "policy.onnx", "--format", "onnx", **shown)
    cfg = policy.cfg.change(policy={"place": "argmax"})
    _assert_close(results, cfg, policy.params, *shown.values(), scale=1.0)
    look = jax.jit(lambda obs: decision.dense_maps(cfg, policy.params, obs, False))
    np.testing.assert_allclose(results[5], look(policy.observe(*IMAGE)).q, atol=TOLERANCE, rtol=0)


def _random(cfg: Config) -> tuple[Any, Observation]:
    """Draws networks that no training gives, and a map with boxes, half of them targets."""
    rng, rows = np.random.default_rng(3), (cfg.heightmap.size,) * 2
    params = random_params(cfg, 3, 0.2)
    height = rng.uniform(0.0, 0.009, rows).astype(np.float32)  # seen, too low to act on
    target = np.zeros(rows, bool)
    for number in range(4):
        row, col = rng.integers(2, rows[0] - 10, 2)
        height[row : row + 8, col : col + 6] = rng.uniform(0.02, 0.08)
        target[row : row + 8, col : col + 6] = number % 2 == 0
    colour = rng.uniform(size=(*rows, 3)).astype(np.float32)
    return params, Observation(colour, height, target, decision.fingers(cfg))


SETTINGS: dict[str, dict[str, Any]] = {
    "gripper": {"net": {"gripper": True}, "task": {"kind": "target"}, "sim": {"gripper": "2f85"}},
    "heights": {"net": {"colour": False, "stride": 4, "subpixel": 2, "dilations": (1, 2)}},
    "mirrored": {"policy": {"augment": True}, "learn": {"critics": 2}, "net": {"subpixel": 2}},
    "fit": {"net": {"fit": True, "gripper": True}, "sim": {"gripper": "2f85"}},
    "anywhere": {"policy": {"action_mask": "none", "height_bonus": 3.0}},
    "grasp": {"policy": {"primitive": "grasp"}, "explore": {"push_fraction": 0.0}},
}
SETTINGS["anywhere"] |= {"net": {"growth": 4, "stem": 4}}
SETTINGS["grasp"] |= {"heightmap": {"size": 48}, "learn": {"critics": 2}}


@pytest.mark.parametrize("name", SETTINGS)
def test_onnx_of_other_nets(name: str):
    """Claim: so it does with other tasks, strides, groups and inputs, to 1e-4 of the largest Q;
    and on the empty table nothing is valid, unless actions may begin anywhere. Other nets than the
    small one are refused."""
    from csac_jax.deploy import onnx

    with pytest.raises(SettingsError, match=r"knows net\.kind small only; take stablehlo"):
        onnx.serialize(presets.paper(), None)
    cfg = presets.smoke().change(**SETTINGS[name]).change(policy={"place": "argmax"})
    params, obs = _random(cfg)
    session = onnxruntime.InferenceSession(onnx.serialize(cfg, params))
    look = jax.jit(lambda o: decision.dense_maps(cfg, params, o, False))
    for height in (obs.height, np.zeros_like(obs.height)):
        maps = [obs.colour, height, *([obs.target] if cfg.task.kind == "target" else [])]
        results = session.run(None, dict(zip(onnx.INPUTS, maps, strict=False)))
        state = look(obs.replace(height=height))
        scale = max(1.0, float(np.abs(state.q).max()))
        np.testing.assert_allclose(results[5], state.q, atol=TOLERANCE * scale, rtol=0)
        np.testing.assert_array_equal(results[6], state.valid)
        can_act = bool(height.any()) or cfg.policy.action_mask == "none"
        assert bool(results[3]) == can_act
        if can_act:
            _assert_close(results, cfg, params, *maps, scale=scale)


def test_exports_open_as_the_policy():
    """Claim: both formats move and open a grasp between close neighbours as the policy does."""
    from csac_jax.deploy import onnx

    cfg = presets.smoke().change(**SETTINGS["grasp"]).change(net={"growth": 4, "stem": 4})
    cfg = cfg.change(policy={"place": "argmax"}, sim={"opening": "fit"})
    params, obs = _random(cfg)
    waves = np.abs(np.sin(np.pi / 0.063 * np.asarray(geometry.cell_centres(cfg.heightmap))))
    posts = np.all(waves < 0.5, axis=-1)  # a grasp along a ridge would open fully
    height = np.where(posts, 0.05, 0.0).astype(np.float32)
    maps = obs.colour, height
    program = jax.export.deserialize(
        bytearray(stablehlo.serialize(*stablehlo.from_maps(cfg, params)))
    )
    session = onnxruntime.InferenceSession(onnx.serialize(cfg, params))
    for results in (
        program.call(*maps),
        session.run(None, dict(zip(onnx.INPUTS, maps, strict=False))),
    ):
        assert 0.02 < 2.0 * results[4][1, 4] < 0.1
        _assert_close(results, cfg, params, *maps, scale=1.0)


def test_policy_files(policy: CameraPolicy, tiny: str, tmp_path: Path):
    """Claim: a policy file is written with what --augment, --height-bonus and --retry ask for, and
    with a view and hand that are given, else as it is; `--average` writes the mean of each number
    of two policies, and the config of one."""
    copy, mean = tmp_path / "copy.safetensors", tmp_path / "mean.safetensors"
    asked = ["--augment=on", "--height-bonus=3", "--retry_temperature=0.1"]
    asked += ["--sim.pad-friction", "0.8", "0.8", "--sensor.grey=0.5"]
    changed: dict[str, Any] = {"augment": True, "height_bonus": 3.0, "retry_temperature": 0.1}
    world = {"sim": {"pad_friction": (0.8, 0.8)}, "sensor": {"grey": 0.5}}
    for options, changes in (([], {}), (asked, {"policy": changed, **world})):
        copy.unlink(missing_ok=True)
        assert cli.main(["export", tiny, str(copy), *options]) == 0
        cfg, params = policy_file.load(copy)
        assert cfg == policy.cfg.change(**changes)
        jax.tree.map(np.testing.assert_array_equal, params, jax.device_get(policy.params))
    policy_file.save(copy, jax.tree.map(lambda leaf: 3.0 * leaf, params), cfg.change(seed=7))
    assert cli.main(["export", tiny, str(mean), "--average", str(copy)]) == 0
    cfg, averaged = policy_file.load(mean)
    assert cfg == policy.cfg
    jax.tree.map(lambda m, one: np.testing.assert_array_equal(m, 2.0 * one), averaged, params)
