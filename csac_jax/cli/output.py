"""What commands write: JSON with its provenance, shares as text."""

from pathlib import Path
from typing import Any

from csac_jax.config import Config
from csac_jax.io import files


def write_result(path: Path | None, result: dict[str, Any], cfg: Config | None) -> None:
    """Writes a result with its config and provenance, if there is a path."""
    if path is None:
        return
    from csac_jax.io import configs
    from csac_jax.runtime import provenance

    config = {} if cfg is None else {"config": configs.to_dict(cfg)}
    files.write_json(path, {**result, **config, **provenance.record()})


def percent(value: float) -> str:
    """A share, such as 0.931, as `93.1 %`."""
    return f"{100 * value:.1f} %"


def interval(entry: dict[str, Any]) -> str:
    """The interval of a metric, as `91.2 .. 94.6 %`."""
    return f"{100 * entry['low']:.1f} .. {100 * entry['high']:.1f} %"
