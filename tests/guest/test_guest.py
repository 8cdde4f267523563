"""
Drivers of devices against a real kernel: a Debian guest under QEMU's emulation runs the tests of `inside/`.

One boot runs them all; each is a test here by its name.
"""

from __future__ import annotations

import ast
import os
from pathlib import Path

import pytest

from .image import make_code_disk, make_initramfs
from .machine import GuestResult, boot
from .system import ensure_system, missing_tools

# The first use builds the guest's system, and waits for all of its tests.
pytestmark = [pytest.mark.root, pytest.mark.nightly, pytest.mark.timeout(2400)]

INSIDE = Path(__file__).parent / "inside"
NAMES = [
    f"{file.name}::{node.name}"
    for file in sorted(INSIDE.glob("test_*.py"))
    for node in ast.parse(file.read_text(encoding="utf-8")).body
    if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
]


@pytest.fixture(scope="module")
def guest(tmp_path_factory) -> GuestResult:
    if os.geteuid() != 0 or missing_tools():
        pytest.skip(f"needs root and the packages {', '.join(missing_tools()) or '(all here)'}")
    folder = tmp_path_factory.mktemp("guest")
    scratch = folder / "scratch"
    scratch.mkdir()
    system = ensure_system()
    make_initramfs(system, folder / "initramfs")
    make_code_disk(system, folder / "code.img", scratch)
    return boot(system, folder / "initramfs", folder / "code.img", folder)


@pytest.mark.parametrize("name", NAMES)
def test_inside(guest, name):
    told = [test for test in guest.tests if test["name"] == name]

    assert told, f"it was not run; the console's last lines:\n{guest.last_lines}"
    bad = [test for test in told if test["outcome"] != "passed"]
    assert not bad, "\n".join(f"{test['outcome']}: {test['text']}" for test in bad)


def test_the_guest_switched_itself_off(guest):
    assert guest.is_complete, guest.last_lines
