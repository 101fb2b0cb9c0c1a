"""What goes wrong for a reason that the user can mend. A message is one line with the remedy."""


class SettingsError(ValueError):
    """Settings, arguments or files that do not fit one another or this machine."""


class SceneError(Exception):
    """A scene that cannot be simulated or settled."""


class DeviceError(Exception):
    """A device that is asked for and is not there."""
