"""What goes wrong with a scene for a reason that its user can mend."""


class SceneError(Exception):
    """A scene that cannot be simulated or settled. The message is one line with the remedy."""
