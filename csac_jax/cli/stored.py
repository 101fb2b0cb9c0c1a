"""What commands read from files: the config of a run, a policy."""

from pathlib import Path
from typing import Any

from csac_jax.cli.failures import FailedError, as_failure
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


def with_networks_of(cfg: Config, source: str) -> Config:
    """The config with networks of the sizes of a policy, to start from it."""
    from csac_jax import api
    from csac_jax.io import checkpoint, policy_file

    with as_failure(policy_file.PolicyFileError, checkpoint.CheckpointError, FileNotFoundError):
        return api.with_networks_of(cfg, source)
