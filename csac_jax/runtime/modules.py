"""Modules of one's own that commands load, and digests of their sources for records."""

import hashlib
import importlib
import sys
from pathlib import Path
from types import ModuleType

from csac_jax.errors import SettingsError

_loaded: dict[str, ModuleType] = {}


def load(name: str) -> ModuleType:
    """Imports a module, from the current folder too. Raises SettingsError of one line."""
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.insert(0, here)
    try:
        _loaded[name] = importlib.import_module(name)
    except SettingsError:
        raise  # of a name that it registers
    except Exception as error:
        text = f"{type(error).__name__}: {error}"
        raise SettingsError(f"'{name}' cannot be imported ({text})") from None
    return _loaded[name]


def names() -> tuple[str, ...]:
    """Returns the names of the modules that were loaded."""
    return tuple(_loaded)


def digests() -> dict[str, str]:
    """Returns a digest of the source of each module that was loaded."""
    paths = {name: module.__file__ for name, module in _loaded.items()}
    read = {name: Path(path).read_bytes() for name, path in paths.items() if path}
    return {name: hashlib.sha256(source).hexdigest()[:12] for name, source in read.items()}
