"""The folders of a user, as the XDG base directory specification has them."""

import os
from pathlib import Path

NO_HOME = Path("/nonexistent")  # as in the passwd of Debian; caches that cannot be written are done without


def user_cache() -> Path:
    """The folder of all caches of bevcli, $XDG_CACHE_HOME/bevcli (default ~/.cache/bevcli)."""
    return _folder("XDG_CACHE_HOME", ".cache")


def user_config() -> Path:
    """The folder of a user's own settings, $XDG_CONFIG_HOME/bevcli (default ~/.config/bevcli)."""
    return _folder("XDG_CONFIG_HOME", ".config")


def _folder(variable: str, below_home: str) -> Path:
    try:
        return Path(os.environ.get(variable) or Path.home() / below_home) / "bevcli"
    except RuntimeError:  # no HOME, and no entry in the system's list of users
        return NO_HOME / below_home / "bevcli"
