"""A machine's reboot: what to know before it, and the order itself."""

from __future__ import annotations

import os
import shutil
import subprocess

from cosmos_cli.onboard.processes import processes
from cosmos_cli.onboard.request_loop import (
    HelperRefusal,
    PlainValue,
    VerbRequest,
    last_words,
    read_boot_id,
    verb,
)
from cosmos_cli.onboard.scratch import scratch_file

COMMANDS = (("reboot",), ("systemctl", "reboot"), ("shutdown", "-r", "now"))
TOOL_FOLDERS = "/usr/sbin:/sbin:/usr/bin:/bin"
ORDER_TIMEOUT_S = 5.0
"""A reboot that was begun may answer or not; one that is refused says so sooner."""


@verb("boot")
def boot(request: VerbRequest) -> dict[str, PlainValue]:
    """Tell which boot this is ("boot_id"), what lives of runs in the register "state", and whether "root" is there."""
    return {
        "boot_id": read_boot_id(),
        "living": processes(request),
        "has_root": os.path.isdir(os.path.expanduser(request.arguments["root"])),
    }


@verb("reboot")
def reboot(request: VerbRequest) -> None:
    """Begin a reboot in good order; needs root."""
    path = f"{os.environ.get('PATH', '')}:{TOOL_FOLDERS}"
    command = next((words for words in COMMANDS if shutil.which(words[0], path=path)), None)
    if command is None:
        raise HelperRefusal("unsupported", "no reboot, systemctl or shutdown there")
    with scratch_file() as output:
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
            raise HelperRefusal("step", f"{' '.join(command)}: exit status {status}: {said}")
