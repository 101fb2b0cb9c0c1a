"""What goes wrong for a reason that the user can mend; the messages are one line with the remedy."""


class SettingsError(ValueError):
    """Settings, arguments or files that do not fit one another or this machine."""


class SceneError(Exception):
    """A scene that cannot be simulated or settled."""
