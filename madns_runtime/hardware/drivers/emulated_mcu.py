"""Driver of `emulated_mcu`; see `madns_runtime.hardware.kinds.emulated_mcu`."""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import select
import shutil
import socket
import subprocess
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any, Final, Literal

from madns_runtime.bounded_files import FileRefused, read_regular_file
from madns_runtime.errors import MachineError
from madns_runtime.hardware.contract import Device, Sample, Value
from madns_runtime.hardware.drivers.qmp import MachineMonitor
from madns_runtime.hardware.kinds.emulated_mcu import (
    CHUNK_BYTES_MAX,
    HELD,
    EmulatedMcuParameters,
    EmulatedSensor,
)
from madns_runtime.plugin.context import clean_text
from madns_runtime.reactor.poller import TimerFd
from madns_runtime.reactor.scheduling import die_with_parent

START_S: Final = 10.0
"""For the emulator to greet."""
END_S: Final = 2.0
FIRMWARE_BYTES_MAX: Final = 64 << 20
ELF_MARK: Final = b"\x7fELF"
ELF_LITTLE: Final = b"\x01"
"""At byte 5: numbers have their least byte first."""
ELF_MACHINE: Final = slice(18, 20)
ELF_ARM: Final = 40
WORDS_BYTES_MAX: Final = 4096
"""Of what the emulator says on standard error: the end of it is kept."""
WORDS_READS_MAX: Final = 32
"""At a time: a pipe holds half as much."""
UNSENT_BYTES_MAX: Final = 65_536
"""Of the serial line that the emulator has not taken yet."""


class EmulatedMcu(Device):
    """A process of QEMU: its first serial line and its monitor are pairs of sockets that end with either side."""

    parameters: EmulatedMcuParameters
    carries_out = frozenset({"freeze"})
    """Sensors that are frozen hold what they held: the firmware reads it again and again."""
    _process: subprocess.Popen[bytes] | None = None
    _lost_bytes = 0
    _gathered = _unsent = b""

    def open(self) -> str:
        """
        Start the emulator, and return the board and the beginning of the firmware's SHA-256.

        Raises:
            MachineError: Emulator or firmware are not there, or it does not start.
        """
        p = self.parameters
        program = shutil.which(p.program)
        if program is None:
            raise MachineError(
                f"{p.program} is not installed here; sudo apt install {Path(p.program).name}"
            )
        try:
            image = read_regular_file(p.firmware, bytes_max=FIRMWARE_BYTES_MAX)
        except FileNotFoundError:
            raise MachineError(f"no firmware {p.firmware}; build it first") from None
        except (OSError, FileRefused) as error:
            raise MachineError(f"{p.firmware} cannot be read: {error}") from None
        if fault := _image_fault(image, Path(program).name):
            raise MachineError(f"{p.firmware} {fault}")
        self._poll = select.epoll()
        self._held: dict[tuple[str, int], Any] = {}
        """Values that the sensors hold, by sensor and element, as far as it was told since it was asked for."""
        self._is_asked = False
        self._timer = TimerFd()
        self._gathered = b""
        """Bytes of the serial line that are not handed over yet."""
        self._gathered_s = math.inf
        """When they are."""
        self._taken_s = -math.inf
        """When the last of them came."""
        self._unsent = b""
        self._room_bytes = self.parameters.line_bytes_s
        """Bytes that the line may still bring, by its rate."""
        self._room_s = monotonic()
        """When that was reckoned."""
        self._said = b""
        self._serial, far_serial = socket.socketpair()
        monitor, far_monitor = socket.socketpair()
        self._monitor = MachineMonitor(monitor, self._processes)
        with far_serial, far_monitor:
            self._start(program, far_serial.fileno(), far_monitor.fileno())
        self._serial.setblocking(False)
        try:
            self._monitor.begin(monotonic() + START_S)
        except MachineError as error:
            raise MachineError(f"{error}{self._words()}") from None
        lines = (self._serial.fileno(), self._monitor.fileno(), self._timer.fd, self._words_fd())
        for descriptor in lines:
            self._poll.register(descriptor, select.EPOLLIN)
        self._held_s = monotonic()
        self._set_timer()
        return f"{p.machine} {hashlib.sha256(image).hexdigest()[:12]}"

    def fileno(self) -> int:
        """Return a descriptor that is readable when line or monitor have something to tell."""
        return self._poll.fileno()

    def read(self) -> Sample | None:
        """
        Return what the serial line has brought, or what the sensors hold.

        Raises:
            MachineError: The emulator has ended, or answers no more.
        """
        try:
            self._monitor.poll()
        except MachineError as error:
            raise MachineError(f"{error}{self._words()}") from None
        self._take_words()
        self._push()
        now_s = monotonic()
        if now_s >= self._held_s:
            self._ask_held(now_s)
        if (values := self._take_held()) is not None:
            return Sample(values=values, taken_s=now_s)
        return self._gather(now_s)

    def write(self, values: Mapping[str, Value], due_s: float) -> None:
        """
        Send bytes on the serial line, or set a sensor.

        Raises:
            MachineError: The emulator does not take it.
        """
        for name, value in values.items():
            if name == "sent":
                assert isinstance(value, bytes)
                self._send(value)
            else:
                sensor = next(each for each in self.parameters.sensors if each.name == name)
                self._set(sensor, value)

    def health(self) -> Mapping[str, float | int | str | bool | None]:
        """Return what the line has lost."""
        return {"lost_bytes": self._lost_bytes}

    def close(self) -> None:
        """End the emulator; bytes of its line that are on their way, either way, are counted."""
        self.count("bytes_left", len(self._gathered))
        self.count("bytes_unsent", len(self._unsent))
        self._gathered = self._unsent = b""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(END_S)
            if process.stderr is not None:
                process.stderr.close()
        for line in ("_serial", "_monitor", "_timer", "_poll"):
            if hasattr(self, line):
                getattr(self, line).close()

    def _start(self, program: str, serial: int, monitor: int) -> None:
        p = self.parameters
        loading = (
            ["-kernel", str(p.firmware)]
            if p.loading == "kernel"
            else ["-device", f"loader,file={str(p.firmware).replace(',', ',,')}"]
        )
        command = [program, "-M", p.machine, *loading, "-display", "none", "-nodefaults"]
        for sensor in p.sensors:
            address = "" if sensor.address is None else f",address={sensor.address}"
            command += ["-device", f"{sensor.model},id={sensor.name}{address}"]
        command += ["-chardev", f"socket,id=line,fd={serial}"]
        command += ["-serial", "null"] * p.serial_port + ["-serial", "chardev:line"]
        command += ["-chardev", f"socket,id=monitor,fd={monitor}", "-mon", "monitor,mode=control"]
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                bufsize=0,
                pass_fds=(serial, monitor),
                start_new_session=True,  # a terminal's Ctrl-C is the operator's
                preexec_fn=die_with_parent,
            )
        except (OSError, subprocess.SubprocessError) as error:
            raise MachineError(f"{p.program} cannot be started: {error}") from None
        assert self._process.stderr is not None
        os.set_blocking(self._process.stderr.fileno(), False)

    def _processes(self) -> list[int]:
        return [] if self._process is None else [self._process.pid]

    def _gather(self, now_s: float) -> Sample | None:
        """Take what the serial line brings, byte by byte as an emulated one does, and return it in pieces."""
        room = CHUNK_BYTES_MAX - len(self._gathered)
        try:
            data = self._serial.recv(room)
        except BlockingIOError:
            data = None
        except OSError:
            data = b""
        if data == b"":
            raise MachineError(f"the emulator is gone: its line is closed{self._words()}")
        if data and (data := self._within_rate(data, now_s)):
            if not self._gathered:
                self._gathered_s = now_s + self.parameters.gather_s
                self._set_timer()
            self._gathered += data
            self._taken_s = now_s
        if now_s < self._gathered_s and len(self._gathered) < CHUNK_BYTES_MAX:
            return None
        sample = Sample(values={"received": self._gathered}, taken_s=self._taken_s)
        self._gathered, self._gathered_s = b"", math.inf
        self._set_timer()
        return sample

    def _within_rate(self, data: bytes, now_s: float) -> bytes:
        """Return as much of what has come as the line's rate has room for; the rest is lost."""
        rate = self.parameters.line_bytes_s
        room_bytes = min(rate, self._room_bytes + rate * (now_s - self._room_s))
        taken = data[: int(room_bytes)]
        self._room_bytes, self._room_s = room_bytes - len(taken), now_s
        self._lose(len(data) - len(taken))
        return taken

    def _lose(self, number: int) -> None:
        self._lost_bytes += number
        self.count("lost_bytes", number)

    def _set_timer(self) -> None:
        self._timer.set(min(self._held_s, self._gathered_s))

    def _send(self, data: bytes) -> None:
        room = UNSENT_BYTES_MAX - len(self._unsent)
        self._lose(max(0, len(data) - room))
        self._unsent += data[:room]
        self._push()

    def _push(self) -> None:
        try:
            while self._unsent:
                self._unsent = self._unsent[self._serial.send(self._unsent) :]
        except BlockingIOError:
            return
        except OSError as error:
            raise MachineError(f"the emulator is gone: {error.strerror}{self._words()}") from None

    def _set(self, sensor: EmulatedSensor, value: Value) -> None:
        if "freeze" in self.inserted_faults:
            return
        numbers = value if isinstance(value, list | tuple) else [value]
        for name, number in zip(sensor.properties, numbers, strict=True):
            self._monitor.command(
                "qom-set",
                _ignore,
                path=f"/machine/peripheral/{sensor.name}",
                property=name,
                value=round(float(number) * sensor.counts_per_unit),
            )

    def _ask_held(self, now_s: float) -> None:
        """Ask what the sensors hold, unless that is under way."""
        # The next whole period, so that a late turn does not shift those after it.
        period_s = 1.0 / self.parameters.held_hz
        self._held_s += period_s * max(1, math.ceil((now_s - self._held_s) / period_s))
        self._set_timer()
        if self._is_asked:
            return
        self._is_asked = True
        if not self.parameters.sensors:  # whether it still answers
            self._monitor.command("query-status", partial(self._held.__setitem__, ("", 0)))
        for sensor in self.parameters.sensors:
            for element, name in enumerate(sensor.properties):
                self._monitor.command(
                    "qom-get",
                    partial(self._held.__setitem__, (sensor.name, element)),
                    path=f"/machine/peripheral/{sensor.name}",
                    property=name,
                )

    def _take_held(self) -> dict[str, list[float] | float] | None:
        """Return what all sensors hold, once it is told; None before."""
        sensors = self.parameters.sensors
        count = sum(len(each.properties) for each in sensors)
        if not self._is_asked or len(self._held) < max(1, count):
            return None
        values: dict[str, list[float] | float] = {}
        for sensor in sensors:
            numbers = [
                self._number(sensor, element) / sensor.counts_per_unit
                for element in range(len(sensor.properties))
            ]
            values[f"{sensor.name}{HELD}"] = numbers if len(numbers) > 1 else numbers[0]
        self._held.clear()
        self._is_asked = False
        return values

    def _number(self, sensor: EmulatedSensor, element: int) -> float:
        """
        Return what an element holds, in the property's own counts.

        Raises:
            MachineError: The property is no number's.
        """
        told = self._held[sensor.name, element]
        if not isinstance(told, int | float):
            raise MachineError(
                f"sensor {sensor.name}: expected a number in {sensor.properties[element]} of {sensor.model}, got {told!r:.80}"
            )
        return float(told)

    def _words_fd(self) -> int:
        assert self._process is not None
        assert self._process.stderr is not None
        return self._process.stderr.fileno()

    def _take_words(self) -> None:
        """Take what the emulator says on standard error: with a pipe that is full it would stand still."""
        fd = self._words_fd()
        with contextlib.suppress(OSError):
            for _ in range(WORDS_READS_MAX):
                data = os.read(fd, WORDS_BYTES_MAX)
                if not data:  # closed, and readable from now on
                    self._poll.unregister(fd)
                    return
                self._said = (self._said + data)[-WORDS_BYTES_MAX:]

    def _words(self) -> str:
        """Return what the emulator said of its end on standard error: its first line of its own, else the last one."""
        if self._process is None:
            return ""
        self._take_words()
        lines = self._said.decode(errors="replace").strip().splitlines()
        own = [line for line in lines if line.startswith("qemu") and "warning:" not in line]
        said = (own or lines[-1:] or [""])[0]
        return f"; it said: {clean_text(said)!r}" if said else ""


def _ignore(_answer: Any) -> None:
    """Take that a value was set."""


def _image_fault(image: bytes, program: str) -> str:
    """Return why an image cannot be firmware for an emulator, which would run it all the same; empty if it may be."""
    if not image:
        return "is empty; build it first"
    is_elf = image.startswith(ELF_MARK) and len(image) >= ELF_MACHINE.stop
    order: Literal["little", "big"] = "little" if image[5:6] == ELF_LITTLE else "big"
    machine = int.from_bytes(image[ELF_MACHINE], order)
    if is_elf and program == "qemu-system-arm" and machine != ELF_ARM:
        return (
            f"is a program for another processor (e_machine {machine} of its ELF header, an Arm's is {ELF_ARM}); build it"
            " with arm-none-eabi-gcc"
        )
    return ""
