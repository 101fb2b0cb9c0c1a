"""Trackers, each by its own library, offline, and read back by that library."""

import dataclasses
import struct
import time
from pathlib import Path
from typing import Any

import pytest

from csac_jax import presets
from csac_jax.io import configs
from csac_jax.training import trackers
from csac_jax.training.callbacks import Record, RunInfo, Summary

CFG = presets.smoke()
BLANK = {field.name: 1 for field in dataclasses.fields(Record)}
TABLE = {"grasp_success": {"value": 0.5}, "completion": {"value": None}, "counts": {"grasps": 4}}
DONE = Summary(4, 8, 1.0, 0.0, None, 0, None)
Points = dict[str, list[tuple[int, float]]]  # name -> actions and value, in their order


def _follow(tracker: trackers.Tracker, folder: Path, pause: float = 0.0) -> None:
    """Tracks a run that is stopped and, after a pause, s, resumed, with an evaluation."""
    folder.mkdir(parents=True)
    for step, success in ((0, 0.25), (4, 0.75)):
        changed = {"actions": 8 + 2 * step, "grasp_success": success, "critic_loss": None}
        record = Record(**BLANK | changed | {"outcomes": {"lifted": 3}})
        tracker.begin(RunInfo(CFG, folder, step))
        tracker.chunk(record, None)
        if step == 0:
            tracker.evaluated(record, TABLE)
        tracker.end(DONE)
        time.sleep(pause)


def _check(found: Points) -> None:
    """Checks that every number is there, over actions, and that no None is."""
    assert found["grasp_success"] == [(8, 0.25), (16, 0.75)]
    assert found["outcomes/lifted"] == [(8, 3.0), (16, 3.0)]
    assert found["eval/grasp_success"] == [(8, 0.5)]
    names = set(BLANK) - {"outcomes", "critic_loss"}
    assert {name for name in found if "/" not in name} - {"actions"} == names - {"actions"}
    assert not {"critic_loss", "eval/completion", "eval/counts"} & set(found)


def test_tensorboard(tmp_path: Path):
    """Claim: TensorBoard's files hold every number over actions; a resumed run voids what a killed
    process wrote after the step that it resumes from."""
    pytest.importorskip("tensorboardX")
    from tensorboardX.proto import event_pb2

    _follow(trackers.TensorBoard(), tmp_path / "run")
    found: Points = {}
    purged = []
    files = (tmp_path / "run/tensorboard").iterdir()
    for path in sorted(files, key=lambda file: int(file.suffix[1:])):
        content = path.read_bytes()
        while content:
            (length,) = struct.unpack("<Q", content[:8])
            event = event_pb2.Event.FromString(content[12 : 12 + length])
            content = content[16 + length :]
            if event.session_log.status == event_pb2.SessionLog.START:
                purged.append(event.step)
            for value in event.summary.value:
                found.setdefault(value.tag, []).append((event.step, value.simple_value))
    _check(found)
    assert purged == [1, 9]


def _leveldb_log(content: bytes) -> list[bytes]:
    """Reads the records of a file in LevelDB's log format, after a head of 7 bytes."""
    records, at = [b""], 7
    while at + 7 <= len(content):
        if (left := 32768 - at % 32768) < 7:
            at += left
            continue
        _, length, kind = struct.unpack("<IHB", content[at : at + 7])
        records[-1] += content[at + 7 : at + 7 + length]
        records += [b""] * (kind in (1, 4))  # whole, or its last part
        at += 7 + length
    return records[:-1]


def test_wandb(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: an offline run of Weights & Biases holds config and every number; a resumed one has
    its id."""
    pytest.importorskip("wandb")
    from wandb.proto import wandb_internal_pb2

    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    _follow(trackers.WandB(), tmp_path / "run", pause=1.1)  # its folders are named by the second
    found: Points = {}
    ids, settings = set(), {}
    for path in sorted((tmp_path / "run/wandb").glob("offline-run-*/*.wandb")):
        for data in _leveldb_log(path.read_bytes()):
            record = wandb_internal_pb2.Record.FromString(data)
            if record.HasField("run"):
                ids.add(record.run.run_id)
                settings |= {one.key: one.value_json for one in record.run.config.update}
            values = {
                one.key or one.nested_key[0]: float(one.value_json) for one in record.history.item
            }
            for name in values.keys() - {"_step", "_timestamp", "_runtime"}:
                found.setdefault(name, []).append((int(values["actions"]), values[name]))
    found = {name: sorted(set(points)) for name, points in found.items()}
    _check(found)
    assert ids == {(tmp_path / "run/wandb-id").read_text()}
    assert settings["preset"] == '"smoke"'


@pytest.mark.slow
def test_mlflow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: one run of MLflow, in mlflow.db next to the run's folder, holds config and every
    number."""
    mlflow = pytest.importorskip("mlflow")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    _follow(trackers.MLflow(), tmp_path / "run")
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    (run,) = client.search_runs([client.get_experiment_by_name("csac_jax").experiment_id])
    history: Any = {
        name: client.get_metric_history(run.info.run_id, name) for name in run.data.metrics
    }
    _check({name: [(one.step, one.value) for one in points] for name, points in history.items()})
    wanted = configs.flat(configs.to_dict(CFG))
    assert run.data.params == {name: str(value) for name, value in wanted.items()}
    assert (run.info.status, run.info.run_name) == ("FINISHED", "run")


def test_parts_of_a_suite_have_their_names():
    """Claim: an evaluation of several parts is logged part by part."""
    parts = {"parts": {"hole": TABLE, "row": TABLE}}
    wanted = {"eval/hole/grasp_success": 0.5, "eval/row/grasp_success": 0.5}
    assert trackers.eval_scalars(parts) == wanted
