"""The version of the package; it imports nothing."""

__version__ = "0.2.0"
