"""Driver of `analog`; see `madns_runtime.hardware.kinds.analog`."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from time import monotonic
from typing import Any

from madns_runtime.errors import MachineError, PluginError
from madns_runtime.hardware.contract import Device, Sample, Value
from madns_runtime.hardware.drivers.kernel_files import (
    ValueRefused,
    read_number,
    read_text,
    write_text,
)
from madns_runtime.hardware.values import nearest_whole


class AnalogDevice(Device):
    """Files of one converter, read as text."""

    def open(self) -> str:
        """
        Find scales and offsets.

        Raises:
            MachineError: A file is missing, or says no number, or no scale.
        """
        p = self.parameters
        self._folder = Path(p.root) / p.device
        self._limits = {
            each.name: (each.low, each.high)
            for each in p.inputs
            if each.low is not None and each.high is not None
        }
        self._lines = {
            each.name: (
                self._folder / each.file,
                self._number(each.file, "scale", each.scale, 1.0),
                self._number(each.file, "offset", each.offset, 0.0),
            )
            for each in p.inputs
        }
        self.read()
        return read_text(self._folder / "name") if (self._folder / "name").is_file() else p.device

    def read(self) -> Sample | None:
        """Return all inputs."""
        taken_s = monotonic()
        values: dict[str, Value] = {}
        for each in self.parameters.inputs:
            if not each.is_output:
                path, scale, offset = self._lines[each.name]
                values[each.name] = (read_number(path) + offset) * scale
        if not values:
            for path, _, _ in self._lines.values():
                read_number(path)  # outputs alone: that they are there is all that is measured
        return Sample(values=values, taken_s=taken_s)

    def write(self, values: Mapping[str, Value], due_s: float) -> None:
        """
        Write outputs, by name.

        Raises:
            PluginError: The converter takes no such value.
            MachineError: It is gone.
        """
        number: Any
        for name, number in values.items():
            path, scale, offset = self._lines[name]
            raw = number / scale - offset
            if not math.isfinite(raw):
                raise PluginError(f"expected a value that the converter can hold, got {number:g}")
            limits = self._limits.get(name)
            if limits is not None:
                first, last = (each / scale - offset for each in limits)
                raw = nearest_whole(raw, (first, last))
            try:
                write_text(path, str(round(raw)))
            except ValueRefused as error:
                raise PluginError(str(error)) from None

    def make_safe(self) -> None:
        """Write the safe value of each output that has one."""
        self.write(
            {e.name: e.safe for e in self.parameters.inputs if e.is_output and e.safe is not None},
            0.0,
        )

    def _number(self, file: str, what: str, given: float | None, default: float) -> float:
        if given is not None:
            return given
        # A channel's own, such as in_voltage0_scale, else that of its type: in_voltage_scale, in_accel_scale of x.
        own = file.removesuffix("_raw")
        shared = re.sub(r"\d+", "", own)
        for name in (own, shared, re.sub(r"_[xyz]$", "", shared)):
            path = self._folder / f"{name}_{what}"
            if path.is_file():
                return _scale(path) if what == "scale" else read_number(path)
        return default


def _scale(path: Path) -> float:
    """
    Return the scale that a file says.

    Raises:
        MachineError: It says none that makes values.
    """
    scale = read_number(path)
    if not scale or not math.isfinite(scale):
        raise MachineError(f"{path}: expected a scale other than 0, got {read_text(path)}")
    return scale
