"""The mistakes of a user that bevcli explains in one line; the command line prints it and exits 1.

A message names what, where, expected, found and the next step:
``calibration.json: camera CAM_BACK: "intrinsics" is missing (expected 3x3)``.
"""


class BevcliError(Exception):
    """A mistake in what the user gave us. The message is one line, complete without a traceback."""


class InputError(BevcliError):
    """A sequence, calibration, ego-motion or ground-truth file is missing or wrong."""


class ConfigError(BevcliError):
    """A model's TOML file is missing or wrong."""


class WeightsError(BevcliError):
    """A file of weights is missing, is none, or belongs to another model."""


class OutputError(BevcliError):
    """Something cannot be written where the user asked for it."""
