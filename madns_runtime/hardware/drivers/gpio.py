"""Driver of `gpio`; see `madns_runtime.hardware.kinds.gpio`."""

from __future__ import annotations

import contextlib
import errno
import glob
from collections.abc import Mapping
from datetime import timedelta
from time import monotonic
from typing import Any, Final

import gpiod

from madns_runtime.errors import MachineError
from madns_runtime.hardware.contract import Device, Sample, Value
from madns_runtime.hardware.kinds.gpio import GpioLine

CURES: Final = {
    errno.ENOENT: "there is no such chip",
    errno.EACCES: "permission denied; add the user to the group gpio",
    errno.EBUSY: "another program has one of the lines",
    errno.EINVAL: "it has not all of these lines, or they cannot do this",
}
"""Words for lines that are refused, and what to do."""


class GpioDevice(Device):
    """Lines behind gpiod, requested together."""

    def open(self) -> str:
        """
        Request the lines.

        Raises:
            MachineError: There is no such chip or line, or another program has it.
        """
        p = self.parameters
        self._request: Any = None
        self._names = {line.offset: line.name for line in p.lines}
        self._offsets = {line.name: line.offset for line in p.lines}
        self._levels = [line.offset for line in p.lines if line.mode == "level"]
        self._all = [line.offset for line in p.lines]
        self._has_edges = any(line.mode == "edges" for line in p.lines)
        self._edges: list[Sample] = []
        self._numbers = dict.fromkeys(self._all, 0)
        """By offset: number of the newest edge, as the kernel counts all of a line."""
        path = p.chip if "/" in p.chip else _path_of(p.chip)
        try:
            self._request = gpiod.request_lines(
                path,
                consumer="cosmos",
                config={line.offset: self._settings(line) for line in p.lines},
            )
        except ValueError:  # gpiod's own look at the offsets
            raise MachineError(f"{p.chip}: {CURES[errno.EINVAL]}") from None
        except OSError as error:
            raise MachineError(f"{p.chip}: {CURES.get(error.errno or 0, str(error))}") from None
        return str(p.chip)

    def fileno(self) -> int | None:
        """Return the request's descriptor where edges are read."""
        return int(self._request.fd) if self._has_edges else None

    def read(self) -> Sample | None:
        """
        Return the levels, or the next edge, at the time at which the kernel saw it.

        Raises:
            MachineError: The chip is gone.
        """
        if self._has_edges:
            return self._next_edge()
        taken_s = monotonic()
        # Outputs alone are read, too: that the chip is there is all that is measured then.
        levels = self._levels_of(self._levels or self._all)
        if not self._levels:
            return Sample(values={}, taken_s=taken_s)
        active = gpiod.line.Value.ACTIVE
        values: dict[str, Value] = {
            self._names[offset]: float(level == active)
            for offset, level in zip(self._levels, levels, strict=True)
        }
        return Sample(values=values, taken_s=taken_s)

    def write(self, values: Mapping[str, Value], due_s: float) -> None:
        """Set outputs; what is at least one half is active."""
        number: Any
        for name, number in values.items():
            self._set(self._offsets[name], number >= 0.5)

    def health(self) -> Mapping[str, float | int | str | bool | None]:
        """
        Look after the chip where edges are waited for: of one that is gone nothing comes, and no error either.

        Raises:
            MachineError: The chip is gone.
        """
        if self._has_edges:
            self._levels_of(self._all)
        return {}

    def make_safe(self) -> None:
        """Set each output to its safe state."""
        for line in self.parameters.lines:
            if line.mode == "output":
                self._set(line.offset, bool(line.safe))

    def close(self) -> None:
        """Give the lines back."""
        if self._request is not None:
            self._request.release()

    def _set(self, offset: int, is_active: bool) -> None:
        value = gpiod.line.Value
        try:
            self._request.set_value(offset, value.ACTIVE if is_active else value.INACTIVE)
        except OSError as error:
            raise self._gone(error) from None

    def _levels_of(self, offsets: list[int]) -> list[Any]:
        try:
            return list(self._request.get_values(offsets))
        except OSError as error:
            raise self._gone(error) from None

    def _next_edge(self) -> Sample | None:
        if not self._edges:
            try:
                events = (
                    self._request.read_edge_events() if self._request.wait_edge_events(0) else []
                )
            except OSError as error:
                raise self._gone(error) from None
            self._edges = [self._edge(event) for event in events][::-1]
        return self._edges.pop() if self._edges else None

    def _gone(self, error: OSError) -> MachineError:
        return MachineError(f"{self.parameters.chip} is gone: {error.strerror}")

    def _edge(self, event: Any) -> Sample:
        offset = event.line_offset
        # The kernel keeps 16 edges per line, and forgets the oldest of more.
        self.count("edges_lost", max(0, event.line_seqno - self._numbers[offset] - 1))
        self._numbers[offset] = event.line_seqno
        is_rising = event.event_type == gpiod.EdgeEvent.Type.RISING_EDGE
        taken_s = event.timestamp_ns * 1e-9  # of CLOCK_MONOTONIC, as asked for
        return Sample(values={self._names[offset]: float(is_rising)}, taken_s=taken_s)

    def _settings(self, line: GpioLine) -> Any:
        kinds = gpiod.line
        settings = gpiod.LineSettings(
            bias=getattr(kinds.Bias, line.bias.upper()),
            active_low=line.active_low,
            debounce_period=timedelta(seconds=line.debounce_s),
            event_clock=kinds.Clock.MONOTONIC,
        )
        if line.mode == "output" and not self.may_move:
            settings.direction = kinds.Direction.AS_IS
            settings.bias = kinds.Bias.AS_IS  # the kernel takes another one with a direction alone
        elif line.mode == "output":
            settings.direction = kinds.Direction.OUTPUT
            settings.output_value = kinds.Value.ACTIVE if line.safe else kinds.Value.INACTIVE
        else:
            settings.direction = kinds.Direction.INPUT
        if line.mode == "edges":
            settings.edge_detection = getattr(kinds.Edge, line.edge.upper())
        return settings


def _path_of(label: str) -> str:
    """
    Return the device file of the chip that bears a label.

    Raises:
        MachineError: None does, or several.
    """
    found = []
    for path in sorted(glob.glob("/dev/gpiochip*")):
        with contextlib.suppress(OSError), gpiod.Chip(path) as chip:  # one that is just going
            if chip.get_info().label == label:
                found.append(path)
    if len(found) != 1:
        told = (
            f"{len(found)} chips bear that label ({', '.join(found)})"
            if found
            else "there is no such chip"
        )
        raise MachineError(f"{label}: {told}; see `gpiodetect`")
    return found[0]
