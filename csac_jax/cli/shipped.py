"""`csac-jax policies`: the policies that come with the package."""

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

from csac_jax.cli import output, parsing


class Measured(NamedTuple):
    """A recorded result: shares of lifted grasps and of completed episodes, %."""

    suite: str
    grasp_success: float
    completion: float


MEASURED = {
    "shipped": Measured("pile", 98.3, 98.0),
    "shipped_clutter": Measured("random30", 97.0, 83.0),
}
"""The result of each in the suite that it is for; docs/results.md has intervals and records."""


@dataclasses.dataclass(frozen=True)
class PoliciesOptions:
    """Lists the policies that come with the package: what they are for, and a result of each."""

    json: Path | None = None
    """File to write the list to, as JSON."""


def run(arguments: list[str]) -> int:
    """Prints the table; returns the exit code."""
    options = parsing.parse(PoliciesOptions, arguments, "policies")
    rows = table()
    for row in rows:
        made = f"{row['objects']}, {row['task']}; hand {row['hand']}; {row['sees']}"
        print(f"{row['name']:17s}{made}")
        shares = "{grasp_success} % of grasps lift, {completion} % of episodes complete"
        print(f"{'':17s}{row['suite']}: {shares.format(**row)}")
    output.write_result(options.json, {"policies": rows})
    return 0


def table() -> list[dict[str, Any]]:
    """Returns a row for each policy that ships; of its config all but the result."""
    from csac_jax.io import made_for, policy_file

    configs = {name: policy_file.load(path)[0] for name, path in policy_file.SHIPPED.items()}
    return [
        {
            "name": name,
            "task": made_for.task(cfg),
            "objects": made_for.objects(cfg),
            "hand": made_for.hand(cfg),
            "sees": made_for.view(cfg) + ", and a mask" * cfg.task.has_target,
            **MEASURED[name]._asdict(),
        }
        for name, cfg in configs.items()
    ]
