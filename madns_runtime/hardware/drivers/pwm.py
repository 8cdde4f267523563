"""Driver of `pwm`; see `madns_runtime.hardware.kinds.pwm`."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping
from pathlib import Path
from time import monotonic
from typing import Any

from madns_runtime.errors import MachineError
from madns_runtime.hardware.contract import Device, Sample, Value
from madns_runtime.hardware.drivers.kernel_files import read_number, read_text, write_text

POLL_S = 0.01
EXPORT_S = 0.5
"""After it was asked for, a line's files appear and become writable within this."""


class PwmDevice(Device):
    """One line of a chip."""

    def open(self) -> str:
        """
        Ask for the line, and where outputs may move switch it on in its safe state.

        Raises:
            MachineError: There is no such line, or it may not be written.
        """
        p = self.parameters
        chip = Path(p.root) / f"pwmchip{p.chip}"
        self._line = chip / f"pwm{p.line}"
        self._period_ns = round(p.period_s * 1e9)
        self._is_turned = False
        """Whether the line, which may not be moved, has the other polarity."""
        if not self._line.is_dir():
            write_text(chip / "export", str(p.line))
        until_s = monotonic() + EXPORT_S
        while True:
            try:
                self._set_up()
                return str(self._line)
            except MachineError:
                if monotonic() > until_s:
                    raise
                time.sleep(POLL_S)  # the kernel gives the group its rights a moment after the files

    def read(self) -> Sample:
        """Return the duty that is set."""
        taken_s = monotonic()
        duty_ns = read_number(self._line / "duty_cycle")
        share = duty_ns / self._period_ns
        return Sample(
            values={"duty_set": 1.0 - share if self._is_turned else share}, taken_s=taken_s
        )

    def write(self, values: Mapping[str, Value], due_s: float) -> None:
        """Set the duty, 0 to 1."""
        self._set_duty(values["duty"])

    def make_safe(self) -> None:
        """Set the safe duty."""
        self._set_duty(self.parameters.safe)

    def close(self) -> None:
        """Leave the line as it is: it keeps its safe duty."""

    def _set_up(self) -> None:
        is_turned = self._polarity() != self.parameters.polarity
        if not self.may_move:
            self._period_ns = max(1, round(read_number(self._line / "period")))
            self._is_turned = is_turned
            return
        if is_turned and read_text(self._line / "enable") != "0":
            # A duty of 0 would switch it on wholly until then, and a line that runs keeps its polarity.
            write_text(self._line / "enable", "0")
        # The period may not become shorter than the duty that an earlier owner has left.
        with contextlib.suppress(MachineError):
            write_text(self._line / "duty_cycle", "0")
        write_text(self._line / "period", str(self._period_ns))
        if is_turned:  # the kernel takes it with a period alone
            write_text(self._line / "polarity", self.parameters.polarity)
        self._set_duty(self.parameters.safe)
        write_text(self._line / "enable", "1")

    def _polarity(self) -> str:
        """Return what the line has, such as an earlier program left it; normal where the kernel tells none."""
        path = self._line / "polarity"
        return read_text(path) if path.is_file() else "normal"

    def _set_duty(self, duty: Any) -> None:
        write_text(self._line / "duty_cycle", str(round(duty * self._period_ns)))
