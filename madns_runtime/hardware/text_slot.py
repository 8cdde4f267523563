"""A sentence in memory that processes share."""

from __future__ import annotations

import zlib
from typing import Final

TEXT_BYTES_MAX: Final = 500
SLOT_BYTES: Final = 512


class TextSlot:
    """
    One process writes, any reads; who reads while it is written gets nothing.

    Args:
        view: SLOT_BYTES of shared memory, zero at first.
    """

    def __init__(self, view: memoryview) -> None:
        self._view = view

    def write(self, text: str) -> None:
        """Put a sentence there; a longer one than TEXT_BYTES_MAX is cut."""
        data = text.encode()[:TEXT_BYTES_MAX].decode(errors="ignore").encode()
        head = len(data).to_bytes(4, "little") + zlib.crc32(data).to_bytes(4, "little")
        self._view[: 8 + len(data)] = head + data

    def read(self) -> str:
        """Return the sentence; empty before the first."""
        size = int.from_bytes(self._view[:4], "little")
        data = bytes(self._view[8 : 8 + min(size, TEXT_BYTES_MAX)])
        is_whole = zlib.crc32(data) == int.from_bytes(self._view[4:8], "little")
        return data.decode(errors="replace") if is_whole else ""
