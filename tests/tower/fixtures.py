"""Pytest fixtures: `make_tower(...)` for a tower of one's own, `tower8` for one that many tests share."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from .tower import Tower

TOOLS = ("ip", "nft", "nsenter", "mkfs.ext4", "mount", "dpkg-deb")


def why_unavailable() -> str | None:
    """Return why no tower can be had here, or None."""
    if os.geteuid() != 0:
        return "a tower needs root"
    missing = [
        tool for tool in TOOLS if shutil.which(tool, path="/usr/sbin:/usr/bin:/sbin:/bin") is None
    ]
    if not Path("/usr/sbin/sshd").exists():
        missing.append("openssh-server")
    return f"a tower needs {', '.join(missing)}" if missing else None


def need_tower() -> None:
    """Skip, with the reason, where no tower can be had."""
    reason = why_unavailable()
    if reason:
        pytest.skip(reason)


@pytest.fixture
def make_tower() -> Iterator[Callable[..., Tower]]:
    """Return a function that starts a tower of its own; it ends with the test."""
    need_tower()
    with contextlib.ExitStack() as stack:
        yield lambda *arguments, **options: stack.enter_context(Tower(*arguments, **options))


@pytest.fixture(scope="session")
def shared_tower8() -> Iterator[Tower]:
    """Start the eight boards that tests of a session share."""
    need_tower()
    with Tower(count=8) as tower:
        yield tower


@pytest.fixture
def tower8(shared_tower8: Tower) -> Iterator[Tower]:
    """Return eight boards as freshly installed, whatever the tests before did to them."""
    shared_tower8.reflash()
    yield shared_tower8
