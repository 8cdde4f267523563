"""One boot of a guest: its console, and what its tests came to."""

from __future__ import annotations

import functools
import json
import os
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.tower import kernel

from .system import System

BOOT_S_MAX = 1200
"""An idle computer of two cores takes a third of it."""
MEMORY_MIB = 1024
CONSOLE_LINES_SHOWN = 40
KERNEL_LINE = "console=ttyS0 loglevel=4 panic=-1 mitigations=off nokaslr"


@dataclass(frozen=True, slots=True)
class GuestResult:
    """What a guest told before it was switched off, or was given up."""

    tests: tuple[dict[str, Any], ...]
    """One mapping per test of `inside/`: name, outcome, text, duration_s."""
    console: str
    is_complete: bool
    """Whether it switched itself off."""

    @property
    def last_lines(self) -> str:
        return "\n".join(self.console.splitlines()[-CONSOLE_LINES_SHOWN:])


def boot(system: System, initramfs: Path, code: Path, folder: Path) -> GuestResult:
    """
    Boot a guest, and return what its tests came to.

    Args:
        system: Its system.
        initramfs: What it boots from.
        code: The disk with the project; nothing is written to either disk.
        folder: Where console and results are written.
    """
    console, results = folder / "console.txt", folder / "results.jsonl"
    with open(folder / "qemu.txt", "w") as log:
        process = subprocess.Popen(
            _command(system, initramfs, code, folder),
            stdin=subprocess.DEVNULL, stdout=log, stderr=log, cwd=folder,
            preexec_fn=functools.partial(kernel.die_with_parent, os.getpid()),
        )  # fmt: skip
        try:
            is_complete = process.wait(BOOT_S_MAX) == 0
        except subprocess.TimeoutExpired:
            is_complete = False
        finally:
            process.kill()
            process.wait()
    said = (folder / "qemu.txt").read_text() + console.read_text(errors="replace")
    lines = results.read_text(errors="replace").splitlines() if results.exists() else []
    tests = tuple(json.loads(line) for line in lines if line.endswith("}"))
    return GuestResult(tests=tests, console=said, is_complete=is_complete)


def _command(system: System, initramfs: Path, code: Path, folder: Path) -> list[str]:
    """
    Return QEMU's command: two processors by software emulation, no network.

    A cable goes from the guest's ttyS1 to its USB adapter, ttyUSB0, and another from ttyS2 to ttyS3.
    """
    command = [
        *("qemu-system-x86_64", "-machine", "pc", "-cpu", "max", "-smp", "2"),
        *("-accel", "tcg,thread=multi", "-m", str(MEMORY_MIB)),
        *("-nodefaults", "-no-user-config", "-no-reboot", "-display", "none"),
        *("-kernel", str(system.kernel), "-initrd", str(initramfs), "-append", KERNEL_LINE),
    ]
    for number, disk in enumerate((system.disk, code)):
        command += ["-drive", f"if=none,id=disk{number},format=raw,snapshot=on,file={disk}"]
        command += ["-device", f"virtio-blk-pci,drive=disk{number}"]
    command += ["-serial", f"file:{folder / 'console.txt'}"]
    for name in ("usb", "line"):
        shared = (
            f"socket,path={name}"  # beside the console: a socket's path has 107 characters at most
        )
        command += ["-chardev", f"{shared},id={name},server=on,wait=off"]
        command += ["-chardev", f"{shared},id={name}_other"]
    command += ["-serial", "chardev:usb_other", "-serial", "chardev:line"]
    command += ["-serial", "chardev:line_other"]
    command += ["-device", "qemu-xhci", "-device", "usb-serial,chardev=usb"]
    command += ["-device", "virtio-serial-pci"]
    command += ["-chardev", f"file,id=results,path={folder / 'results.jsonl'}"]
    command += ["-device", "virtserialport,chardev=results,name=results"]
    return [*command, "-device", "virtio-rng-pci"]
