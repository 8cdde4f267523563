"""Driver of `spi`; see `madns_runtime.hardware.kinds.spi`."""

from __future__ import annotations

import errno

import spidev

from madns_runtime.errors import MachineError
from madns_runtime.hardware.kinds.spi import SpiParameters
from madns_runtime.hardware.registers import (
    RegisterBus,
    RegisterDevice,
)


class SpiDevice(RegisterDevice):
    """Registers behind spidev."""

    def open_bus(self) -> RegisterBus:
        """
        Open the bus.

        Raises:
            MachineError: There is no such bus, or it may not be opened.
        """
        return SpiBus(self.parameters)


class SpiBus:
    """
    One device of a bus.

    Args:
        parameters: Where it is, and how it is spoken to.

    Raises:
        MachineError: There is no such bus, or it may not be opened.
    """

    def __init__(self, parameters: SpiParameters) -> None:
        self._parameters = p = parameters
        self._where = f"/dev/spidev{p.bus}.{p.chip_select}"
        self._bus = spidev.SpiDev()
        try:
            self._bus.open(p.bus, p.chip_select)
        except OSError as error:
            cure = {
                errno.ENOENT: "there is no such bus; is dtparam=spi=on in the boot configuration?",
                errno.EACCES: "permission denied; add the user to the group spi",
            }.get(error.errno or 0, str(error))
            raise MachineError(f"{self._where}: {cure}") from None
        try:
            self._bus.mode = p.mode
            self._bus.max_speed_hz = p.speed_hz
        except (OSError, TypeError) as error:
            self._bus.close()
            raise MachineError(
                f"{self._where}: does not take mode {p.mode} at {p.speed_hz} Hz: {error}"
            ) from None

    def read(self, address: int, count: int) -> bytes:
        """Return the bytes of registers from *address* on."""
        p = self._parameters
        first = address | p.read_bits | (p.increment_bits if count > 1 else 0)
        return bytes(self._transfer([first & 0xFF, *([0] * count)])[1:])

    def write(self, address: int, data: bytes) -> None:
        """Write registers from *address* on."""
        first = address | (self._parameters.increment_bits if len(data) > 1 else 0)
        self._transfer([first & 0xFF, *data])

    def close(self) -> None:
        """Close the bus."""
        self._bus.close()

    def _transfer(self, data: list[int]) -> list[int]:
        try:
            return list(self._bus.xfer2(data))
        except OSError as error:
            raise MachineError(
                f"{self._where}: does not answer: {error.strerror or error}"
            ) from None
