"""
A CP2112 on a cable of our own: a USB bridge with eight digital lines and an I2C bus, behind the kernel's own driver.

The kernel's driver (hid-cp2112) makes a real /dev/gpiochipN and /dev/i2c-N of it; what the chip would answer over USB
comes by /dev/uhid from this program. A chip at I2C address 0x1d holds 256 registers. Lines come on standard input, one
answer goes out for each:

    plug; pull; set LINE 0|1 (from outside); lines (levels, hexadecimal); outputs (mask); register ADDRESS; chip 0|1

Source of the reports: Silicon Labs, AN495 (CP2112 interface specification).
"""

from __future__ import annotations

import contextlib
import os
import select
import struct
import subprocess
import sys
from collections.abc import Iterator

CHIP = 0x1D
EVENT_BYTES = 4380
# uhid.h
DESTROY, OUTPUT, GET, GET_REPLY, CREATE, INPUT, SET, SET_REPLY = 1, 6, 9, 10, 11, 12, 13, 14
USB, VENDOR, PRODUCT = 3, 0x10C4, 0xEA90
# AN495
GPIO_CONFIG, GPIO_GET, GPIO_SET, VERSION, SMBUS_CONFIG = 0x02, 0x03, 0x04, 0x05, 0x06
READ, WRITE_READ, FORCE_SEND, READ_ANSWER, WRITE = 0x10, 0x11, 0x12, 0x13, 0x14
STATUS, STATUS_ANSWER, LOCK = 0x15, 0x16, 0x20
COMPLETE, FAILED, NO_ANSWER, SUCCESS = 0x02, 0x03, 0x00, 0x05
DESCRIPTOR = bytes.fromhex(
    "0600ff 0901 a101 1500 26ff00 7508"  # vendor-defined; bytes
    "8513 953f 0901 8102 8516 953f 0901 8102"  # inputs
    "8510 953f 0901 9102 8511 953f 0901 9102 8512 953f 0901 9102 8514 953f 0901 9102 8515 953f 0901 9102"
    "8502 9504 0901 b102 8503 9501 0901 b102 8504 9502 0901 b102 8505 9502 0901 b102 8506 950d 0901 b102"
    "8520 9501 0901 b102 c0"
)


class Bridge:
    """The chip: its lines, its bus, and its end of the cable."""

    def __init__(self) -> None:
        self.fd = -1
        self.levels = self.outputs = self.driven = 0
        self.registers = bytearray(256)
        self.registers[0x0F] = 0x33
        self.pointer = 0
        self.answer = b""
        self.has_chip = True

    def plug(self) -> None:
        self.fd = os.open("/dev/uhid", os.O_RDWR | os.O_CLOEXEC)
        self.outputs = self.driven = 0
        head = struct.pack("<I128s64s64sHHIIII", CREATE, b"CP2112", b"", b"bridge-1", len(DESCRIPTOR),
                           USB, VENDOR, PRODUCT, 0, 0)  # fmt: skip
        os.write(self.fd, head + DESCRIPTOR)

    def pull(self) -> None:
        os.close(self.fd)  # the kernel takes the device away
        self.fd = -1

    def lines(self) -> int:
        """Levels: outputs as they were set, the others as they are from outside."""
        return (self.driven & self.outputs) | (self.levels & ~self.outputs & 0xFF)

    def serve(self) -> None:
        """Answer one event of the kernel."""
        event = os.read(self.fd, EVENT_BYTES)
        (kind,) = struct.unpack_from("<I", event)
        if kind == GET:
            number, report, _ = struct.unpack_from("<IBB", event, 4)
            data = self._get(report)
            os.write(self.fd, struct.pack("<IIHH", GET_REPLY, number, 0, len(data)) + data)
        elif kind == SET:
            number, report, _, size = struct.unpack_from("<IBBH", event, 4)
            self._set(event[12 : 12 + size])
            os.write(self.fd, struct.pack("<IIH", SET_REPLY, number, 0))
        elif kind == OUTPUT:
            (size,) = struct.unpack_from("<H", event, 4 + 4096)
            self._transfer(event[4 : 4 + size])

    def _get(self, report: int) -> bytes:
        if report == GPIO_CONFIG:
            return bytes((report, self.outputs, 0xFF, 0, 0))
        if report == GPIO_GET:
            return bytes((report, self.lines()))
        if report == VERSION:
            return bytes((report, 0x0C, 0x03))
        if report == SMBUS_CONFIG:
            return struct.pack(">BIBBHHBH", report, 100_000, 0x02, 0, 0, 0, 0, 0)
        return bytes((report, 0xFF))

    def _set(self, data: bytes) -> None:
        if data[0] == GPIO_CONFIG:
            self.outputs = data[1]
        elif data[0] == GPIO_SET:
            self.driven = (self.driven & ~data[2]) | (data[1] & data[2])

    def _transfer(self, data: bytes) -> None:
        if data[0] in (READ, WRITE_READ, WRITE):
            self.answer = b""
            self.is_answered = self.has_chip and data[1] >> 1 == CHIP
            if data[0] == WRITE and self.is_answered:
                self._write(data[3 : 3 + data[2]])
            elif self.is_answered:
                (length,) = struct.unpack_from(">H", data, 2)
                if data[0] == WRITE_READ:
                    self.pointer = data[5]
                self.answer = bytes(self.registers[self.pointer : self.pointer + length])
        elif data[0] == STATUS:
            words = (COMPLETE, SUCCESS) if self.is_answered else (FAILED, NO_ANSWER)
            self._say(struct.pack(">BBBHH", STATUS_ANSWER, *words, 0, len(self.answer)))
        elif data[0] == FORCE_SEND:
            block, self.answer = self.answer[:61], self.answer[61:]
            self._say(bytes((READ_ANSWER, COMPLETE, len(block))) + block)

    def _write(self, data: bytes) -> None:
        self.pointer = data[0]
        self.registers[self.pointer : self.pointer + len(data) - 1] = data[1:]

    def _say(self, data: bytes) -> None:
        data = data.ljust(64, b"\0")
        os.write(self.fd, struct.pack("<IH", INPUT, len(data)) + data)

    def obey(self, line: str) -> str:
        """Do what a line says, and return the answer."""
        word, *rest = line.split()
        if word == "set":
            bit = 1 << int(rest[0])
            self.levels = self.levels | bit if rest[1] == "1" else self.levels & ~bit
        elif word == "chip":
            self.has_chip = rest[0] == "1"
        elif word == "register":
            return str(self.registers[int(rest[0], 0)])
        elif word == "lines":
            return f"{self.lines():02x}"
        elif word == "outputs":
            return f"{self.outputs:02x}"
        else:
            {"plug": self.plug, "pull": self.pull}[word]()
        return "done"


def main() -> None:
    bridge = Bridge()
    while True:
        watched = [0] if bridge.fd < 0 else [0, bridge.fd]
        ready = select.select(watched, [], [])[0]
        if bridge.fd in ready:
            bridge.serve()
        if 0 in ready:
            line = sys.stdin.readline()
            if not line:
                return
            print(bridge.obey(line), flush=True)  # noqa: T201 - it speaks by its standard output


class Cable:
    """The bridge in a process of its own, as a test holds it."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def ask(self, line: str) -> str:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()
        return self._process.stdout.readline().strip()

    def lines(self) -> int:
        return int(self.ask("lines"), 16)


@contextlib.contextmanager
def bridge() -> Iterator[Cable]:
    """Run a bridge, not plugged in yet."""
    with subprocess.Popen(
        [sys.executable, __file__], text=True, bufsize=1, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:  # fmt: skip
        try:
            yield Cable(process)
        finally:
            process.kill()


if __name__ == "__main__":
    main()
