"""A machine's reboot: what to know before it, and the order itself."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import tempfile
from typing import Any

from cosmos_cli.fleet.onboard.core import Refusal, Request, last_words, verb
from cosmos_cli.fleet.onboard.processes import processes

BOOT_ID = "/proc/sys/kernel/random/boot_id"
COMMANDS = (("reboot",), ("systemctl", "reboot"), ("shutdown", "-r", "now"))
TOOL_FOLDERS = "/usr/sbin:/sbin:/usr/bin:/bin"
ORDER_TIMEOUT_S = 5.0
"""A reboot that was begun may answer or not; one that is refused says so sooner."""


@verb("boot")
def boot(request: Request) -> dict[str, Any]:
    """Tell which boot this is ("boot_id"), what lives of runs in the register "state", and whether "root" is there."""
    return {
        "boot_id": read_boot_id(),
        "living": processes(request),
        "has_root": os.path.isdir(os.path.expanduser(request.arguments["root"])),
    }


def read_boot_id() -> str:
    """Return what names this boot; empty where the kernel does not say."""
    with contextlib.suppress(OSError), open(BOOT_ID) as file:
        return file.read().strip()
    return ""


@verb("reboot")
def reboot(request: Request) -> None:
    """Begin a reboot in good order; needs root."""
    path = f"{os.environ.get('PATH', '')}:{TOOL_FOLDERS}"
    command = next((words for words in COMMANDS if shutil.which(words[0], path=path)), None)
    if command is None:
        raise Refusal("unsupported", "no reboot, systemctl or shutdown there")
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env={**os.environ, "PATH": path},
            start_new_session=True,
        )
        try:
            status = process.wait(ORDER_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            return
        if status:
            said = last_words(os.pread(output.fileno(), 65_536, 0))
            raise Refusal("step", f"{' '.join(command)}: exit status {status}: {said}")
