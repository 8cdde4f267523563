"""Firmware built by the distribution's compiler, and whether this machine can build and emulate it."""

import shutil
import subprocess
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "scenarios" / "firmware" / "detumble"
TOOLS = {"qemu-system-arm": "qemu-system-arm", "arm-none-eabi-gcc": "gcc-arm-none-eabi"}
MISSING = [package for program, package in TOOLS.items() if shutil.which(program) is None]

needs_emulator = pytest.mark.skipif(
    bool(MISSING), reason=f"not installed here: {', '.join(MISSING)}; .ci/tools installs it"
)


def build_firmware(folder: Path, name: str = "detumble", *main: Path) -> Path:
    """Build the firmware, or one with another main program, of some sources, on the same board; return its image."""
    command = ["make", "--silent", f"--makefile={FOLDER / 'Makefile'}", f"OUT={folder}"]
    if main:
        command += [f"MAIN={' '.join(map(str, main))}", f"NAME={name}"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder / f"{name}.elf"
