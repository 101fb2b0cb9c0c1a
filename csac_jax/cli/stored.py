"""What commands read from files: the config of a run, a policy, weights."""

from collections.abc import Callable
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


def policy(source: str) -> tuple[Config, Callable[[], Any]]:
    """Config of the policy in a run's folder, in a policy file or `shipped`, and what reads its
    networks."""
    from csac_jax.io import checkpoint, policy_file
    from csac_jax.training import step

    path = policy_file.SHIPPED if source == "shipped" else Path(source)
    if path.is_file():
        with as_failure(policy_file.PolicyFileError):
            cfg, params = policy_file.load(path)
            return cfg, lambda: params
    cfg = config(path)

    def read() -> Any:
        with as_failure(checkpoint.CheckpointError):
            return checkpoint.restore(path, step.abstract_state(cfg))[0].learner.online

    return cfg, read


def weights(cfg: Config) -> Any:
    """Variables of the trunk that the networks begin with, None for random ones."""
    if not cfg.net.weights:
        return None
    from csac_jax.io import weights as files

    with as_bad_arguments(ValueError):
        return files.read(cfg.net)
