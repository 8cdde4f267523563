"""What a program wrote, held within bounds: its first bytes and its last, and how many fell between."""

from __future__ import annotations


class BoundedOutput:
    """
    Bytes within bounds.

    Args:
        first_bytes: How many of the first are kept.
        last_bytes: How many of the last are kept.
    """

    def __init__(self, first_bytes: int, last_bytes: int) -> None:
        self._first_bytes = first_bytes
        self._last_bytes = last_bytes
        self._first = bytearray()
        self._last = bytearray()
        self.cut_bytes = 0
        """How many were left out between the first and the last."""

    def add(self, data: bytes) -> None:
        """Take more."""
        room = self._first_bytes - len(self._first)
        if room > 0:
            self._first += data[:room]
            data = data[room:]
        self._last += data
        over = len(self._last) - self._last_bytes
        if over > 0:
            del self._last[:over]
            self.cut_bytes += over

    @property
    def data(self) -> bytes:
        """Return what is kept, with a line in its midst that says what is not."""
        if not self.cut_bytes:
            return bytes(self._first + self._last)
        note = f"\n[... {self.cut_bytes} bytes left out ...]\n".encode()
        return bytes(self._first + note + self._last) if self._first else bytes(self._last)

    def text(self) -> str:
        """Return what is kept as text."""
        return self.data.decode(errors="replace")
