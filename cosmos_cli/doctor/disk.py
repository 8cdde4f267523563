"""Checks of where a run records. Pure."""

from __future__ import annotations

from collections.abc import Iterator

from cosmos_cli.doctor.case import Case
from cosmos_cli.doctor.finding import CheckRemark, Severity
from cosmos_cli.models.machine_facts import NOEXEC_CURE

FREE_BYTES_ERROR = 64 * 1024**2
FREE_BYTES_WARNING = 512 * 1024**2
FREE_FILES_ERROR = 1000
SYNC_S_NOTE = 0.25
SYNC_S_WARNING = 1.0
"""Records wait in a bounded buffer while a disk is busy; some seconds of it lose some."""


def disk_space(case: Case) -> Iterator[CheckRemark]:
    """Room for records."""
    disk = case.part("facts").get("disk") or {}
    free_bytes, free_files = case.facts.disk.free_bytes, disk.get("free_files")
    if free_files is not None and free_files < FREE_FILES_ERROR:
        yield CheckRemark(
            level=Severity.ERROR,
            found="its disk has room for few more files",
            cure=_room_cure(case),
            figure=free_files,
        )
    level = (
        Severity.ERROR
        if free_bytes < FREE_BYTES_ERROR
        else Severity.WARNING
        if free_bytes < FREE_BYTES_WARNING
        else Severity.OK
    )
    yield CheckRemark(
        level=level,
        found="free disk space" if level == Severity.OK else "little free disk space",
        cure="" if level == Severity.OK else _room_cure(case),
        figure=free_bytes / (1024**2 if level == Severity.ERROR else 1024**3),
        unit="MiB" if level == Severity.ERROR else "GiB",
        detail=case.facts.disk.path if level != Severity.OK else "",
    )


def _room_cure(case: Case) -> str:
    if case.is_here:
        return "move old runs elsewhere, or set COSMOS_RUNS to another disk"
    return "`cosmos collect RUN` and `cosmos wipe`; `cosmos exec --sudo -- apt-get clean`"


def disk_writable(case: Case) -> Iterator[CheckRemark]:
    """A worn card turns read-only and looks healthy otherwise."""
    disk = case.facts.disk
    if disk.is_read_only:
        yield CheckRemark(
            level=Severity.ERROR,
            found="its disk is read-only",
            cure="another disk"
            if case.is_here
            else "`dmesg` there tells why; a worn SD card has to be replaced",
            detail=disk.path,
        )
    elif not disk.is_writable:
        yield CheckRemark(
            level=Severity.ERROR,
            found=f"{case.facts.user} may not write in {disk.path}",
            cure="COSMOS_RUNS names another folder"
            if case.is_here
            else "cosmos_root in the inventory names a folder that may be written",
        )
    elif disk.is_noexec and not case.is_here:
        yield CheckRemark(
            level=Severity.ERROR,
            found="its disk is mounted noexec: no Python package there can be loaded",
            cure=NOEXEC_CURE,
            detail=disk.path,
        )
    else:
        yield CheckRemark(found="its disk can be written")


def disk_write(case: Case) -> Iterator[CheckRemark]:
    """Check the time that the disk takes to keep its input."""
    told = case.part("disk_write")
    if told.get("error"):
        yield CheckRemark(
            level=Severity.ERROR,
            found=f"its disk takes nothing: {told['error']}",
            cure=_room_cure(case),
            detail=case.facts.disk.path,
        )
    elif told:
        longest_s = max(told["duration_s"], told["sync_s"])
        level = (
            Severity.WARNING
            if longest_s > SYNC_S_WARNING
            else Severity.NOTE
            if longest_s > SYNC_S_NOTE
            else Severity.OK
        )
        rate_mb_s = told["bytes"] / 1e6 / max(told["duration_s"], 1e-9)
        cure = (
            "COSMOS_RUNS on another disk"
            if case.is_here
            else "a faster card (class A2), or cosmos_root on another disk"
        )
        yield CheckRemark(
            level=level,
            found="1 MiB is on its disk after",
            cure="" if level == Severity.OK else cure,
            figure=told["duration_s"] * 1e3,
            unit="ms",
            detail=f"{rate_mb_s:.3g} MB/s; 4 KiB more after {told['sync_s'] * 1e3:.3g} ms",
        )
