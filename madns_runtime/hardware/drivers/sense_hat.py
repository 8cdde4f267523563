"""Driver of `sense_hat`; see `madns_runtime.hardware.kinds.sense_hat`."""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping
from time import monotonic
from typing import Any, Final

from madns_runtime.errors import MachineError
from madns_runtime.hardware.contract import Device, Sample, Value
from madns_runtime.hardware.kinds.sense_hat import G0, PIXELS, XYZ

DIRECTIONS: Final = ("up", "down", "left", "right", "middle")


ACTIONS: Final = ("released", "pressed", "held")
EVENTS_MAX: Final = 256
"""Of the joystick that wait, one for each read: one that is held gives some 30 per second."""


class SenseHatDevice(Device):
    """The HAT through its own library, or the emulator's."""

    def open(self) -> str:
        """
        Open the HAT.

        Raises:
            MachineError: Its library is not installed, or it does not answer.
        """
        p = self.parameters
        self._environment_s = -math.inf
        self._pending: list[tuple[int, int]] = []
        library = "sense_emu" if p.emulated else "sense_hat"
        try:
            make = importlib.import_module(library).SenseHat
        except ImportError as error:
            cure = "pip install sense-emu" if p.emulated else "sudo apt install sense-hat"
            raise MachineError(f"{error.name} is not installed; {cure}") from None
        try:
            self._hat: Any = make()
            # Redrawn, the picture that is shown would be turned, also where outputs may not move.
            self._hat.set_rotation(p.rotation, redraw=False)
            self._hat.set_imu_config(p.magnetometer, p.gyroscope, p.accelerometer)
        except OSError as error:
            cure = "start sense_emu_gui" if p.emulated else "is it plugged in?"
            raise MachineError(f"the Sense HAT does not answer: {error}; {cure}") from None
        return "emulator" if p.emulated else "sense_hat"

    def read(self) -> Sample | None:
        """
        Return what the inertial sensors measure, and now and then the environment.

        Raises:
            MachineError: An inertial sensor gives nothing.
        """
        p = self.parameters
        values: dict[str, Value] = {}
        taken_s = monotonic()
        if p.gyroscope:
            values["gyroscope"] = _vector_of(self._hat.get_gyroscope_raw(), 1.0)
        if p.accelerometer:
            values["accelerometer"] = _vector_of(self._hat.get_accelerometer_raw(), G0)
        if p.magnetometer:
            values["magnetometer"] = _vector_of(self._hat.get_compass_raw(), 1e-6)
        if taken_s >= self._environment_s + p.environment_period_s:
            self._environment_s = taken_s
            values["temperature"] = self._hat.get_temperature()
            values["pressure"] = self._hat.get_pressure()
            values["humidity"] = self._hat.get_humidity()
        if p.joystick:
            self._pending += [
                (DIRECTIONS.index(event.direction), ACTIONS.index(event.action))
                for event in self._hat.stick.get_events()
            ]
            lost = max(0, len(self._pending) - EVENTS_MAX)
            self.count("joystick_lost", lost)
            del self._pending[:lost]
            if self._pending:
                values["joystick"] = self._pending.pop(0)
        return Sample(values=values, taken_s=taken_s) if values else None

    def write(self, values: Mapping[str, Value], due_s: float) -> None:
        """Show a picture: red, green and blue of 64 pixels, row by row."""
        numbers: Any = values["matrix"]
        pixels = [[round(n) for n in numbers[i : i + 3]] for i in range(0, PIXELS * 3, 3)]
        self._hat.set_pixels(pixels)

    def make_safe(self) -> None:
        """Switch the matrix off."""
        self._hat.clear()

    def close(self) -> None:
        """Stop listening to the joystick."""
        if (hat := getattr(self, "_hat", None)) is not None:
            del self._hat
            if (close := getattr(hat.stick, "close", None)) is not None:
                close()


def _vector_of(raw: Mapping[str, float] | None, scale: float) -> list[float]:
    if not raw:
        raise MachineError(
            "an inertial sensor of the Sense HAT gives nothing; is the user in the group i2c?"
        )
    return [raw[axis] * scale for axis in XYZ]
