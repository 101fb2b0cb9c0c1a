"""Writes the model card beside the policy `shipped`: `python -m experiments.card`."""

import json

from csac_jax.io import files, policy_file, renames
from csac_jax.report import model_card
from experiments import index, summary

NAME = "shipped"
FILE = policy_file.SHIPPED[NAME]
CARD = FILE.with_suffix(".md")
DEVICE = "one NVIDIA H200"  # that trained it


def text() -> str:
    """Returns the card, with the recorded training and evaluations."""
    folder, suites = summary.POLICIES[NAME]
    evaluated = [index.record(f"{folder}/eval-{suite}.json") | {"name": NAME} for suite in suites]
    config = renames.current(index.record(f"{folder}/config.json"))
    archive = index.RESULTS / f"{folder.partition('/')[0]}.tar.xz"
    last = index.contents(archive)[f"{folder}/{files.METRICS}"].splitlines()[-1]
    record = {"config": config, "wall_seconds": json.loads(last)["seconds"], "device": DEVICE}
    return model_card.text(FILE, policy_file.load(FILE)[0], evaluated, record)


if __name__ == "__main__":
    files.replace(CARD, text())
