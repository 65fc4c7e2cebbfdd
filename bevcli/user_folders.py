"""The folders of a user, as the XDG base directory specification has them."""

import os
from pathlib import Path


def user_cache() -> Path:
    """The folder of all caches of bevcli, $XDG_CACHE_HOME/bevcli (default ~/.cache/bevcli)."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "bevcli"


def user_settings() -> Path:
    """The folder of a user's own settings, $XDG_CONFIG_HOME/bevcli (default ~/.config/bevcli)."""
    return Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "bevcli"
