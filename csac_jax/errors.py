"""What goes wrong for a reason that the user can mend. A message is one line with the remedy."""


class SceneError(Exception):
    """A scene that cannot be simulated or settled."""


class DeviceError(Exception):
    """A device that is asked for and is not there."""
