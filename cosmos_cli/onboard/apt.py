"""
System packages of a machine, through apt.

Whatever was asked for, apt is never killed: a package manager that is stopped half-way leaves a machine
that needs a person. One whose operator is gone, or whose time is over, goes on to its end by itself.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import BinaryIO

from cosmos_cli.onboard.apt_words import (
    Trouble,
    changes_between,
    kept_back,
    planned_changes,
    trouble_of,
)
from cosmos_cli.onboard.dpkg import DPKG_QUERY, names_asked, version_of, versions_of
from cosmos_cli.onboard.request_loop import AnswerPiece, HelperRefusal, VerbRequest, verb
from cosmos_cli.onboard.scratch import scratch_file, scratch_folder
from cosmos_cli.onboard.system import SIGN_OF_LIFE_S, read_end, start, tool_path, wait

QUERY_TIMEOUT_S = 30.0
LOCK_WAIT_S = 60.0
TIMEOUT_S = 1800.0
OUTPUT_BYTES_MAX = 1024 * 1024
REBOOT_WANTED = "/run/reboot-required"
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

RENEWED_FOR = ("unknown", "stale", "no_way")
"""Troubles that newer lists may mend."""

BESIDE = """
Dir::State::lists "{folder}/lists";
Dir::Cache::pkgcache "{folder}/pkgcache.bin";
Dir::Cache::srcpkgcache "{folder}/srcpkgcache.bin";
APT::Sandbox::User "";
#clear APT::Update::Pre-Invoke;
#clear APT::Update::Post-Invoke;
#clear APT::Update::Post-Invoke-Success;
"""
"""Lists beside the system's; nobody but the user who asks may write there."""

Running = Generator[AnswerPiece, None, tuple[int, str]]


@dataclass(frozen=True, slots=True, kw_only=True)
class AptDeadlines:
    """Until when apt may work, and until when it is asked again while another program holds its lock."""

    end_s: float
    lock_s: float


@verb("packages")
def packages(request: VerbRequest) -> Iterator[AnswerPiece]:
    """
    Change packages; needs root unless it is only a check.

    Args:
        request: "action" is install, remove or upgrade; "names" may be empty for upgrade, which then
            means all; with "is_check" nothing is changed. "timeout_s" and "lock_s" bound the work and
            the wait for others.

    Yields:
        Signs of life ("doing": its last line); the last piece holds "changes" and "notes".
    """
    asked = request.arguments
    names, action = list(asked.get("names") or ()), str(asked["action"])
    wanted = _still_wanted(action, names)
    if names and not wanted:
        yield AnswerPiece(value={"changes": [], "notes": []})
        return
    words = (*WORDS["upgrade_named" if action == "upgrade" and wanted else action], *wanted)
    now_s = time.monotonic()
    deadlines = AptDeadlines(
        end_s=now_s + float(asked.get("timeout_s") or TIMEOUT_S),
        lock_s=now_s + float(asked.get("lock_s") or LOCK_WAIT_S),
    )
    is_upgrade = action == "upgrade"  # what is new, only the newest lists tell
    if asked.get("is_check"):
        yield from _foresee(words, deadlines, is_updated=is_upgrade)
        return
    before = snapshot()
    notes: list[str] = []
    if is_upgrade:
        yield from _update(deadlines)
    output = yield from _persist(words, deadlines, notes, is_updated=is_upgrade)
    held = kept_back(output)
    if held:
        notes.append(f"kept back: {' '.join(held)}")
    if os.path.exists(REBOOT_WANTED):
        notes.append("wants a reboot: `cosmos reboot`")
    yield AnswerPiece(value={"changes": changes_between(before, snapshot()), "notes": notes})


def installed(names: Sequence[str]) -> dict[str, str | None]:
    """
    Return the installed version of each package; None for one that is not there.

    Raises:
        Refusal: UNSUPPORTED, the machine has no dpkg.
    """
    packages = {name: name.partition("=")[0] for name in names}
    found = _ask_dpkg(names_asked([*packages.values()])) if names else {}
    return {name: version_of(package, found) for name, package in packages.items()}


def snapshot() -> dict[str, str]:
    """
    Return the version of every installed package.

    Raises:
        Refusal: UNSUPPORTED, the machine has no dpkg.
    """
    return {name: version for name, version in _ask_dpkg([]).items() if ":" not in name}


def _ask_dpkg(names: Sequence[str]) -> dict[str, str]:
    """Return versions by name, and by name:architecture as well; of all packages without a name."""
    try:
        done = subprocess.run(
            [*DPKG_QUERY, *names],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            env={**os.environ, "PATH": tool_path(), **SILENT},
            timeout=QUERY_TIMEOUT_S,
            check=False,
        )
    except FileNotFoundError:
        raise _unsupported("dpkg-query") from None
    except subprocess.TimeoutExpired:
        raise HelperRefusal("timeout", f"dpkg-query: no answer in {QUERY_TIMEOUT_S:g} s") from None
    return versions_of(done.stdout.decode(errors="replace"))


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
        raise HelperRefusal("step", text, "`cosmos packages install` installs what is not there")
    return list(names)


def _foresee(
    words: Sequence[str], deadlines: AptDeadlines, *, is_updated: bool
) -> Iterator[AnswerPiece]:
    """
    Yield what apt-get would change; where it would renew its lists first, that is done beside them.

    Nothing here changes, and nobody needs to be root: the renewed lists are in a folder that goes.
    """
    with scratch_folder() as folder:
        beside = _beside(folder)
        is_renewed = is_updated
        if is_updated:
            yield from _update(deadlines, options=beside)
        while True:
            options = ("--simulate", *(beside if is_renewed else ()))
            status, output = yield from _apt((*options, *words), deadlines)
            if status == 0:
                break
            trouble = trouble_of(output)
            if is_renewed or trouble.word not in RENEWED_FOR:
                raise trouble
            yield from _update(deadlines, trouble, options=beside)
            is_renewed = True
    held = kept_back(output)
    notes = [f"kept back: {' '.join(held)}"] if held else []
    yield AnswerPiece(value={"changes": planned_changes(output), "notes": notes})


def _beside(folder: str) -> tuple[str, ...]:
    """Return the options by which apt keeps its lists in a folder of our own, and does nothing after renewing them."""
    os.makedirs(f"{folder}/lists/partial")
    path = f"{folder}/apt.conf"
    with open(path, "w") as file:
        file.write(BESIDE.format(folder=folder))
    return (f"--config-file={path}",)


def _persist(
    words: Sequence[str], deadlines: AptDeadlines, notes: list[str], *, is_updated: bool
) -> Generator[AnswerPiece, None, str]:
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
        elif trouble.word in RENEWED_FOR and "update" not in done:
            done.add("update")
            yield from _update(deadlines, trouble)
        else:
            raise trouble


def _update(
    deadlines: AptDeadlines, before: Trouble | None = None, *, options: Sequence[str] = ()
) -> Iterator[AnswerPiece]:
    """
    Renew the lists; *options* say where others than the system's are.

    Raises:
        Refusal: They cannot be renewed; *before* is what made it necessary.
    """
    status, output = yield from _apt((*options, "update"), deadlines)
    if status:
        trouble = trouble_of(output)
        if trouble.word == "interrupted":
            return  # what needs the lists will say so, and is mended then
        if before is not None and before.word == "unknown":
            text = f"{before.text}, and they cannot be renewed: {trouble.text}"
            raise HelperRefusal(trouble.kind, text, trouble.advice)
        raise trouble


def _configure(deadlines: AptDeadlines) -> Iterator[AnswerPiece]:
    status, output = yield from _unlocked(["dpkg", "--configure", "-a"], deadlines)
    if status:
        trouble = trouble_of(output)
        text = f"an earlier installation was interrupted and cannot be finished: {trouble.text}"
        raise HelperRefusal(trouble.kind, text, trouble.advice)


def _apt(words: Sequence[str], deadlines: AptDeadlines) -> Running:
    return (yield from _unlocked([_apt_get(), *OPTIONS, *words], deadlines))


def _unlocked(command: Sequence[str], deadlines: AptDeadlines) -> Running:
    """Run a command, again and again while another program holds the package manager's lock."""
    while True:
        status, output = yield from _running(command, deadlines)
        is_locked = status != 0 and trouble_of(output).word == "locked"
        if not is_locked or time.monotonic() > deadlines.lock_s:
            return status, output
        yield AnswerPiece(
            value={"doing": "waiting for another program that works on packages there"}
        )
        time.sleep(SIGN_OF_LIFE_S)


def _running(command: Sequence[str], deadlines: AptDeadlines) -> Running:
    """Run a command to its end, with a sign of life per second."""
    with scratch_file() as output:
        process = start(command, output, **SILENT)
        while (status := wait(process, SIGN_OF_LIFE_S)) is None:
            said = _said(output)
            if time.monotonic() > deadlines.end_s:
                raise HelperRefusal(
                    "timeout",
                    f"{os.path.basename(command[0])} still works there: {_last_line(said)}",
                    "it is left to finish; repeat the command later, or give it a longer --timeout",
                )
            yield AnswerPiece(value={"doing": _last_line(said)})
        return status, _said(output)


def _said(output: BinaryIO) -> str:
    return read_end(output, OUTPUT_BYTES_MAX).decode(errors="replace")


def _last_line(text: str) -> str:
    lines = text.strip().splitlines()
    return lines[-1].strip()[:200] if lines else ""


def _apt_get() -> str:
    found = shutil.which("apt-get", path=tool_path())
    if found is None:
        raise _unsupported("apt-get")
    return found


def _unsupported(tool: str) -> HelperRefusal:
    return HelperRefusal(
        "unsupported",
        f"no {tool}: this machine does not get its packages through apt",
        "install what is needed there by hand, or through `command` steps of cosmos_provision",
    )
