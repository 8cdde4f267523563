"""What all tests share: a private register of processes, and no skip that CI would not notice."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

pytest_plugins = ["tower.fixtures"]  # of tests/tower; costs nothing where no test asks for a tower

# A shell's background jobs ignore Ctrl-C, and so would every command that a test interrupts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

SLOW_FIRST = ("runs", "faults", "cosmos_cli", "fleet", "tower", "docs", "lockstep")
"""Folders whose tests start processes: begun first, so that none of them runs on alone at the end."""


def pytest_collection_modifyitems(config, items):
    """Bring the slow folders' tests to the front; the order within each stays."""
    here = Path(__file__).parent
    places = {name: place for place, name in enumerate(SLOW_FIRST)}
    items.sort(
        key=lambda item: (
            places.get(item.path.relative_to(here).parts[0], len(SLOW_FIRST))
            if item.path.is_relative_to(here)
            else len(SLOW_FIRST)
        )
    )


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item, call):
    """Turn a skip into a failure where CI is set: CI's machine must be able to run every test."""
    outcome = yield
    report = outcome.get_result()
    if report.skipped and os.environ.get("CI") and not hasattr(report, "wasxfail"):
        report.outcome = "failed"
        report.longrepr = f"skipped in CI: {report.longrepr}"


@pytest.fixture(autouse=True, scope="session")
def private_register(tmp_path_factory):
    """Keep the tests' processes out of the register of this machine's user."""
    patch = pytest.MonkeyPatch()
    patch.setenv("COSMOS_STATE_DIR", str(tmp_path_factory.mktemp("state")))
    yield
    patch.undo()
