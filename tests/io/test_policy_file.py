"""Policies as files."""

import json
import os
import shutil
import tracemalloc
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy

from csac_jax import api, cli, deploy, grippers, presets
from csac_jax.agent.actor_critic import Params
from csac_jax.config import SimConfig
from csac_jax.deploy import decision
from csac_jax.errors import DataWarning, SettingsError
from csac_jax.io import configs, policy_file
from csac_jax.io.policy_file import PolicyFileError
from csac_jax.robot.primitives import Action
from tests.networks import random_params

CFG = presets.get("smoke")
BIAS = "actor.params.Dense_0.bias"
STORED = configs.to_dict(CFG)
NAMELESS = STORED | {"sim": STORED["sim"] | {"gripper": {"folder": "mine", "format": 1}}}
PAGE = Path(__file__).parents[2] / "docs" / "policies.md"


@pytest.fixture(scope="module")
def params() -> Params:
    """Variables of the networks of CFG, all different."""
    return random_params(CFG)


def _rewrite(path: Path, change: Callable[[dict[str, Any], dict[str, str]], None]) -> None:
    """Changes tensors and remarks of a file, without a digest."""
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


@pytest.mark.mjx
@pytest.mark.filterwarnings("ignore")
def test_grippers_of_one_folder_name_are_two(tmp_path: Path, params: Params):
    """Claim: of two policies whose grippers have one folder name each decides with its own fingers,
    whatever lies in the folder now; so do files that hold the numbers as a remark."""
    folder, openings = tmp_path / "my_gripper", {"wide": 0.11, "narrow": 0.066}
    for name, opening in openings.items():
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(grippers.load("rg2").folder, folder)
        numbers = json.loads((folder / grippers.NUMBERS).read_text())
        numbers["opening"]["open"] = opening
        (folder / grippers.NUMBERS).write_text(json.dumps(numbers))
        own = CFG.change(sim={"gripper": str(folder)})
        policy_file.save(tmp_path / f"{name}.safetensors", params, own)
        assert grippers.load(str(folder)).opening[1] == opening

        def as_remark(tensors: dict[str, Any], remarks: dict[str, str], numbers=numbers) -> None:
            stored = json.loads(remarks["config"])
            stored["sim"]["gripper"] = str(folder)
            remarks |= {"config": json.dumps(stored), "gripper": json.dumps(numbers)}

        older = tmp_path / f"{name}_older.safetensors"
        shutil.copy(tmp_path / f"{name}.safetensors", older)
        _rewrite(older, as_remark)
    loaded = {
        name: deploy.CameraPolicy.load(tmp_path / f"{name}.safetensors")
        for name in (*openings, *(f"{name}_older" for name in openings))
    }
    for name, policy in loaded.items():
        height = jnp.zeros((policy.cfg.heightmap.size,) * 2)
        action = Action.grasp(0.0, 0.0, 0.0)
        stations = decision.stations(policy.cfg, height, action)
        choice = decision.Choice(action, jnp.zeros(()), jnp.bool(True), stations)
        width = decision.from_choice(jax.device_get(choice), np.eye(4)).width
        assert width == pytest.approx(openings[name.split("_")[0]])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda tensors, _: tensors.pop(BIAS), rf"{BIAS} as nothing"),
        (lambda tensors, _: tensors.update(more=np.zeros(2)), r"more as float64\[2\], .* nothing"),
        (lambda tensors, _: tensors.update({BIAS: np.zeros(9, np.float32)}), r"as float32\[9\]"),
        (lambda _, remarks: remarks.pop("config"), "holds no config"),
        (
            lambda _, remarks: remarks.update(config='{"format": 2, "sweep": 1}'),
            r"another version of csac_jax \(sweep: unknown setting",
        ),
        (
            lambda _, remarks: remarks.update(config='{"seed": 1}'),
            r"another version of csac_jax \(format: None is unknown",
        ),
        (lambda _, remarks: remarks.update(config=json.dumps(NAMELESS)), "'name' is missing"),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_other_files_are_refused(tmp_path: Path, params: Params, change: Callable, message: str):
    """Claim: a tensor that is missing, extra or misshapen is named; so is a config or a gripper
    that is missing or another's; a file of another format is one line."""
    path = tmp_path / "policy.safetensors"
    policy_file.save(path, params, CFG)
    _rewrite(path, change)
    with pytest.raises(PolicyFileError, match=message):
        policy_file.load(path)
    path.write_bytes(b"\x80\x04not this")
    with pytest.raises(PolicyFileError, match=r"cannot be read as \.safetensors"):
        policy_file.load(path)


@pytest.mark.parametrize(
    "change",
    [
        {"heightmap": {"size": 2**31}},
        {"heightmap": {"size": 1024}, "net": {"rotations": 360}},
        {"net": {"head": 2**31}},
        {"cem": {"candidates": 2**31}},
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_sizes_are_checked_before_memory_is_taken(tmp_path: Path, params: Params, change: dict):
    """Claim: a policy whose config has sizes that no machine has room for is refused at once, with
    no memory taken for them."""
    path, config = tmp_path / "policy.safetensors", configs.to_dict(CFG)
    policy_file.save(path, params, CFG)
    for name, values in change.items():
        config[name] |= values
    _rewrite(path, lambda _, remarks: remarks.update(config=json.dumps(config)))
    tracemalloc.start()
    with pytest.raises(PolicyFileError, match=r"heightmap\.size|must be at most"):
        policy_file.load(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**24


@pytest.mark.parametrize("kind", ["fifo", "sparse"])
def test_only_regular_files_of_a_size_are_read(tmp_path: Path, kind: str):
    """Claim: a pipe, and a file larger than 1 GiB, are refused before they are read."""
    path = tmp_path / "policy.safetensors"
    if kind == "fifo":
        os.mkfifo(path)
    else:
        path.touch()
        os.truncate(path, 2**30 + 1)
    with pytest.raises(PolicyFileError, match="a pipe or a device, or larger than 1048576 KiB"):
        policy_file.load(path)


def test_shipped_policy_is_checked(tmp_path: Path, params: Params, monkeypatch: pytest.MonkeyPatch):
    """Claim: a shipped policy that was replaced, by a sound file even, is refused."""
    path = tmp_path / "shipped.safetensors"
    policy_file.save(path, params, CFG)
    policy_file.load(path)
    monkeypatch.setitem(policy_file._SHA256, path, policy_file._SHA256[policy_file.find("shipped")])
    with pytest.raises(PolicyFileError, match="is not the file that this version ships"):
        policy_file.load(path)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("name", "preset", "task"),
    [("shipped", "general", "both"), ("shipped_clutter", "fast", "clear")],
)
def test_shipped_policy(name: str, preset: str, task: str):
    """Claim: a policy that comes with the package is at most 5 MB, what its digest says, and of
    this version; no version of JAX is warned of. `shipped` knows any hand; without another one both
    act with the RG2. Each is named here and in docs/policies.md."""
    path = policy_file.find(name)
    assert path.stat().st_size <= 5e6
    cfg, params = policy_file.load(path)
    assert (cfg.preset, cfg.task.kind, cfg.net.kind) == (preset, task, "small")
    assert cfg.sim.gripper == SimConfig.gripper
    assert cfg.net.gripper == (name == "shipped")
    assert len(policy_file.SHIPPED) == 2
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params))
    assert f"`{name}`" in PAGE.read_text()


@pytest.mark.parametrize("name", ["general", "grippers", "target"])
def test_policies_of_earlier_versions(name: str, capsys: pytest.CaptureFixture):
    """Claim: a policy that has left the package answers with one line, exit code 2, wherever a
    policy is asked for; the line names `shipped`, with --sim.gripper for another hand."""
    source = f"shipped_{name}"
    asked = {"grippers": "--sim.gripper", "target": "mask"}.get(name, "use shipped")
    with pytest.raises(SettingsError, match=f"^{source} ships no more; use shipped.*"):
        api.load_policy(source)
    files = "--rgb a.png --depth a.png --intrinsics a.json --pose a.json"
    for command in ("play --policy {}+planner", "train fast --init {}", f"act {{}} {files}"):
        assert cli.main(command.format(source).split()) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"csac-jax: {source} ships no more; use shipped")
        assert asked in line


def test_old_file_without_digest_loads_with_a_warning(tmp_path: Path, params: Params):
    """Claim: a file of a version that wrote no digest is read, with a warning that says so."""
    path = tmp_path / "policy.safetensors"
    policy_file.save(path, params, CFG)
    _rewrite(path, lambda tensors, remarks: None)
    with pytest.warns(DataWarning, match="has no digest"):
        assert policy_file.load(path)[0] == CFG


@pytest.mark.filterwarnings("ignore")
def test_a_policy_acts_whatever_its_replay_was(tmp_path: Path, params: Params):
    """Claim: a policy whose training had another value of a former setting of the replay loads; one
    of the search for actions is refused."""

    def with_former(section: str, values: dict[str, Any]) -> Path:
        path, stored = tmp_path / f"{section}.safetensors", STORED[section] | values
        policy_file.save(path, params, CFG)
        text = json.dumps(STORED | {section: stored})
        _rewrite(path, lambda _, remarks: remarks.update(config=text))
        return path

    assert policy_file.load(with_former("replay", {"rank_by": "reward"}))[0] == CFG
    with pytest.raises(PolicyFileError, match=r"cem\.start: must be 'both'"):
        policy_file.load(with_former("cem", {"start": "actor"}))


def test_other_versions_are_named(tmp_path: Path, params: Params, monkeypatch: pytest.MonkeyPatch):
    """Claim: a policy of another version of JAX loads with a warning that names both versions."""
    name = "jax"
    here, path = policy_file.provenance.versions(), tmp_path / "policy.safetensors"
    with monkeypatch.context() as patch:
        patch.setattr(policy_file.provenance, "versions", lambda: {**here, name: "0.0.1"})
        policy_file.save(path, params, CFG)
    with pytest.warns(DataWarning, match=rf"with {name} 0\.0\.1, this is {here[name]}") as told:
        policy_file.load(path)
    assert len(told) == 1
    policy_file.save(path, params, CFG)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        policy_file.load(path)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_refused(tmp_path: Path, params: Params, value: float):
    """Claim: networks that are not finite are neither written nor read."""
    path = tmp_path / "policy.safetensors"
    policy_file.save(path, params, CFG)

    def lose(tensors: dict[str, Any], remarks: dict[str, str]) -> None:
        name = min(tensors)
        tensors[name] = np.full_like(tensors[name], value)

    _rewrite(path, lose)
    with pytest.warns(DataWarning), pytest.raises(PolicyFileError, match="is not finite"):
        policy_file.load(path)
    lost = jax.tree.map(lambda leaf: np.full_like(leaf, value), params)
    with pytest.raises(PolicyFileError, match="is not finite"):
        policy_file.save(tmp_path / "new.safetensors", lost, CFG)
    assert not (tmp_path / "new.safetensors").exists()
