"""Modules that are imported when a test uses them: every worker collects all tests, and some imports take a second."""

import importlib
import importlib.util
from types import ModuleType

import pytest


class LateModule:
    """Stands for a module until something of it is asked for, and passes on what is asked."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> object:
        # What pytest asks everything that it meets.
        if attribute.startswith("_") or attribute == "pytestmark":
            raise AttributeError(attribute)
        return getattr(self.load(), attribute)

    def load(self) -> ModuleType:
        """Return the module itself, for those who change it."""
        return importlib.import_module(self._name)


def needs_library(name: str, extra: str) -> pytest.MarkDecorator:
    """Return the mark of tests that are skipped where a library is not installed; it is not imported for that."""
    is_missing = importlib.util.find_spec(name) is None
    return pytest.mark.skipif(is_missing, reason=f"the extra `{extra}` is not installed")
