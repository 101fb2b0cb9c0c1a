"""Errors that the user can fix. A message is one line with the remedy."""


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
