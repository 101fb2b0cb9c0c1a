"""Trackers: callbacks that send the log of a run to TensorBoard, Weights & Biases or MLflow.

Every number is a scalar over actions: those of a record by their names, outcomes as
`outcomes/NAME`, those of an evaluation as `eval/NAME` or `eval/PART/NAME`. Each library comes with
an extra of its name. A resumed run continues the tracker's run.
"""

import dataclasses
import os
import time
from typing import Any

from csac_jax.io import configs, files
from csac_jax.training.callbacks import Callback, Record, RunInfo, Summary

PROJECT = "csac_jax"


def scalars(record: Record) -> dict[str, float]:
    """Returns the numbers of a record by name, without None."""
    numbers = dataclasses.asdict(record)
    numbers |= {f"outcomes/{name}": count for name, count in numbers.pop("outcomes").items()}
    return {name: float(number) for name, number in numbers.items() if number is not None}


def eval_scalars(table: dict[str, Any]) -> dict[str, float]:
    """Returns the values of an evaluation by name, without those of no cases."""
    parts = table.get("parts", {"": table})
    return {
        "/".join(filter(None, ("eval", part, name))): float(entry["value"])
        for part, metrics in parts.items()
        for name, entry in metrics.items()
        if entry.get("value") is not None
    }


class Tracker(Callback):
    """The base of all trackers: scalars over actions."""

    def chunk(self, record: Record, state: Any) -> None:
        self.log(scalars(record), record.actions)

    def evaluated(self, record: Record, table: dict[str, Any]) -> None:
        self.log(eval_scalars(table), record.actions)

    def log(self, values: dict[str, float], actions: int) -> None:
        """Sends the values after so many actions."""
        raise NotImplementedError


class TensorBoard(Tracker):
    """Files in RUN/tensorboard. A resumed run voids later points of a killed process."""

    def begin(self, run: RunInfo) -> None:
        from tensorboardX import SummaryWriter

        first, folder = run.step * run.cfg.train.scenes + 1, str(run.run_dir / "tensorboard")
        suffix = f".{first}"  # a second writer of the same second needs another file name
        self._writer = SummaryWriter(folder, purge_step=first, filename_suffix=suffix)

    def log(self, values: dict[str, float], actions: int) -> None:
        for name, value in values.items():
            self._writer.add_scalar(name, value, actions)
        self._writer.flush()

    def end(self, summary: Summary | None) -> None:
        self._writer.close()


class WandB(Tracker):
    """A run of the project `csac_jax`; WANDB_MODE=offline keeps it in RUN/wandb."""

    def begin(self, run: RunInfo) -> None:
        import wandb

        path = run.run_dir / "wandb-id"
        self._run = wandb.init(
            project=os.environ.get("WANDB_PROJECT", PROJECT),
            name=run.run_dir.name,
            id=path.read_text() if path.exists() else None,
            resume="allow",
            dir=run.run_dir,
            config=configs.to_dict(run.cfg),
        )
        files.replace(path, self._run.id)
        self._run.define_metric("*", step_metric="actions")

    def log(self, values: dict[str, float], actions: int) -> None:
        self._run.log(values | {"actions": actions})

    def end(self, summary: Summary | None) -> None:
        self._run.finish(exit_code=0 if summary else 1)


class MLflow(Tracker):
    """A run of the experiment `csac_jax`, at MLFLOW_TRACKING_URI or in `mlflow.db` next to RUN."""

    def begin(self, run: RunInfo) -> None:
        from mlflow import MlflowClient

        default = f"sqlite:///{run.run_dir.resolve().parent / 'mlflow.db'}"
        self._client = MlflowClient(os.environ.get("MLFLOW_TRACKING_URI", default))
        if (path := run.run_dir / "mlflow-id").exists():
            self._id = path.read_text()
            self._client.update_run(self._id, "RUNNING")
        else:
            self._id = self._begin_run(run)
            files.replace(path, self._id)

    def _begin_run(self, run: RunInfo) -> str:
        name = os.environ.get("MLFLOW_EXPERIMENT_NAME", PROJECT)
        present = self._client.get_experiment_by_name(name)
        experiment = present.experiment_id if present else self._client.create_experiment(name)
        run_id: str = self._client.create_run(experiment, run_name=run.run_dir.name).info.run_id
        for setting, value in configs.flat(configs.to_dict(run.cfg)).items():
            self._client.log_param(run_id, setting, value)
        return run_id

    def log(self, values: dict[str, float], actions: int) -> None:
        from mlflow.entities import Metric

        now = int(1000 * time.time())  # ms
        points = [Metric(name, value, now, actions) for name, value in values.items()]
        self._client.log_batch(self._id, metrics=points)

    def end(self, summary: Summary | None) -> None:
        done = summary is not None and summary.stopped_by is None
        self._client.set_terminated(self._id, "FINISHED" if done else "KILLED")


TRACKERS: dict[str, type[Tracker]] = {"tensorboard": TensorBoard, "wandb": WandB, "mlflow": MLflow}
