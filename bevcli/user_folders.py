"""The cache folder of a user, as the XDG base directory specification has it."""

import os
from pathlib import Path


def user_cache() -> Path:
    """The folder of all caches of bevcli, $XDG_CACHE_HOME/bevcli (default ~/.cache/bevcli)."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "bevcli"
