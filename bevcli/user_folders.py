"""The folders of a user, as the XDG base directory specification has them."""

import os
from pathlib import Path

NO_HOME = Path("/nonexistent")  # as in the passwd of Debian; caches that cannot be written are done without


def user_cache() -> Path:
    """The folder of all caches of bevcli, $XDG_CACHE_HOME/bevcli (default ~/.cache/bevcli)."""
    return user_folder("XDG_CACHE_HOME", ".cache")


def user_folder(variable: str, below_home: str) -> Path:
    """The folder of bevcli in that of an environment variable, by default in one below the user's home folder."""
    try:
        return Path(os.environ.get(variable) or Path.home() / below_home) / "bevcli"
    except RuntimeError:  # no HOME, and no entry in the system's list of users
        return NO_HOME / below_home / "bevcli"
