"""Parts of one's own in place of a config's: checked before a run, and named in its config.

A name has the class with its module, the numbers that it was made with, and a digest of its source:
`sampler my_module.Mine(share=0.2) @3f2a9c0145de`. So runs with other parts are other runs.
"""

import contextlib
import dataclasses
import hashlib
import inspect
import warnings
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from csac_jax.agent.learner import Learner
from csac_jax.config import Config
from csac_jax.errors import DataWarning
from csac_jax.replay.samplers import Sampler
from csac_jax.section import require

SEPARATOR = "; "
LIBRARIES = ("builtins", "abc", "csac_jax", "flax", "typing")  # whose classes have versions
FORMS = {
    "sampler": ("csac_jax.Sampler", ("init", "sample", "update")),
    "network": ("flax.linen.Module, with a `stride`", ("init", "apply", "stride")),
    "learner": ("csac_jax.Learner", ("init", "act", "update", "reward")),
}
"""What a part is derived from, and what it must have."""
UNREAD = {
    "sampler": ("replay.",),
    "network": ("net.",),
    "learner": ("net.", "cem.", "policy.", "target.", "explore."),
}
"""Settings that a part of one's own takes the place of."""
_UNNAMED = {"parent", "name"}  # fields that Flax adds to a module


class OwnParts(NamedTuple):
    """A sampler, a network and a learner in place of the config's; None for the config's."""

    sampler: Sampler | None = None
    network: Any = None
    learner: Learner | None = None

    def names(self) -> str:
        """Returns the names of the parts, as a config holds them; empty without any."""
        given = ((kind, part) for kind, part in self._asdict().items() if part is not None)
        return SEPARATOR.join(f"{kind} {name(part)}" for kind, part in given)


NO_PARTS = OwnParts()


def name(part: Any) -> str:
    """Names a part by its class, its plain fields and a digest of all that it is made of."""
    kind = type(part)
    shown = [f"{key}={value}" for key, value in _fields(part).items() if _is_plain(value)]
    settings = f"({', '.join(shown)})" if shown else ""
    return f"{kind.__module__}.{kind.__qualname__}{settings} @{_digest(part)}"


def _fields(part: Any) -> dict[str, Any]:
    if dataclasses.is_dataclass(part):
        names = [field.name for field in dataclasses.fields(part) if field.name not in _UNNAMED]
        return {name: getattr(part, name) for name in names}
    return dict(getattr(part, "__dict__", {}))


def _is_plain(value: Any) -> bool:
    return isinstance(value, bool | int | float | str)


def _digest(part: Any) -> str:
    owners = {kind: kind.__module__.partition(".")[0] for kind in type(part).__mro__}
    content = [_source(kind) for kind, owner in owners.items() if owner not in LIBRARIES]
    content += [f"{name}={_content(value)}" for name, value in _fields(part).items()]
    return hashlib.sha256("\n".join(content).encode()).hexdigest()[:12]


def _content(value: Any) -> str:
    """Describes a value, the same in every process: no text has an address."""
    if value is None or _is_plain(value):
        return repr(value)
    if isinstance(value, dict):
        value = sorted((str(key), _content(item)) for key, item in value.items())
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_content, value))}]"
    if inspect.isfunction(value):
        return _source(value)
    kind = type(value).__qualname__
    if dataclasses.is_dataclass(value):
        return f"{kind}{_content(_fields(value))}"
    with contextlib.suppress(AttributeError, TypeError):  # no array, or one of keys
        array = np.asarray(value.__array__())
        return f"{array.dtype}{array.shape}{hashlib.sha256(array.tobytes()).hexdigest()}"
    return kind


def _source(of: Any) -> str:
    """Returns the source of a class or function; its name if it was typed into an interpreter."""
    try:
        return inspect.getsource(of)
    except (OSError, TypeError):
        return of.__qualname__


def check(parts: OwnParts, init: Any = None) -> None:
    """Raises SettingsError for a part that is none, and for one that `init` has no networks for."""
    for kind, part in parts._asdict().items():
        if part is None:
            continue
        base, needed = FORMS[kind]
        found = part.__qualname__ if isinstance(part, type) else type(part).__qualname__
        require(not isinstance(part, type), f"{kind}: {found} is a class; give {found}()")
        lacking = ", ".join(name for name in needed if not hasattr(part, name))
        require(not lacking, f"{kind}: {found} lacks {lacking}; derive it from {base}")
    plain = init is None or (parts.network, parts.learner) == (None, None)
    require(plain, "init: has the config's own networks; leave out network and learner")


def named(cfg: Config, parts: OwnParts) -> Config:
    """Returns the config with the names of the parts. Raises SettingsError if it has other ones."""
    names = parts.names()
    if cfg.parts not in ("", names):
        given = f"this is {names}" if names else "none is given"
        remedy = "give the same to csac_jax.train or sweep, or take cfg.change(parts='')"
        require(False, f"parts: these settings are of a run with {cfg.parts}, {given}; {remedy}")
    return cfg.change(parts=names)


def check_varied(parts: OwnParts, names: Iterable[str]) -> None:
    """Raises SettingsError for a varied setting that a part does not read."""
    for kind, part in parts._asdict().items():
        unread = [one for one in names if part is not None and one.startswith(UNREAD[kind])]
        read = [one for one in unread if one not in ("replay.capacity", "net.colour", "net.head")]
        require(not read, f"vary: your {kind} does not read {', '.join(read)}; leave it out")


def check_loadable(source: Any, cfg: Config, parts: OwnParts) -> None:
    """Raises SettingsError if a policy lacks the network or learner of its run; warns of others."""
    lacking = {kind: part is None for kind, part in parts._asdict().items() if kind != "sampler"}
    for text in cfg.parts.split(SEPARATOR) if cfg.parts else []:
        kind = text.partition(" ")[0]
        how = f"give it: csac_jax.load_policy({str(source)!r}, {kind}=...)"
        require(not lacking.get(kind), f"{source} was trained with {text}; {how}")
        if kind in lacking and text not in parts.names().split(SEPARATOR):
            fault = f"{source} was trained with {text}, this is {parts.names()}"
            warnings.warn(fault, DataWarning, stacklevel=3)
