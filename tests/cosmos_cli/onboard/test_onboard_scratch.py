"""A machine whose disks take nothing more still does what may cure it."""

import os
import tempfile
from types import SimpleNamespace

import pytest

from cosmos_cli.onboard import apt, power, system
from cosmos_cli.onboard.request_loop import HelperRefusal, VerbRequest


@pytest.fixture(autouse=True)
def _no_room(monkeypatch):
    """As of a board whose card is full or has turned read-only: no folder for temporary files takes one."""
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(tempfile, "_candidate_tempdir_list", lambda: ["/proc", "/sys"])


@pytest.mark.process
def test_programs_are_run_and_what_they_say_is_kept():
    *_, last = system.running(["/bin/echo", "done"], timeout_s=60.0)

    assert last.value == {"exit_status": 0, "output": "done"}


@pytest.mark.process
def test_reboot_is_ordered(monkeypatch):
    monkeypatch.setattr(power, "COMMANDS", (("true",),))

    assert power.reboot(VerbRequest(arguments={})) is None


@pytest.mark.parametrize(("flags", "kind"), [(0, "disk_full"), (os.ST_RDONLY, "read_only")])
def test_what_needs_a_folder_says_why_there_is_none(monkeypatch, flags, kind):
    monkeypatch.setattr(os, "statvfs", lambda path: SimpleNamespace(f_flag=flags))
    monkeypatch.setattr(apt, "_still_wanted", lambda action, names: names)
    asked = {"action": "install", "names": ["foo"], "is_check": True}

    with pytest.raises(HelperRefusal) as refused:
        list(apt.packages(VerbRequest(arguments=asked)))

    assert refused.value.kind == kind
    assert refused.value.advice
