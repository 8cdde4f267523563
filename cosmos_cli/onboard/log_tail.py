"""
Ends of a run's log streams, standard errors and kept texts, from where the reader was.

Only whole lines are told, from known files alone, and a bounded number of bytes at a time. A text whose writer is gone
is told to its end: the line that stands before a crash has none.
"""

from __future__ import annotations

import glob
import itertools
import os
import stat
from collections.abc import Iterator, Mapping

from cosmos_cli.onboard.processes import find_living, path_of
from cosmos_cli.onboard.request_loop import PlainValue, VerbRequest, verb

PATTERNS = (
    "host/log*.jsonl",
    "host/stderr.txt",
    "agents/*/log*.jsonl",
    "agents/*/*.txt",
    "machines/*/stderr.txt",
)
FILES_MAX = 20_000
FILE_BYTES_MAX = 65_536
"""Of one file at a time; a longer line of a text is told in pieces."""
RECORD_BYTES_MAX = 1_048_576
"""Of one record: half of one cannot be read. Whatever is longer is told in pieces, too."""
ANSWER_BYTES_MAX = 1_048_576


@verb("tail")
def tail(request: VerbRequest) -> dict[str, PlainValue]:
    """Tell what was added to a run's logs since the `offsets` of the request, and whether anything of the run lives."""
    directory = path_of(request, "directory")
    living = bool(find_living(directory, path_of(request, "state")))
    offsets = request.arguments.get("offsets") or {}
    return {**read_tails(directory, offsets, is_ended=not living), "living": living}


def read_tails(
    directory: str, offsets: Mapping[str, int], *, is_ended: bool = False
) -> dict[str, PlainValue]:
    """
    Return what stands behind the offsets in a run's logs.

    Args:
        directory: The run's.
        offsets: Bytes of each file that were read before, by its path in the directory.
        is_ended: Whether nobody adds to them any more: then a text's last line needs no end.

    Returns:
        "files": by path, "start" and "end" of what is told, and "text"; "more": there is more to ask for.
    """
    files: dict[str, PlainValue] = {}
    left_bytes, is_more = ANSWER_BYTES_MAX, False
    for path in _paths(directory):
        if left_bytes <= 0:
            is_more = True
            break
        start = int(offsets.get(path, 0))
        data, is_rest = _added(os.path.join(directory, path), start, is_ended=is_ended)
        if files and len(data) > left_bytes:
            is_more = True
            break
        is_more = is_more or is_rest
        if data:
            files[path] = {
                "start": start,
                "end": start + len(data),
                "text": data.decode("utf-8", "replace"),
            }
            left_bytes -= len(data)
    return {"files": files, "more": is_more}


def _paths(directory: str) -> Iterator[str]:
    top = glob.escape(directory)
    found = (path for end in PATTERNS for path in sorted(glob.glob(os.path.join(top, end))))
    return (os.path.relpath(path, directory) for path in itertools.islice(found, FILES_MAX))


def _added(path: str, start: int, *, is_ended: bool) -> tuple[bytes, bool]:
    """Return the whole lines behind an offset, and whether more of them are there."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        return b"", False
    is_text = path.endswith(".txt")
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode) or status.st_size <= start:
            return b"", False
        data, bytes_max = os.pread(descriptor, FILE_BYTES_MAX, start), FILE_BYTES_MAX
        if not is_text and b"\n" not in data and len(data) == FILE_BYTES_MAX:
            data, bytes_max = os.pread(descriptor, RECORD_BYTES_MAX, start), RECORD_BYTES_MAX
            data = data[: data.find(b"\n") + 1 or len(data)]
    except OSError:
        return b"", False
    finally:
        os.close(descriptor)
    is_last = is_text and is_ended and start + len(data) >= status.st_size
    end = len(data) if is_last else data.rfind(b"\n") + 1
    if not end and len(data) == bytes_max:
        end = len(data)
    return data[:end], bool(end) and start + end < status.st_size
