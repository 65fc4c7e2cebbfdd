"""The version of bevcli."""

__version__ = "0.1.0"
