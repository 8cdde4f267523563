"""
Places for what is needed for a moment, on machines whose disks take nothing more as well.

Such a machine must still be rebooted, and get rid of packages: that is what cures it.
"""

from __future__ import annotations

import os
import tempfile

from cosmos_cli.onboard.request_loop import HelperRefusal

TYPE_CHECKING = False  # as in `request_loop`
if TYPE_CHECKING:
    from typing import BinaryIO


def scratch_file() -> BinaryIO:
    """Return a file without a name; it is in memory where no folder for such files takes one."""
    try:
        return tempfile.TemporaryFile()
    except OSError:
        return open(os.memfd_create("cosmos"), "w+b")


def scratch_folder() -> tempfile.TemporaryDirectory[str]:
    """
    Return a folder that goes with the `with` block.

    Raises:
        Refusal: READ_ONLY or DISK_FULL, no place for such folders takes one.
    """
    try:
        return tempfile.TemporaryDirectory(prefix="cosmos-")
    except FileNotFoundError:  # of all places together: it does not say why
        is_read_only = bool(os.statvfs("/tmp").f_flag & os.ST_RDONLY)  # noqa: S108 - looked at, not used
        kind, cure = "disk_full", "make room there, then repeat the command"
        if is_read_only:
            kind, cure = "read_only", "a worn SD card turns read-only: `cosmos reboot`, replace it"
        text = "no folder for temporary files there, such as /tmp, takes one"
        raise HelperRefusal(kind, text, cure) from None
