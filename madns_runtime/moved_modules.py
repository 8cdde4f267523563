"""Modules that have another path now: their old one works for one release, with a warning."""

from __future__ import annotations

import importlib
import sys
import types
import warnings
from typing import Any


class MovedModule(types.ModuleType):
    """The old path of a module: imports nothing until a name is asked of it, then warns and hands the new one's over."""

    def __init__(self, old: str, new: str) -> None:
        super().__init__(old, f"Moved to `{new}`.")
        self.__path_now__ = new

    def __getattr__(self, name: str) -> Any:
        """Return what the module at the new path has by this name."""
        if name.startswith("__"):  # asked by the import system and by tools, not by the user's code
            raise AttributeError(name)
        value = getattr(importlib.import_module(self.__path_now__), name)
        warnings.warn(
            f"{self.__name__} is {self.__path_now__} now; the old path goes with the next release",
            FutureWarning,
            stacklevel=2,
        )
        return value


def keep_old_path(old: str, new: str) -> None:
    """Let `from OLD import NAME` work on; called by the package in which *old* lay."""
    sys.modules[old] = MovedModule(old, new)
