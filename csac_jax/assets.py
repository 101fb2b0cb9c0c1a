"""The folder of files that come with the package. Needs neither JAX nor MuJoCo."""

from pathlib import Path


def assets() -> Path:
    """Returns the folder of MJCF files, in a checkout or in an installed package."""
    package = Path(__file__).resolve().parent
    for folder in (package.parent / "scenes", package / "_scenes"):
        if (folder / "table.xml").is_file():
            return folder
    raise FileNotFoundError(f"no MJCF files for {package}; install csac_jax again")
