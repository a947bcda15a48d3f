"""Where the project keeps what it can make again: decoded frames, decimated meshes."""

import os
from pathlib import Path


def cache_folder() -> Path:
    """``$HISTMV_CACHE``, or this project's folder in the user's cache (``~/.cache/lerobot_histmv``)."""
    default = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")) / "lerobot_histmv"
    return Path(os.environ.get("HISTMV_CACHE", default)).expanduser()
