"""Errors that the user can fix. A message is one line with the remedy."""

from typing import Any

_UNKNOWN = dict.fromkeys(("extra_forbidden", "unexpected_keyword_argument"), "is unknown")
_REASONS = {"missing": "is missing", **_UNKNOWN}


class SettingsError(ValueError):
    """Invalid settings, arguments or files (exit code 2 of a command)."""


class DeviceError(SettingsError):
    """A requested device that this machine lacks."""


class FailedError(Exception):
    """Work that has failed (exit code 1); base of errors of checkpoints, policies and runs."""


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
