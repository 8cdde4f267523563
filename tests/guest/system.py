"""
A Debian system with its kernel, for guests: built once and kept beside the tower's systems.

`mmdebstrap` builds it from this computer's own package sources. The kernel's package is unpacked, not installed: neither
its scripts nor an initramfs are wanted here.
"""

from __future__ import annotations

import fcntl
import functools
import hashlib
import os
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

from tests.tower import kernel
from tests.tower.console import say
from tests.tower.roots import ALONE, DPKG_OPTIONS, SUITE, cache_folder, debian_sources

PACKAGES = ("busybox-static", "iproute2", "kmod", "python3")
PYTHON = "3.11"
"""That of the suite."""
KERNEL = "linux-image-amd64"
"""Not the one for clouds: that has no devices."""
GET_KERNEL = f"""
set -e
export APT_CONFIG="$MMDEBSTRAP_APT_CONFIG"
mkdir "$1/kernel"
cd "$1/kernel"
apt-get download -qq "$(apt-cache depends {KERNEL} | sed -n 's/.*Depends: //p' | head -n 1)"
dpkg-deb --extract ./*.deb .
rm ./*.deb
chroot "$1" depmod --basedir /kernel "$(ls lib/modules)"
"""
TOOLS = {
    "mmdebstrap": "mmdebstrap",
    "mkfs.ext4": "e2fsprogs",
    "qemu-system-x86_64": "qemu-system-x86",
}
BUILD_S_MAX = 1200
SPARE_MIB = 64


class GuestError(Exception):
    """A guest cannot be had here."""


@dataclass(frozen=True, slots=True)
class System:
    """Where the parts of a built system lie."""

    folder: Path

    @property
    def disk(self) -> Path:
        """An ext4 file system: all but the kernel."""
        return self.folder / "system.img"

    @property
    def root(self) -> Path:
        """The same as a folder."""
        return self.folder / "root"

    @property
    def busybox(self) -> Path:
        return self.root / "usr/bin/busybox"

    @property
    def kernel(self) -> Path:
        return next((self.folder / "kernel/boot").glob("vmlinuz-*"))

    @property
    def modules(self) -> Path:
        """The kernel's modules, with `modules.dep`."""
        return next((self.folder / "kernel/lib/modules").iterdir())


def missing_tools() -> list[str]:
    """Return the packages that guests need and this computer lacks."""
    return [package for tool, package in TOOLS.items() if shutil.which(tool) is None]


def ensure_system() -> System:
    """
    Return a system, building it first if it is not there; of two callers at once the second waits.

    Raises:
        GuestError: The build failed.
    """
    recipe = hashlib.sha256(f"{PACKAGES} {GET_KERNEL} {SUITE}".encode()).hexdigest()[:8]
    cache = cache_folder()
    cache.mkdir(parents=True, exist_ok=True)
    folder = cache / f"guest-{SUITE}-{recipe}"
    with open(cache / "guest.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.is_dir():
            # Of an older recipe, or of a builder that was killed.
            for path in cache.glob("guest-*"):
                shutil.rmtree(path, ignore_errors=True)
            _build(folder)
    return System(folder)


def make_disk(disk: Path, content: Path) -> None:
    """Make an ext4 file system of a folder's content."""
    used = run_tool("du", "--summarize", "--block-size=1M", str(content))
    size_mib = int(used.split()[0]) * 5 // 4 + SPARE_MIB
    run_tool(
        "mkfs.ext4", "-q", "-O", "^has_journal", "-N", "60000", "-d", str(content),
        str(disk), f"{size_mib}M",
    )  # fmt: skip


def run_tool(*command: str, timeout_s: float = 300.0) -> str:
    """
    Run a program and return its output.

    Raises:
        GuestError: It failed.
    """
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=timeout_s,
            check=False, preexec_fn=functools.partial(kernel.die_with_parent, os.getpid()),
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise GuestError(f"{command[0]}: not done in {timeout_s:g} s") from None
    if done.returncode:
        tail = "\n".join((done.stdout + done.stderr).splitlines()[-15:])
        raise GuestError(f"{command[0]} failed with {done.returncode}:\n{tail}")
    return done.stdout


def _build(target: Path) -> None:
    """Build under a temporary name; only a whole system gets its own."""
    say(f"guest: building a Debian {SUITE} with its kernel, once; some minutes")
    folder = Path(tempfile.mkdtemp(prefix="guest-part-", dir=target.parent))
    root = folder / "root"
    options = [f"--dpkgopt={option}" for option in DPKG_OPTIONS]
    try:
        run_tool(
            *ALONE, "mmdebstrap", "--mode=root", "--variant=minbase",
            f"--include={','.join(PACKAGES)}", *options, f"--customize-hook={GET_KERNEL}",
            SUITE, str(root), *debian_sources(), timeout_s=BUILD_S_MAX,
        )  # fmt: skip
        (root / "kernel").rename(folder / "kernel")
        for name in ("usr/share/doc", "var/cache/apt", "var/lib/apt/lists"):
            shutil.rmtree(root / name, ignore_errors=True)
        (root / "cosmos").mkdir()
        make_disk(folder / "system.img", root)
        folder.rename(target)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
