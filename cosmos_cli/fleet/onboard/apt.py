"""
System packages of a machine, through apt.

Whatever was asked for, apt is never killed: a package manager that is stopped half-way leaves a machine
that needs a person. One whose operator is gone, or whose time is over, goes on to its end by itself.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cosmos_cli.fleet.onboard.apt_words import (
    Trouble,
    changes_between,
    kept_back,
    planned_changes,
    trouble_of,
)
from cosmos_cli.fleet.onboard.core import Part, Refusal, Request, verb

SIGN_OF_LIFE_S = 1.0
QUERY_TIMEOUT_S = 30.0
LOCK_WAIT_S = 60.0
TIMEOUT_S = 1800.0
OUTPUT_BYTES_MAX = 1024 * 1024
REBOOT_WANTED = "/run/reboot-required"
TOOL_FOLDERS = ("/usr/local/sbin", "/usr/sbin", "/sbin")
"""dpkg needs what lies there; not on everybody's path in sessions that are not interactive."""
SILENT = {
    "DEBIAN_FRONTEND": "noninteractive",
    "APT_LISTCHANGES_FRONTEND": "none",
    "NEEDRESTART_MODE": "l",
    "LC_ALL": "C",
}
OPTIONS = (
    "--yes",
    "--quiet",
    "-oDpkg::Use-Pty=0",
    "-oDpkg::Options::=--force-confdef",
    "-oDpkg::Options::=--force-confold",
    "-oAPT::Update::Error-Mode=any",
    "-oAcquire::Retries=1",
    "-oAcquire::http::Timeout=15",
    "-oAcquire::https::Timeout=15",
)
"""Ask nothing, keep files that somebody edited, and take a source that cannot be read for a failure."""
WORDS: Mapping[str, tuple[str, ...]] = {
    "install": ("install",),
    "remove": ("remove",),
    "upgrade": ("upgrade", "--with-new-pkgs"),
    "upgrade_named": ("install", "--only-upgrade"),
}

Running = Generator[Part, None, tuple[int, str]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Deadlines:
    """Until when apt may work, and until when it is asked again while another program holds its lock."""

    end_s: float
    lock_s: float


@verb("packages")
def packages(request: Request) -> Iterator[Part]:
    """
    Change packages; needs root unless it is only a check.

    Args:
        request: "action" is install, remove or upgrade; "names" may be empty for upgrade, which then
            means all; with "is_check" nothing is changed. "timeout_s" and "lock_s" bound the work and
            the wait for others.

    Yields:
        Signs of life ("doing": its last line); the last part holds "changes" and "notes".
    """
    asked = request.arguments
    names, action = list(asked.get("names") or ()), str(asked["action"])
    wanted = _still_wanted(action, names)
    if names and not wanted:
        yield Part(value={"changes": [], "notes": []})
        return
    words = (*WORDS["upgrade_named" if action == "upgrade" and wanted else action], *wanted)
    if asked.get("is_check"):
        yield Part(value=_simulate(words))
        return
    now_s = time.monotonic()
    deadlines = Deadlines(
        end_s=now_s + float(asked.get("timeout_s") or TIMEOUT_S),
        lock_s=now_s + float(asked.get("lock_s") or LOCK_WAIT_S),
    )
    before = snapshot()
    notes: list[str] = []
    is_upgrade = action == "upgrade"  # what is new, only the newest lists tell
    if is_upgrade:
        yield from _update(deadlines)
    output = yield from _persist(words, deadlines, notes, is_updated=is_upgrade)
    held = kept_back(output)
    if held:
        notes.append(f"kept back: {' '.join(held)}")
    if os.path.exists(REBOOT_WANTED):
        notes.append("wants a reboot: `cosmos reboot`")
    yield Part(value={"changes": changes_between(before, snapshot()), "notes": notes})


def installed(names: Sequence[str]) -> dict[str, str | None]:
    """
    Return the installed version of each package; None for one that is not there.

    Raises:
        Refusal: UNSUPPORTED, the machine has no dpkg.
    """
    found = _ask_dpkg([name.partition("=")[0] for name in names]) if names else {}
    return {name: found.get(name.partition("=")[0]) for name in names}


def snapshot() -> dict[str, str]:
    """
    Return the version of every installed package.

    Raises:
        Refusal: UNSUPPORTED, the machine has no dpkg.
    """
    return {name: version for name, version in _ask_dpkg([]).items() if ":" not in name}


def _ask_dpkg(names: Sequence[str]) -> dict[str, str]:
    """Return versions by name, and by name:architecture as well; of all packages without a name."""
    layout = "${Package} ${Architecture} ${db:Status-Status} ${Version}\\n"
    try:
        done = subprocess.run(
            ["dpkg-query", "-W", f"-f={layout}", *names],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            env=_environment(),
            timeout=QUERY_TIMEOUT_S,
            check=False,
        )
    except FileNotFoundError:
        raise _unsupported("dpkg-query") from None
    except subprocess.TimeoutExpired:
        raise Refusal("timeout", f"dpkg-query: no answer in {QUERY_TIMEOUT_S:g} s") from None
    found: dict[str, str] = {}
    for line in done.stdout.decode(errors="replace").splitlines():
        words = line.split(" ")
        if len(words) == 4 and words[2] == "installed":
            found.setdefault(words[0], words[3])
            found[f"{words[0]}:{words[1]}"] = words[3]
    return found


def _still_wanted(action: str, names: Sequence[str]) -> list[str]:
    """Return of the named packages those that apt must be asked about; without a question to the network."""
    found = installed(names)
    if action == "install":
        return [
            name
            for name in names
            if found[name] is None or ("=" in name and found[name] != name.partition("=")[2])
        ]
    if action == "remove":
        return [name for name in names if found[name] is not None]
    missing = [name for name in names if found[name] is None]
    if missing:
        text = f"not installed there: {', '.join(missing)}"
        raise Refusal("step", text, "`cosmos packages install` installs what is not there")
    return list(names)


def _simulate(words: Sequence[str]) -> dict[str, Any]:
    done = subprocess.run(
        [_apt_get(), *OPTIONS, "--simulate", *words],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=_environment(),
        timeout=QUERY_TIMEOUT_S,
        check=False,
    )
    output = done.stdout.decode(errors="replace")
    if done.returncode:
        trouble = trouble_of(output)
        if trouble.word == "unknown":
            more = f"{trouble.text}, as far as its lists tell; without --check they are renewed"
            raise Refusal(trouble.kind, more, trouble.advice)
        raise trouble.refusal()
    held = kept_back(output)
    notes = [f"kept back: {' '.join(held)}"] if held else []
    return {"changes": planned_changes(output), "notes": notes}


def _persist(
    words: Sequence[str], deadlines: Deadlines, notes: list[str], *, is_updated: bool
) -> Generator[Part, None, str]:
    """Run apt-get; finish what was interrupted, and renew the lists, once each, where that may help."""
    done = {"update"} if is_updated else set()
    while True:
        status, output = yield from _apt(words, deadlines)
        if status == 0:
            return output
        trouble = trouble_of(output)
        if trouble.word == "interrupted" and "configure" not in done:
            done.add("configure")
            yield from _configure(deadlines)
            notes.append("finished an interrupted installation: dpkg --configure -a")
        elif trouble.word in ("unknown", "stale", "no_way") and "update" not in done:
            done.add("update")
            yield from _update(deadlines, trouble)
        else:
            raise trouble.refusal()


def _update(deadlines: Deadlines, before: Trouble | None = None) -> Iterator[Part]:
    """
    Renew the lists.

    Raises:
        Refusal: They cannot be renewed; *before* is what made it necessary.
    """
    status, output = yield from _apt(("update",), deadlines)
    if status:
        trouble = trouble_of(output)
        if trouble.word == "interrupted":
            return  # what needs the lists will say so, and is mended then
        if before is not None and before.word == "unknown":
            text = f"{before.text}, and they cannot be renewed: {trouble.text}"
            raise Refusal(trouble.kind, text, trouble.advice)
        raise trouble.refusal()


def _configure(deadlines: Deadlines) -> Iterator[Part]:
    status, output = yield from _running(["dpkg", "--configure", "-a"], deadlines)
    if status:
        trouble = trouble_of(output)
        text = f"an earlier installation was interrupted and cannot be finished: {trouble.text}"
        raise Refusal(trouble.kind, text, trouble.advice)


def _apt(words: Sequence[str], deadlines: Deadlines) -> Running:
    """Run apt-get, again and again while another program holds its lock."""
    while True:
        status, output = yield from _running([_apt_get(), *OPTIONS, *words], deadlines)
        is_locked = status != 0 and trouble_of(output).word == "locked"
        if not is_locked or time.monotonic() > deadlines.lock_s:
            return status, output
        yield Part(value={"doing": "waiting for another program that works on packages there"})
        time.sleep(SIGN_OF_LIFE_S)


def _running(command: Sequence[str], deadlines: Deadlines) -> Running:
    """
    Run a command to its end, with a sign of life a second.

    What it says goes to a file: it must not depend on anybody who reads.
    """
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=_environment(),
            start_new_session=True,
        )
        while (status := _wait(process)) is None:
            said = _read_end(output)
            if time.monotonic() > deadlines.end_s:
                raise Refusal(
                    "timeout",
                    f"{os.path.basename(command[0])} still works there: {_last_line(said)}",
                    "it is left to finish; repeat the command later, or give it a longer --timeout",
                )
            yield Part(value={"doing": _last_line(said)})
        return status, _read_end(output)


def _wait(process: subprocess.Popen[bytes]) -> int | None:
    try:
        return process.wait(SIGN_OF_LIFE_S)
    except subprocess.TimeoutExpired:
        return None


def _read_end(output: Any) -> str:
    """Return the end of what was said; by position, for the writer shares the file's own."""
    size = os.fstat(output.fileno()).st_size
    data = os.pread(output.fileno(), OUTPUT_BYTES_MAX, max(0, size - OUTPUT_BYTES_MAX))
    return data.decode(errors="replace")


def _last_line(text: str) -> str:
    lines = text.strip().splitlines()
    return lines[-1].strip()[:200] if lines else ""


def _environment() -> dict[str, str]:
    paths = (*os.environ.get("PATH", "").split(":"), *TOOL_FOLDERS)
    return {**os.environ, "PATH": ":".join(dict.fromkeys(filter(None, paths))), **SILENT}


def _apt_get() -> str:
    found = shutil.which("apt-get", path=_environment()["PATH"])
    if found is None:
        raise _unsupported("apt-get")
    return found


def _unsupported(tool: str) -> Refusal:
    return Refusal(
        "unsupported",
        f"no {tool}: this machine does not get its packages through apt",
        "install what is needed there by hand, or through `command` steps of cosmos_provision",
    )
