"""The model card that `csac-jax export --card` writes."""

import hashlib
from pathlib import Path

import pytest
import yaml

from csac_jax import cli
from csac_jax.evaluation import metrics
from csac_jax.io import configs, files, policy_file, seal
from csac_jax.report import results
from experiments import card

CFG, _ = policy_file.load(policy_file.SHIPPED["shipped"])


def _result(path: Path, suite: str, policy: str = "learned", **parts: int) -> None:
    """Writes what `eval --out` does: of ten episodes so many completed, by part."""
    share = {name: metrics.wilson(completed, 10) for name, completed in parts.items()}
    shown = {name: dict.fromkeys(results.METRICS, one) for name, one in share.items()}
    content = {"policy": policy, "name": "mine", "suite": suite, "seed": 3, "episodes": 10}
    content |= {"config": configs.to_dict(CFG)}
    files.write_json(path, seal.seal(content | (shown.get(suite) or {"parts": shown})))


def test_card_has_what_hubs_read(tmp_path: Path):
    """Claim: `export --card` writes README.md beside the policy: a head in YAML with licence and
    `model-index`, an entry for each part of a suite that its networks were measured in, and a body
    with hash, training and table."""
    _result(tmp_path / "entry" / "random10.json", "random10", random10=9)
    _result(tmp_path / "entry" / "cases.json", "cases", hole=4, row=5)
    _result(tmp_path / "entry" / "floor.json", "packed", "random", packed=1)
    file = tmp_path / "out" / "mine.safetensors"
    assert cli.main(["export", "shipped", str(file), "--card", str(tmp_path / "entry")]) == 0
    _, front, body = file.with_name("README.md").read_text().split("---\n", 2)
    head = yaml.safe_load(front)
    assert (head["license"], head["library_name"]) == ("apache-2.0", "csac_jax")
    (model,) = head["model-index"]
    assert model["name"] == "mine"
    found = {one["dataset"]["name"]: one for one in model["results"]}
    assert {*found} == {"random10", "cases, hole", "cases, row"}
    assert found["cases, row"]["dataset"]["args"] == {"episodes": 10, "seed": 3}
    assert all({"type", "name"} == one["task"].keys() for one in found.values())
    scores = {one["type"]: one["value"] for one in found["random10"]["metrics"]}
    assert scores == {"grasp_success": 0.9, "completion": 0.9, "action_efficiency": 0.9}
    assert hashlib.sha256(file.read_bytes()).hexdigest() in body
    assert "`csac-jax train general --algo csac_beta --seed 1" in body
    assert "| cases, hole | mine | 10 | 40.0 %" in body


def test_shipped_policy_has_its_card():
    """Claim: the card beside `shipped` is as written from the records, and names the digest of the
    file, its time, and the suites that docs/results.md has."""
    text = card.CARD.read_text()
    assert text == card.text()
    assert policy_file._DIGESTS["shipped"] in text
    assert "| time | 758 s on one NVIDIA H200 |" in text
    for suite in ("random10", "pile", "enclosed"):
        assert f"| {suite} | shipped |" in text


@pytest.mark.parametrize("fault", ["none", "there"])
def test_card_is_refused(fault: str, tmp_path: Path, capsys: pytest.CaptureFixture):
    """Claim: without a result, or where a README.md is, there is one line and no file."""
    file = tmp_path / "mine.safetensors"
    (tmp_path / "entry").mkdir()
    if fault == "there":
        file.with_name("README.md").write_text("mine")
    assert cli.main(["export", "shipped", str(file), "--card", str(tmp_path / "entry")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert {"none": "no result of `eval`", "there": "exists; give another folder"}[fault] in line
    assert not file.exists()
