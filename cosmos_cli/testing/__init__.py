"""
Scenarios as tests: suites of them, and one run from a test of one's own.

A suite's paths are searched for scenarios (`discovery`), each becomes a test with settings, seed and deadline
(`case`). The schedule lets tests in lockstep run beside each other and those in real time alone (`schedule`); each
runs as `cosmos run` in a process of its own (`suite_process`), its end is judged beside what its scenario expects
(`outcome`) and beside the figures of its baseline (`figures`), and told on the terminal and as JUnit XML.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cosmos_cli.testing.single_run import FinishedRun, run

__all__ = ["FinishedRun", "run"]


def __getattr__(name: str) -> Any:
    """Return what tests of one's own import from here; commands that need none of it do not wait for numpy."""
    if name in __all__:
        return getattr(importlib.import_module("cosmos_cli.testing.single_run"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
