"""Needs of devices that this computer does not meet, each with its cure."""

from __future__ import annotations

import glob
import grp
import importlib.util
import os
from collections.abc import Iterator

from madns_runtime.hardware.contract import Needs


def missing_here(needs: Needs) -> Iterator[str]:
    """Yield what a kind of device needs and is not here, with what cures it."""
    for pattern in needs.files:
        if not glob.glob(pattern):
            lines = ", ".join(needs.boot_lines)
            cure = f"write {lines} into config.txt and reboot" if lines else "is it connected?"
            yield f"no file {pattern}: {cure}"
    for group in needs.groups:
        if os.geteuid() != 0 and not _is_member(group):
            yield f"you are not in the group {group}: sudo usermod -aG {group} $USER, and log in anew"
    for module in needs.system_modules:
        if importlib.util.find_spec(module.partition(".")[0]) is None:
            packages = " ".join(needs.packages)
            cure = f"sudo apt-get install {packages}" if packages else "install it"
            yield f"no Python module {module}: {cure} (in an environment that sees the system's packages)"


def _is_member(name: str) -> bool:
    try:
        return grp.getgrnam(name).gr_gid in os.getgroups()
    except KeyError:
        return False
