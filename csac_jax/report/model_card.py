"""A model card beside a policy file: README.md as model hubs read it.

Its head has the results as `model-index`, whose keys are those of
https://github.com/huggingface/hub-docs/blob/main/modelcard.md.
"""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from csac_jax.config import Config
from csac_jax.io import configs, files, made_for
from csac_jax.report import cells, results, suite_table, variants
from csac_jax.section import require

CARD = "README.md"
HEAD = {
    "license": "apache-2.0",
    "library_name": "csac_jax",
    "pipeline_tag": "robotics",
    "tags": ["robotics", "reinforcement-learning", "grasping", "jax"],
}
LIMITS = """\
- Grasps come straight down in a square of 448 mm on a flat table.
- Objects are rigid, and fit between the open fingers.
- It was trained in simulation only.
- Another hand, view, task or kind of objects than in its training lowers these numbers."""


def read(paths: Sequence[Path]) -> list[dict[str, Any]]:
    """Reads results of networks from files and folders. Raises SettingsError if there is none."""
    evaluated = [one for one in results.read(paths).suites if one["policy"] == "learned"]
    require(bool(evaluated), f"--card: no result of `eval` in {', '.join(map(str, paths))}")
    return evaluated


def write(
    file: Path, cfg: Config, evaluated: Sequence[dict[str, Any]], record: dict[str, Any]
) -> Path:
    """Writes the card of a policy file, see `text`; returns the card's path."""
    files.replace(card := file.with_name(CARD), text(file, cfg, evaluated, record))
    return card


def text(
    file: Path, cfg: Config, evaluated: Sequence[dict[str, Any]], record: dict[str, Any]
) -> str:
    """Returns the card of a policy file with its results; `record` is the `train.json` of its run,
    or empty."""
    head = {**HEAD, "model-index": model_index(file.stem, evaluated)}
    front = yaml.safe_dump(head, sort_keys=False, allow_unicode=True)
    table = suite_table.markdown(suite_table.rows(evaluated))
    about = cells.table_text(_about(file, cfg, record))
    seen = f"{made_for.view(cfg)}{', and a mask' * cfg.task.has_target}"
    made = f"{made_for.objects(cfg)}, {made_for.task(cfg)}; hand {made_for.hand(cfg)}; sees {seen}"
    use = f"    csac-jax play --policy {file.name} --video episode.webp"
    parts = (f"# {file.stem}", f"A policy of csac_jax for {made}.", use, about)
    body = "\n\n".join([*parts, "## Results", table.rstrip(), "## Limitations", LIMITS])
    return f"---\n{front}---\n\n{body}\n"


def model_index(name: str, evaluated: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Builds the `model-index` of a model: an entry for each part of each result of `eval`, with
    the metrics of `suite_table` that have cases."""
    entries = []
    for result in evaluated:
        for part, summary in suite_table.parts(result):
            shares = {metric: summary.get(metric) for metric in suite_table.METRICS}
            scored = [
                {"type": metric, "name": suite_table.METRICS[metric], "value": share["value"]}
                for metric, share in shares.items()
                if share and share["n"]
            ]
            asked = {"episodes": result["episodes"], "seed": result["seed"]}
            dataset = {"type": f"csac_jax/{result['suite']}", "name": part, "args": asked}
            task = {"type": "robotics", "name": "grasping in clutter"}
            entries.append({"task": task, "dataset": dataset, "metrics": scored})
    return [{"name": name, "results": entries}]


def _about(file: Path, cfg: Config, record: dict[str, Any]) -> cells.ResultTable:
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    command = variants.train_command(record.get("config") or configs.to_dict(cfg))
    rows = {
        "licence": "Apache-2.0",
        "file": f"`{file.name}`, {file.stat().st_size:,} bytes, SHA-256 `{digest}`",
        "data": f"scenes of the preset `{cfg.preset}`, drawn and simulated in training",
        "settings as a command": f"`{command}`",
    }
    if record.get("wall_seconds") is not None:
        rows["time"] = (
            f"{record['wall_seconds']:.0f} s on {record.get('device', 'an unknown device')}"
        )
    return [{"": name, "value": value} for name, value in rows.items()]
