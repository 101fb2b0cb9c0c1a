"""What commands read from files: the config of a run, a policy, weights."""

from pathlib import Path
from typing import Any

from csac_jax.cli.errors import FailedError, as_bad_arguments, as_failure
from csac_jax.config import Config


def config(run_dir: Path) -> Config:
    """The config that a run was trained with."""
    from csac_jax.io import checkpoint

    if not run_dir.is_dir():
        raise FailedError(f"there is no folder {run_dir}; give the folder of a run")
    with as_failure(checkpoint.CheckpointError):
        return checkpoint.load_config(run_dir)


def policy(source: str, kind: str = "learned") -> Any:
    """The policy of a kind, see `evaluation.policies.POLICIES`, with the config of a source."""
    from csac_jax.evaluation import policies
    from csac_jax.io import checkpoint, policy_file

    with as_failure(policy_file.PolicyFileError, checkpoint.CheckpointError, FileNotFoundError):
        return policies.POLICIES[kind](source)


def weights(cfg: Config) -> Any:
    """Variables of the trunk that the networks begin with, None for random ones."""
    if not cfg.net.weights:
        return None
    from csac_jax.io import weights as files

    with as_bad_arguments(ValueError):
        return files.read(cfg.net)
