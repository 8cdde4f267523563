"""Driver of `i2c`; see `madns_runtime.hardware.kinds.i2c`."""

from __future__ import annotations

import errno

import smbus2

from madns_runtime.errors import MachineError
from madns_runtime.hardware.kinds.i2c import BLOCK_BYTES
from madns_runtime.hardware.registers import (
    RegisterBus,
    RegisterDevice,
)


class I2cDevice(RegisterDevice):
    """Registers behind smbus2."""

    def open_bus(self) -> RegisterBus:
        """
        Open the bus.

        Raises:
            MachineError: There is no such bus, or it may not be opened.
        """
        return I2cBus(self.parameters.bus, self.parameters.address)


class I2cBus:
    """
    One device of a bus.

    Args:
        bus: Number of the bus.
        address: Of the device.

    Raises:
        MachineError: There is no such bus, or it may not be opened.
    """

    def __init__(self, bus: int, address: int) -> None:
        self._where = f"/dev/i2c-{bus}, address 0x{address:02x}"
        self._address = address
        try:
            self._bus = smbus2.SMBus(bus)
        except OSError as error:
            cure = {
                errno.ENOENT: "there is no such bus; is dtparam=i2c_arm=on in the boot configuration?",
                errno.EACCES: "permission denied; add the user to the group i2c",
            }.get(error.errno or 0, str(error))
            raise MachineError(f"/dev/i2c-{bus}: {cure}") from None

    def read(self, address: int, count: int) -> bytes:
        """Return the bytes of registers from *address* on."""
        data = b""
        try:
            while len(data) < count:
                wanted = min(BLOCK_BYTES, count - len(data))
                block = self._bus.read_i2c_block_data(self._address, address + len(data), wanted)
                if len(block) != wanted:
                    raise MachineError(f"{self._where}: expected {wanted} bytes, got {len(block)}")
                data += bytes(block)
        except OSError as error:
            raise MachineError(f"{self._where}: {_cure(error)}") from None
        return data

    def write(self, address: int, data: bytes) -> None:
        """Write registers from *address* on."""
        try:
            for start in range(0, len(data), BLOCK_BYTES):
                block = list(data[start : start + BLOCK_BYTES])
                self._bus.write_i2c_block_data(self._address, address + start, block)
        except OSError as error:
            raise MachineError(f"{self._where}: {_cure(error)}") from None

    def close(self) -> None:
        """Close the bus."""
        self._bus.close()


def _cure(error: OSError) -> str:
    """Return what to tell of a transfer that failed, and what to do."""
    if error.errno in (errno.EREMOTEIO, errno.ENXIO, errno.ENODEV):  # by the bus's driver
        return (
            "does not answer; see what is on the bus with `i2cdetect -y BUS`, and look at its wires"
        )
    if error.errno == errno.EBUSY:
        return "a driver of the kernel has this address"
    if error.errno == errno.ETIMEDOUT:
        return (
            "times out: nothing answers there, as bridges tell it, or a chip holds the bus; see what is on the bus with"
            " `i2cdetect -y BUS`, else take its power away and give it again"
        )
    return f"does not answer: {error.strerror or error}"
