"""Folder of this computer for all that can be had again: wheels, and ways to reach machines."""

from __future__ import annotations

import os
from pathlib import Path

CACHE_VARIABLE = "COSMOS_CACHE"


def cache_folder() -> Path:
    """Return that folder: COSMOS_CACHE, else cosmos among the user's caches."""
    given = os.environ.get(CACHE_VARIABLE)
    if given:
        return Path(os.path.expanduser(given)).absolute()
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cosmos"
