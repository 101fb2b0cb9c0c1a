"""Policies as files."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import safetensors.numpy

from csac_jax import presets
from csac_jax.agent import actor_critic
from csac_jax.agent.actor_critic import Params
from csac_jax.io import configs, policy_file

CFG = presets.get("smoke")


@pytest.fixture(scope="module")
def params() -> Params:
    """Variables of the networks of CFG, all different."""
    blank = actor_critic.abstract_params(CFG)
    leaves, tree = jax.tree.flatten(blank)
    rng = np.random.default_rng(0)
    return jax.tree.unflatten(
        tree, [rng.normal(size=leaf.shape).astype(leaf.dtype) for leaf in leaves]
    )


def _rewrite(path: Path, change: Callable[[dict[str, Any], dict[str, str]], None]) -> None:
    """The file with its tensors and remarks changed."""
    tensors = safetensors.numpy.load_file(path)
    remarks = {"config": json.dumps(configs.to_dict(CFG))}
    change(tensors, remarks)
    safetensors.numpy.save_file(tensors, path, remarks)


def test_what_is_read_is_what_was_written(tmp_path: Path, params: Params):
    """Claim: a policy file gives back the config and every variable, bit for bit."""
    path = tmp_path / "new" / "policy.safetensors"
    policy_file.save(path, params, CFG)
    cfg, again = policy_file.load(path)
    assert cfg == CFG
    assert jax.tree.structure(again) == jax.tree.structure(params)
    jax.tree.map(np.testing.assert_array_equal, again, params)
    assert [file.name for file in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda tensors, remarks: tensors.pop("actor.params.Dense_0.bias"),
            r"actor\.params\.Dense_0\.bias as nothing",
        ),
        (
            lambda tensors, remarks: tensors.update(more=np.zeros(2)),
            r"more as float64\[2\], its config asks for nothing",
        ),
        (
            lambda tensors, remarks: tensors.update(
                {"actor.params.Dense_0.bias": np.zeros(9, np.float32)}
            ),
            r"actor\.params\.Dense_0\.bias as float32\[9\]",
        ),
        (lambda tensors, remarks: remarks.pop("config"), "holds no config"),
        (
            lambda tensors, remarks: remarks.update(config='{"format": 2, "sweep": 1}'),
            r"another version of csac_jax \(sweep: unknown setting",
        ),
        (
            lambda tensors, remarks: remarks.update(config='{"seed": 1, "net": {"depth": 1}}'),
            r"another version of csac_jax \(net\.depth: unknown setting",
        ),
    ],
)
def test_other_files_are_refused(tmp_path: Path, params: Params, change: Callable, message: str):
    """Claim: a tensor that is missing, extra or misshapen is named; so is a config that is missing
    or another's."""
    path = tmp_path / "policy.safetensors"
    policy_file.save(path, params, CFG)
    _rewrite(path, change)
    with pytest.raises(policy_file.PolicyFileError, match=message):
        policy_file.load(path)


def test_what_is_no_safetensors_file_is_refused(tmp_path: Path):
    """Claim: a file of another format is one line."""
    path = tmp_path / "policy.safetensors"
    path.write_bytes(b"\x80\x04not this")
    with pytest.raises(policy_file.PolicyFileError, match=r"cannot be read as \.safetensors"):
        policy_file.load(path)


def test_shipped_policy_is_checked(tmp_path: Path, params: Params, monkeypatch: pytest.MonkeyPatch):
    """Claim: a shipped policy that was replaced, by a sound file even, is refused."""
    path = tmp_path / "clear.safetensors"
    policy_file.save(path, params, CFG)
    policy_file.load(path)
    monkeypatch.setattr(policy_file, "SHIPPED", path)
    with pytest.raises(
        policy_file.PolicyFileError, match="is not the file that this version ships"
    ):
        policy_file.load(path)


def test_shipped_policy():
    """Claim: the policy that comes with the package is at most 5 MB, what its digest says, and of
    this version."""
    assert policy_file.SHIPPED.stat().st_size <= 5e6
    cfg, params = policy_file.load(policy_file.SHIPPED)
    assert (cfg.preset, cfg.task.kind, cfg.net.kind) == ("fast", "clear", "small")
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params))
