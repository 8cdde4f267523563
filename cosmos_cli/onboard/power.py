"""A machine's reboot: what to know before it, and the order itself."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterable, Mapping

from cosmos_cli.onboard.files import user_name
from cosmos_cli.onboard.processes import MARK, is_within, process_numbers, processes
from cosmos_cli.onboard.request_loop import (
    HelperRefusal,
    PlainValue,
    VerbRequest,
    last_words,
    read_boot_id,
    verb,
)
from cosmos_cli.onboard.scratch import scratch_file
from madns_runtime.processes import NOT_THERE, read_environment

COMMANDS = (("reboot",), ("systemctl", "reboot"), ("shutdown", "-r", "now"))
TOOL_FOLDERS = "/usr/sbin:/sbin:/usr/bin:/bin"
ORDER_TIMEOUT_S = 5.0
"""A reboot that was begun may answer or not; one that is refused says so sooner."""
MODULES = (b"madns_runtime.agent", b"madns_runtime.host")
"""Programs of a run, as the command line names them that everybody may read."""
COMMAND_BYTES_MAX = 65_536
OTHERS_MAX = 100


@verb("boot")
def boot(request: VerbRequest) -> dict[str, PlainValue]:
    """
    Tell which boot this is ("boot_id"), what lives of runs in the register "state", and whether "root" is there.

    "others" says in words what lives besides: runs of other folders of COSMoS, and those of other users.
    """
    living = processes(request)
    return {
        "boot_id": read_boot_id(),
        "living": living,
        "others": runs_besides(living),
        "has_root": os.path.isdir(os.path.expanduser(request.arguments["root"])),
    }


def runs_besides(living: Iterable[Mapping[str, PlainValue]]) -> list[str]:
    """
    Return in words the runs that live here and are not among *living*, at most OTHERS_MAX of them.

    A process tells its run by its environment, which its user and root may read; of another user's only that
    it belongs to some run can be told.
    """
    known = [os.path.realpath(str(entry["run_directory"])) for entry in living]
    found = set()
    for pid in process_numbers():
        try:
            directory = _run_directory(pid) if pid != os.getpid() else ""
        except PermissionError:
            found |= _run_of_another(pid)
            continue
        except NOT_THERE:  # it has just ended
            continue
        if directory and not any(is_within(each, os.path.realpath(directory)) for each in known):
            parent, _, run = directory.rstrip("/").rpartition("/")
            found.add(f"{run} in {parent or '/'}")
    return sorted(found)[:OTHERS_MAX]


def _run_directory(pid: int) -> str:
    """Return the directory of the run that a process belongs to; "" for none."""
    mark = f"{MARK}=".encode()
    found = next((each for each in read_environment(pid) if each.startswith(mark)), mark)
    return found[len(mark) :].decode(errors="replace")


def _run_of_another(pid: int) -> set[str]:
    """Return a run of another user in words, if a process is a program of one."""
    try:
        with open(f"/proc/{pid}/cmdline", "rb") as file:
            command = file.read(COMMAND_BYTES_MAX)
        owner = os.stat(f"/proc/{pid}").st_uid
    except NOT_THERE:
        return set()
    is_of_run = any(b"\0-m\0%b\0" % name in command for name in MODULES)
    return {f"a run of {user_name(owner)}"} if is_of_run else set()


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
