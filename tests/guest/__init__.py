"""A real Linux guest under QEMU's emulation, for drivers of devices that this computer's kernel has not."""
