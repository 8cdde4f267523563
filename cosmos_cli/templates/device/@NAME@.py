"""A driver: how many processes want to run on this computer. Put a device of your own in its place."""

import time
from dataclasses import dataclass
from pathlib import Path

from madns_runtime.hardware.contract import Channel, Device, DeviceKind, Sample


@dataclass(frozen=True, kw_only=True)
class DriverParameters:
    """Parameters that inventory or scenario may set."""

    file: str = "/proc/loadavg"
    """Where the number is read."""


class Driver(Device):
    """Called by a process of its own, one method at a time: it may take its time, no tick waits for it."""

    kind = DeviceKind(
        name="@NAME@",
        summary="how many processes want to run",
        parameters=DriverParameters,
        channels=(Channel(name="load", limits=(0.0, 10_000.0)),),
        rate_hz=10.0,
        needs_hardware=False,  # leave this out once it is bound to a board
    )

    def open(self) -> str:
        """Open the device, and return its identity, such as a serial number."""
        self.path = Path(self.parameters.file)
        self.path.read_text(encoding="ascii")
        return self.path.name

    def read(self) -> Sample:
        """Return what it measures now; an exception closes the device, and it is opened anew."""
        taken_s = time.monotonic()
        load = float(self.path.read_text(encoding="ascii").split()[0])
        return Sample(values={"load": load}, taken_s=taken_s)
