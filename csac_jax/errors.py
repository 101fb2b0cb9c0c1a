"""What goes wrong for a reason that the user can mend. A message is one line with the remedy."""


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
