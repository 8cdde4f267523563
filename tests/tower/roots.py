"""
Debian systems of foreign architectures, built once and kept.

`mmdebstrap` builds them from this computer's own package sources; programs in them run by qemu-user. The
emulators are registered with the kernel by whoever needs them, in a private mount of binfmt_misc: since
Linux 6.7 a registration ends with its last mount.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterable
from pathlib import Path

from . import kernel
from .console import say
from .specification import debian_architecture

SUITE = "bookworm"
PACKAGES = ("python3", "openssh-server", "sudo")
"""No python3-venv: nothing here needs pip, and its certificates take minutes to unpack under emulation."""
PACKAGES_MORE = {"armhf": ("python3-numpy", "python3-msgpack", "python3-psutil")}
"""There are no wheels of these for 32-bit ARM: its runtime lives on the distribution's."""
DPKG_OPTIONS = (
    "force-unsafe-io",
    "path-exclude=/usr/share/man/*",
    "path-exclude=/usr/share/locale/*",
)
ALONE = ("unshare", "--pid", "--fork", "--kill-child", "--mount-proc", "--")
"""What it starts ends with it."""
EMULATORS = {"arm64": "aarch64", "armhf": "arm"}
REGISTRY = Path("/proc/sys/fs/binfmt_misc")
BUILD_PATIENCE_S = 1800
TOOLS = ("mmdebstrap", "arch-test")


class RootError(Exception):
    """A foreign system cannot be had here."""


def cache_folder() -> Path:
    """Return where built systems are kept: COSMOS_TOWER_CACHE, or ~/.cache/cosmos-tower."""
    chosen = os.environ.get("COSMOS_TOWER_CACHE")
    return Path(chosen) if chosen else Path.home() / ".cache" / "cosmos-tower"


def why_unavailable(arch: str) -> str | None:
    """Return why boards of this architecture cannot be had here, or None."""
    if (cache_folder() / arch).is_dir():
        missing = []
    else:
        missing = [tool for tool in TOOLS if shutil.which(tool) is None]
    if arch in EMULATORS and not _emulator_file(arch).is_file():
        missing.append(f"qemu-user-static ({_emulator_file(arch)})")
    return f"{arch} boards need {', '.join(missing)}: apt-get install" if missing else None


def ensure_root(arch: str) -> Path:
    """
    Return the folder of a system, building it first if it is not there.

    Two callers at once build it once: the second waits.

    Raises:
        RootError: Tools are missing, or the build failed.
    """
    cache = cache_folder()
    if (cache / arch).is_dir():
        return cache / arch
    reason = why_unavailable(arch)
    if reason:
        raise RootError(reason)
    cache.mkdir(parents=True, exist_ok=True)
    with open(cache / f"{arch}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (cache / arch).is_dir():
            _build(arch, cache)
    return cache / arch


def register_emulators(architectures: Iterable[str]) -> None:
    """
    Let the kernel run these architectures' programs, as long as this mount namespace lives.

    The caller has a private mount namespace. Flag C is added to Debian's own lines: without it
    set-user-ID programs such as sudo stay powerless.
    """
    foreign = sorted(set(architectures) & set(EMULATORS) - {debian_architecture()})
    if not foreign:
        return
    kernel.mount("binfmt_misc", REGISTRY, "binfmt_misc")
    for arch in foreign:
        name = f"cosmos-{EMULATORS[arch]}"
        line = _emulator_file(arch).read_text().strip()
        _, _, rest = line[1:].split(":", 2)
        pattern, _, _ = rest.rpartition(":")
        with contextlib.suppress(FileExistsError):  # another tower has done it
            descriptor = os.open(REGISTRY / "register", os.O_WRONLY)
            try:
                os.write(descriptor, f":{name}:M:{pattern}:POCF".encode())
            finally:
                os.close(descriptor)


def _emulator_file(arch: str) -> Path:
    return Path(f"/usr/lib/binfmt.d/qemu-{EMULATORS[arch]}.conf")


def _build(arch: str, cache: Path) -> None:
    """Build a system under a temporary name; only a whole one gets its own. The caller holds the lock."""
    for path in cache.glob(f"{arch}.part-*"):  # of a builder that was killed
        shutil.rmtree(path, ignore_errors=True)
    say(f"tower: building a Debian {SUITE} for {arch}, once; some minutes")
    folder = Path(tempfile.mkdtemp(prefix=f"{arch}.part-", dir=cache))
    log = cache / f"{arch}.log"
    names = ",".join((*PACKAGES, *PACKAGES_MORE.get(arch, ())))
    command = [*ALONE, "mmdebstrap", f"--arch={arch}", "--variant=minbase", f"--include={names}"]
    command += [f"--dpkgopt={option}" for option in DPKG_OPTIONS]
    command += [SUITE, str(folder / "root"), *debian_sources()]
    try:
        with open(log, "w") as out:
            run = subprocess.run(
                command,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=out,
                timeout=BUILD_PATIENCE_S,
                check=False,
                preexec_fn=functools.partial(_enter_workshop, os.getpid(), arch),
            )
        if run.returncode:
            tail = "\n".join(log.read_text().splitlines()[-10:])
            raise RootError(f"mmdebstrap for {arch} failed; {log}:\n{tail}")
        shutil.rmtree(folder / "root/var/cache/apt/archives", ignore_errors=True)
        (folder / "root").rename(cache / arch)
    except subprocess.TimeoutExpired as error:
        raise RootError(
            f"mmdebstrap for {arch}: not done in {BUILD_PATIENCE_S} s; {log}"
        ) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _enter_workshop(builder: int, arch: str) -> None:
    """Let the process that becomes mmdebstrap run foreign programs, and end with its builder."""
    kernel.die_with_parent(builder)
    kernel.unshare(kernel.CLONE_NEWNS)
    kernel.make_mounts_private()
    register_emulators([arch])


def debian_sources() -> list[str]:
    """Return this computer's own sources of the suite, as sources.list lines."""
    form = "deb $(REPO_URI) $(CODENAME) $(COMPONENT)"
    command = ["apt-get", "indextargets", "--format", form, "Created-By: Packages"]
    run = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    lines = [line for line in run.stdout.splitlines() if line.split()[2:] == [SUITE, "main"]]
    return sorted(set(lines))
