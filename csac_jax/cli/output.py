"""What commands write: JSON with its provenance."""

from pathlib import Path
from typing import Any

from csac_jax.config import Config
from csac_jax.io import files


def write_result(path: Path | None, result: dict[str, Any], cfg: Config | None = None) -> None:
    """Writes a result with its config and provenance, if there is a path."""
    if path is None:
        return
    from csac_jax.io import configs
    from csac_jax.runtime import provenance

    config = {} if cfg is None else {"config": configs.to_dict(cfg)}
    files.write_json(path, {**result, **config, **provenance.record()})
