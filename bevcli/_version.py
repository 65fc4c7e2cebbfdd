"""The version of bevcli."""

__version__ = "0.2.0"
