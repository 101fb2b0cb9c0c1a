"""Where the files that come with the package lie. Needs neither JAX nor MuJoCo."""

from pathlib import Path


def assets() -> Path:
    """Folder of the MJCF files, in a checkout or in an installed package."""
    package = Path(__file__).resolve().parent
    for folder in (package.parent / "scenes", package / "_scenes"):
        if (folder / "table.xml").is_file():
            return folder
    raise FileNotFoundError(f"no MJCF files beside {package}; install csac_jax again")
