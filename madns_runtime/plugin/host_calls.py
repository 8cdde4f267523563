"""
The calls of the host's half: which is under way, and which held the loop longest.

The call under way stands in a small page of shared memory, so that the end of the process in the middle of
it, by `os._exit` or a signal, can be told with the method and the simulated time. One line of text:
whoever started the host reads it, here or over SSH. A page of tmpfs is never written to a disk, so no store
into it can wait for one, or fail because it is full.
"""

from __future__ import annotations

import contextlib
import math
import mmap
import os
import stat
from collections.abc import Callable
from pathlib import Path
from time import monotonic
from typing import Any, Final

from madns_runtime.reactor.forking import ForkedCopies, end_child

LONG_CALL_S: Final = 0.010
"""A call that holds the loop for longer is counted and told: ten times what a call may take by the contract."""
STANDSTILL_S: Final = 0.5
"""One that takes this long is told at once: agents lose a silent host."""
SWEPT_AFTER_S: Final = 86_400.0
"""Time that a page of a host that has ended is left for whoever started it: longer than most runs."""
FOLDER: Final = Path("/dev/shm")
PREFIX: Final = "madns-host-"
WHAT_BYTES: Final = 120
LINE: Final = b">%-120s %s %12d\n"
"""Mark, what is called, simulated time, process."""
LINE_BYTES: Final = len(LINE % (b"", b"%20.6f" % 0.0, 0))
RETURNED: Final = ord(" ")
"""Stands in the place of the mark once the call has returned."""
LAST: Final = "finish"
FORKS_WAIT_S: Final = 1.0
"""Time that the last call waits for processes that the half forked and that may come back yet."""


def page_path(session_hex: str) -> Path:
    """Return where the page of a run's host lies; the session tells runs apart."""
    return FOLDER / f"{PREFIX}{session_hex}"


class HostCalls:
    """
    The calls of one host's half.

    Args:
        session_hex: Names the page; empty for none that others could read.
    """

    def __init__(self, session_hex: str = "") -> None:
        self.name = ""
        """Name of the half, which precedes a method's name."""
        self.method = ""
        """Method that is called, or was called last."""
        self.t_s: Callable[[], float | None] = lambda: None
        """Returns the simulated time, s; None before it runs."""
        self.is_counting = False
        """Whether long calls count: while simulated time runs."""
        self.warn: Callable[[str], None] = lambda text: None
        """Told of a call that stood in the way of everything for long."""
        self._path: Path | None = None
        self._page = _own_page() if not session_hex else self._open(page_path(session_hex))
        self._pid = os.getpid()
        self._strays = _own_page()
        """Shared with processes that the half forks: the method that one came back from, as a line."""
        self._copies: ForkedCopies | None = None
        """From the first call on: what is forked before is no half's."""
        self._lines: dict[str, bytes] = {}
        self._calls = 0
        self._by_method: dict[str, list[float]] = {}

    def begin(self, method: str) -> float:
        """Note that *method* is called now, and return the computer's time, s, where that counts."""
        line = self._lines.get(method) or self._make_line(method)
        self.method = method
        t_s = self.t_s()
        self._page[:] = line % (math.nan if t_s is None else t_s)
        return monotonic() if self.is_counting else 0.0

    def end(self, method: str, began_s: float) -> None:
        """Note that *method*, called at *began_s*, has returned; a process that it forked is ended where it comes back."""
        if os.getpid() != self._pid:
            line = f"{self.name}.{method}\n".encode("utf-8", "replace")[:WHAT_BYTES]
            self._strays[: len(line)] = line
            end_child(1)
        self._page[0] = RETURNED
        if method == LAST and self._copies is not None:
            self._copies.wait_until_gone(FORKS_WAIT_S)
        if self.is_counting and began_s:
            self._calls += 1
            took_s = monotonic() - began_s
            if took_s > LONG_CALL_S:
                self._enter(method, took_s)

    def forked_in(self) -> str:
        """Return the method that a process came back from which it had forked; empty if there was none."""
        return self._strays.readline().decode("utf-8", "replace").strip() if self._strays[0] else ""

    def to_mapping(self) -> dict[str, Any]:
        """Return how many calls there were while simulated time ran, and which of them were long."""
        methods = {
            f"{self.name}.{method}": {
                "long": int(count),
                "longest_s": round(longest_s, 6),
                "longest_t_s": None if math.isnan(t_s) else round(t_s, 6),
            }
            for method, (count, longest_s, t_s) in self._by_method.items()
        }
        return {
            "calls": self._calls,
            "limit_s": LONG_CALL_S,
            "long": sum(entry["long"] for entry in methods.values()),
            "methods": methods,
        }

    def close(self) -> None:
        """Remove the page: the process ends in good order."""
        if self._path is not None and os.getpid() == self._pid:
            with contextlib.suppress(OSError):
                self._path.unlink()
            self._path = None

    def _make_line(self, method: str) -> bytes:
        """Return a method's line, which lacks the time alone: made once, as calls are many."""
        self._copies = self._copies or ForkedCopies()
        what = f"{self.name}.{method}".encode("utf-8", "replace")[:WHAT_BYTES].replace(b"%", b"_")
        line = LINE % (what, b"%20.6f", self._pid)
        self._lines[method] = line
        return line

    def _enter(self, method: str, took_s: float) -> None:
        entry = self._by_method.setdefault(method, [0, 0.0, math.nan])
        entry[0] += 1
        if took_s > STANDSTILL_S:
            self.warn(
                f"{self.name}.{method} took {took_s:.1f} s, and the host stood still; hand long work to"
                " context.submit"
            )
        if took_s > entry[1]:
            t_s = self.t_s()
            entry[1:] = [took_s, math.nan if t_s is None else t_s - took_s]

    def _open(self, path: Path) -> mmap.mmap:
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        try:
            fd = os.open(path, flags, 0o600)
        except OSError:  # no tmpfs there: then a sudden end is told without the call
            return _own_page()
        try:
            os.write(fd, b" " * (LINE_BYTES - 1) + b"\n")
            _sweep(os.fstat(fd).st_mtime - SWEPT_AFTER_S)
            page = mmap.mmap(fd, LINE_BYTES)
        except (OSError, ValueError):
            path.unlink(missing_ok=True)
            return _own_page()
        finally:
            os.close(fd)
        self._path = path
        return page


def interrupted_call(line: bytes) -> str:
    """
    Return the call that a page names as under way, in words: " in H.timer at t = 5 s".

    Args:
        line: What the page holds, with its line's end or without.

    Returns:
        An empty text if no call was under way, or this is no such page.
    """
    if len(line) < LINE_BYTES - 1 or line[:1] != LINE[:1]:
        return ""
    what = line[1 : WHAT_BYTES + 1].decode("utf-8", "replace").strip()
    try:
        t_s = float(line[WHAT_BYTES + 1 : LINE_BYTES].split()[0])
    except (ValueError, IndexError):
        return ""
    return f" in {what}" if math.isnan(t_s) else f" in {what} at t = {t_s:g} s"


def take_page(session_hex: str) -> str:
    """Return the call under way when a host of this computer ended, as `interrupted_call`; its page is removed."""
    path = page_path(session_hex)
    line = _read(path)
    if line is None:
        return ""
    with contextlib.suppress(OSError):
        path.unlink()
    return interrupted_call(line)


def _read(path: Path) -> bytes | None:
    """Return what a page of this user holds; None if it is none."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        status = os.fstat(fd)
        is_ours = stat.S_ISREG(status.st_mode) and status.st_uid == os.geteuid()
        return os.read(fd, LINE_BYTES) if is_ours else None
    except OSError:
        return None
    finally:
        os.close(fd)


def _sweep(before_s: float) -> None:
    """
    Remove the pages that dead hosts of this user have left: on a machine nobody may have read them.

    Args:
        before_s: Pages made since then, as files tell it, are left: who started that host may be about to read its page.
    """
    try:
        paths = [path for path in FOLDER.iterdir() if path.name.startswith(PREFIX)]
    except OSError:
        return
    for path in paths:
        with contextlib.suppress(OSError):
            if path.lstat().st_mtime > before_s:
                continue
        words = (_read(path) or b"").split()
        if not words or not words[-1].isdigit() or Path(f"/proc/{int(words[-1])}").exists():
            continue
        with contextlib.suppress(OSError):
            path.unlink()


def _own_page() -> mmap.mmap:
    return mmap.mmap(-1, LINE_BYTES)
