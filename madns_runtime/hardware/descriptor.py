"""The descriptor of a driver that is read whenever it is readable."""

from __future__ import annotations

import math
from collections.abc import Callable
from time import monotonic
from typing import Final

from madns_runtime.reactor.reactor import Reactor

EMPTY_READS_MAX: Final = 1000
"""Then a descriptor that is readable for nothing is looked at only every EMPTY_PAUSE_S."""
EMPTY_PAUSE_S: Final = 0.002
EMPTY_READS: Final = (
    f"its descriptor was readable {EMPTY_READS_MAX} times in a row and read() gave no sample: if the other end is gone,"
    " read() should raise"
)


class DriverDescriptor:
    """
    Waits for a descriptor; one that is readable again and again for nothing does not take a processor for itself.

    Args:
        fd: The driver's.
        reactor: The loop of the device's process.
        readable: Called when it is readable.
        tell: Told when it is readable for nothing, or was closed meanwhile, as `Intake.event`.

    Raises:
        OSError: It is not open.
    """

    def __init__(
        self,
        fd: int,
        reactor: Reactor,
        readable: Callable[[], None],
        tell: Callable[..., object],
    ) -> None:
        self._fd = fd
        self._reactor = reactor
        self._readable = readable
        self._tell = tell
        self._empty_reads = 0
        self._timer = reactor.call_at(math.inf, self._look_again)
        reactor.add_reader(fd, readable)

    def note_read(self, *, has_samples: bool) -> None:
        """Take note of whether anything was read when it was readable."""
        self._empty_reads = 0 if has_samples else self._empty_reads + 1
        if self._empty_reads <= EMPTY_READS_MAX:
            return
        if self._empty_reads == EMPTY_READS_MAX + 1:
            self._tell("empty_reads", monotonic(), why=EMPTY_READS)
        self._reactor.remove_reader(self._fd)
        self._timer.reschedule(monotonic() + EMPTY_PAUSE_S)

    def close(self) -> None:
        """Wait for it no more; call it before it is closed."""
        self._timer.cancel()
        self._reactor.remove_reader(self._fd)

    def _look_again(self) -> None:
        try:
            self._reactor.add_reader(self._fd, self._readable)
        except (
            OSError
        ) as error:  # the driver has closed it; a device that stays silent is opened anew
            why = f"its descriptor {self._fd} cannot be waited for: {error.strerror}"
            self._tell("error", monotonic(), why=why)
