"""`csac-jax export`: a run's policy as one small file."""

import dataclasses
from pathlib import Path

import tyro

from csac_jax.cli import parsing
from csac_jax.cli.failures import BadArgumentsError


@dataclasses.dataclass(frozen=True)
class ExportOptions:
    """Writes a run's policy, networks and config, into one file for `eval` and `play`."""

    run_dir: tyro.conf.Positional[Path]
    """Folder of the run."""
    file: tyro.conf.Positional[Path]
    """File to write, which must not exist, such as policy.safetensors."""


def run(arguments: list[str]) -> int:
    """Writes the file; returns the exit code."""
    options = parsing.parse(ExportOptions, arguments, "export")
    if options.file.suffix != ".safetensors":
        raise BadArgumentsError(f"{options.file}: the name of a policy file ends in .safetensors")
    if options.file.exists():
        raise BadArgumentsError(f"{options.file} exists; give another name")
    from csac_jax.evaluation import policies
    from csac_jax.io import policy_file

    policy = policies.load(options.run_dir)
    policy_file.save(options.file, policy.params, policy.cfg)
    print(f"wrote {options.file}, {options.file.stat().st_size} bytes")
    return 0
