"""A pseudo-terminal that stands in for a serial line: it sends frames, garbage, and is pulled out."""

from __future__ import annotations

import contextlib
import os
import random
import select
import signal
import threading
import tty
from time import monotonic, sleep
from typing import Any, Final

from madns_runtime.errors import MachineError
from madns_runtime.hardware.contract import Device
from madns_runtime.hardware.framing import FRAMERS, make_framer
from madns_runtime.hardware.kind_registry import DeviceProgram
from madns_runtime.hardware.verification.driver import held
from madns_runtime.hardware.verification.order import (
    MEMORY_BYTES_MAX,
    SAFE_S_MAX,
    STEP_S_MAX,
    Findings,
    VerificationFinding,
    VerificationOrder,
    finding,
    has_stand_in,
    make_program,
)

GARBAGE_BYTES: Final = 1 << 20
CONTENT: Final = b"0123456789"
"""Of a frame."""


@contextlib.contextmanager
def line_of(order: VerificationOrder, program: DeviceProgram, rate_hz: float) -> Any:
    """Yield the program, on a pseudo-terminal whose other end sends frames if a stand-in is wanted."""
    if not has_stand_in(order):
        yield program
        return
    own, other = os.openpty()
    tty.setraw(other)
    pid = os.fork()
    if pid == 0:
        try:
            _feed(own, _frame_of(program), 1.0 / rate_hz)
        finally:
            os._exit(0)
    try:
        yield make_program(order, os.ttyname(other))
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        os.close(own)
        os.close(other)


def _feed(fd: int, frame: bytes, period_s: float) -> None:
    """Send frames until killed or left alone, and take what comes."""
    os.set_blocking(fd, False)
    parent, due_s = os.getppid(), monotonic()
    while os.getppid() == parent:
        due_s += period_s
        with contextlib.suppress(BlockingIOError):
            os.write(fd, frame)
        with contextlib.suppress(BlockingIOError):
            os.read(fd, 65_536)
        sleep(max(0.0, due_s - monotonic()))


def _frame_of(program: DeviceProgram) -> bytes:
    """Return a frame as its line brings it, of as many bytes as its input takes."""
    parameters: Any = program.parameters
    framing: Any = getattr(parameters, "framing", "")
    sizes = (c.frame_bytes_max for c in program.channels if c.direction == "in" and c.is_frame)
    frame_bytes_max = min(sizes, default=len(CONTENT))
    framer = make_framer(
        framing if framing in FRAMERS else "lines",
        frame_bytes_max,
        getattr(parameters, "length_bytes", 2),
        getattr(parameters, "length_order", "little"),
    )
    return framer.wrap(CONTENT[:frame_bytes_max])


def spoil_line(order: VerificationOrder) -> Findings:
    """Send garbage as fast as it is taken, then a frame, then pull the line out."""
    own, other = os.openpty()
    tty.setraw(other)
    program = make_program(order, os.ttyname(other))
    os.close(os.dup(other))
    device = program.make()
    try:
        device.open()
        fd = device.fileno()
        before_bytes = held()[2]
        sender = threading.Thread(
            target=_send, args=(own, random.Random(1).randbytes(GARBAGE_BYTES)), daemon=True
        )
        sender.start()
        taken, until_s = 0, monotonic() + STEP_S_MAX / 3
        while monotonic() < until_s:
            has_more = fd is None or bool(select.select([fd], [], [], 0.2)[0])
            if not has_more and not sender.is_alive():
                break
            taken += device.read() is not None
            if fd is None and not sender.is_alive():
                break
        grown_bytes = held()[2] - before_bytes
        is_taken = not sender.is_alive()
        findings = [
            finding(
                "garbage",
                is_taken and grown_bytes <= MEMORY_BYTES_MAX,
                f"{GARBAGE_BYTES >> 10} KiB {'taken' if is_taken else 'not taken'},"
                f" {grown_bytes / 2**20:+.1f} MiB",
                f"taken, {MEMORY_BYTES_MAX / 2**20:+.1f} MiB",
            )
        ]
        os.close(other)
        os.close(own)
        return [*findings, _unplugged(device)]
    finally:
        device.close()


def _send(fd: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(fd, view[:4096]) :]


def _unplugged(device: Device) -> VerificationFinding:
    limit = f"an error within {SAFE_S_MAX:g} s"
    began_s = monotonic()
    while monotonic() < began_s + SAFE_S_MAX:
        try:
            device.read()
        except (MachineError, OSError) as error:
            return finding("unplugged", True, str(error), limit)
        sleep(0.01)
    return finding("unplugged", False, "not noticed", limit)
