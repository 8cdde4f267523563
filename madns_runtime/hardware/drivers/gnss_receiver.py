"""Driver of `gnss_receiver`; see `madns_runtime.hardware.kinds.gnss_receiver`."""

from __future__ import annotations

import contextlib
import fcntl
import os
import termios
import tty
from collections.abc import Mapping
from pathlib import Path
from time import monotonic
from typing import Any

from madns_runtime.errors import MachineError
from madns_runtime.hardware.contract import Device, Sample, Value
from madns_runtime.hardware.drivers.hang_up import is_hung_up
from madns_runtime.hardware.gnss_messages import ToldQuality, encode
from madns_runtime.hardware.gnss_solution import GnssSolution

READ_BYTES = 4096
SPEED, INPUT_SPEED, OUTPUT_SPEED = "B{}", 4, 5
"""Name of a baud rate in termios, and places of the speeds in its attributes."""


class GnssReceiver(Device):
    """
    Writes each epoch as soon as it is due, and never waits: what the line does not take is given up whole, and counted.

    On a pseudo-terminal that nobody reads, the newest epochs take the place of those that were not read.
    """

    def open(self) -> str:
        """
        Make the pseudo-terminal, or open the port.

        The link is made with the first `read`: whoever opens a device only to make it safe leaves it alone.

        Raises:
            MachineError: The port is not there or not free.
        """
        p = self.parameters
        self._fd = self._other_fd = -1
        self._link: Path | None = None
        self._epochs = self._given_up = self._overwritten = self._heard_bytes = 0
        self._rest = b""
        self._quality = ToldQuality(
            position_m=p.position_accuracy_m,
            velocity_m_s=p.velocity_accuracy_m_s,
            time_ns=p.time_accuracy_ns,
            satellites=p.satellites,
            dilution=p.dilution,
            geoid_m=p.geoid_m,
        )
        if p.port:
            self._fd = _opened_port(p.port, p.baud_rate)
            return str(p.port)
        # This end of the far side stays open: who reads it may come and go.
        self._fd, self._other_fd = os.openpty()
        tty.setraw(self._other_fd)
        os.set_blocking(self._fd, False)
        return str(p.link)

    def read(self) -> Sample | None:
        """
        Return how many epochs went out.

        Raises:
            MachineError: The link's place is taken, or the port is gone.
        """
        if self._other_fd >= 0:
            self._keep_link(os.ttyname(self._other_fd))
        self._hear()
        self._write_rest()
        return Sample(values={"epochs": float(self._epochs)}, taken_s=monotonic())

    def _hear(self) -> None:
        """
        Count what somebody says; that tells of a port that is gone before an epoch is due.

        Raises:
            MachineError: It is.
        """
        try:
            data = os.read(self._fd, READ_BYTES)
        except BlockingIOError:
            return
        except OSError as error:
            raise self._gone(error.strerror) from None
        self._heard_bytes += len(data)
        if not data and is_hung_up(self._fd):  # an idle line may read as empty, too
            raise self._gone("end of file")

    def _gone(self, why: str | None) -> MachineError:
        return MachineError(f"{self.parameters.port or self._link} is gone: {why}")

    def _keep_link(self, terminal: str) -> None:
        """
        Make the link, and later see to it that it is still there.

        Raises:
            MachineError: Something else is there, or another receiver has it.
        """
        if self._link is None:
            self._link = _linked(str(self.parameters.link).replace("${name}", self.place), terminal)
        elif not _leads_to(self._link, terminal):
            raise MachineError(
                f"{self._link}: leads elsewhere now; a link with ${{name}} tells receivers apart"
            )

    def write(self, values: Mapping[str, Value], due_s: float) -> None:
        """
        Send the messages of an epoch.

        Raises:
            MachineError: The line is gone.
        """
        numbers: Any = values["epoch"]
        if not numbers[0] > 0.0:
            return  # no time, no solution
        p = self.parameters
        solution = GnssSolution.of(numbers, p.leap_seconds)
        data = b"".join(encode(name, solution, self._quality) for name in p.messages)
        self._write_rest()
        if self._rest:  # of the epoch before: the line is too slow
            self._given_up += 1
            self.count("epochs_given_up", 1)
            return
        sent = self._send(data)
        if sent < len(data) and self._other_fd >= 0:
            termios.tcflush(self._other_fd, termios.TCIFLUSH)
            self._overwritten += 1
            self.count("epochs_overwritten", 1)
            sent = self._send(data)
        self._rest = data[sent:]
        self._epochs += 1

    def _write_rest(self) -> None:
        if self._rest:
            self._rest = self._rest[self._send(self._rest) :]

    def _send(self, data: bytes) -> int:
        """Return how many bytes the line took."""
        try:
            return os.write(self._fd, data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise self._gone(error.strerror) from None

    def health(self) -> Mapping[str, float | int | str | bool | None]:
        """Return what was not taken, and how much somebody said to the receiver, which takes no orders."""
        return {
            "epochs_given_up": self._given_up,
            "epochs_overwritten": self._overwritten,
            "heard_bytes": self._heard_bytes,
        }

    def close(self) -> None:
        """Take the link away, and close the line."""
        if self._link is not None and self._other_fd >= 0:
            with contextlib.suppress(OSError):
                if _leads_to(self._link, os.ttyname(self._other_fd)):
                    self._link.unlink()
        for fd in (self._fd, self._other_fd):
            if fd >= 0:
                with contextlib.suppress(OSError, termios.error):
                    termios.tcflush(fd, termios.TCOFLUSH)  # closing waits for what is not sent
                os.close(fd)


def _linked(text: str, terminal: str) -> Path:
    """
    Make the link to a pseudo-terminal; one that an earlier run left behind gives way.

    Raises:
        MachineError: Something else is there, or it cannot be made.
    """
    link = Path(text)
    try:
        link.parent.mkdir(parents=True, exist_ok=True)
        if link.is_symlink() and os.readlink(link).startswith("/dev/pts/"):
            link.unlink()
        link.symlink_to(terminal)
    except FileExistsError:
        raise MachineError(f"{link}: something else is there; name another link") from None
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise MachineError(f"{link}: the link cannot be made: {why}") from None
    return link


def _leads_to(link: Path, terminal: str) -> bool:
    try:
        return os.readlink(link) == terminal
    except OSError:
        return False


def _opened_port(port: str, baud_rate: int) -> int:
    """
    Open a serial port for this process alone, raw.

    Raises:
        MachineError: It is not there, not free, or no serial port.
    """
    try:
        fd = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError as error:
        raise MachineError(
            f"{port}: {error.strerror}; is it plugged in, and yours to open?"
        ) from None
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        tty.setraw(fd)
        settings = termios.tcgetattr(fd)
        settings[INPUT_SPEED] = settings[OUTPUT_SPEED] = getattr(termios, SPEED.format(baud_rate))
        termios.tcsetattr(fd, termios.TCSANOW, settings)
    except BlockingIOError:
        os.close(fd)
        raise MachineError(f"{port}: another program has it open") from None
    except (OSError, termios.error) as error:
        os.close(fd)
        raise MachineError(f"{port}: no serial port of {baud_rate} bit/s: {error}") from None
    return fd
