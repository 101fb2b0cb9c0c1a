"""Settles the pools of scenes that come with the package: `python -m experiments.pools`.

Run it again where `tests/scenes/test_pool.py` says that a pool is missing: a setting of scenes, a
model or MuJoCo has changed, and what was shipped before is no longer read.
"""

import os
import tempfile
from pathlib import Path

import numpy as np

from csac_jax import presets
from csac_jax.scenes import pool

PRESETS = ("quick", "fast")


def main() -> None:
    for old in pool.shipped().glob("*.npz"):
        old.unlink()
    pool.shipped().mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder
        for name in PRESETS:
            pool.scenes(presets.get(name), pool.TRAIN_STREAM)
        for path in Path(folder, "csac_jax", "pools").glob("*.npz"):
            with np.load(path) as settled:
                np.savez_compressed(pool.shipped() / path.name, **settled)
            print(pool.shipped() / path.name)


if __name__ == "__main__":
    main()
