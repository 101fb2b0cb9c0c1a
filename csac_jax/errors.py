"""What goes wrong for a reason that the user can mend. A message is one line with the remedy."""

from typing import Any

_REASONS = {"missing": "is missing", "extra_forbidden": "is unknown"}
_REASONS["unexpected_keyword_argument"] = _REASONS["extra_forbidden"]


class SettingsError(ValueError):
    """Settings, arguments or files that do not fit one another or this machine."""


class DeviceError(Exception):
    """A device that is asked for and is not there."""


class FailedError(Exception):
    """What was asked for has failed; the kind of errors of checkpoints, policies and runs."""


class ViewError(FailedError):
    """A camera image that no action may be taken from."""


class SceneError(FailedError):
    """A scene that cannot be simulated or settled."""


class DataWarning(UserWarning):
    """Files that are used although something about them is doubtful."""


def first_fault(error: Any) -> str:
    """Returns the first fault of a `pydantic.ValidationError` in one line: its key and a reason."""
    fault = error.errors(include_url=False, include_input=False)[0]
    reason = fault["msg"].removeprefix("Input ").removeprefix("Value error, ")
    key = ".".join(str(part) for part in fault["loc"] if part != "[key]")
    text = f"'{key[:100]}' " if key else ""
    return " ".join((text + _REASONS.get(fault["type"], reason)).split())[:300]
