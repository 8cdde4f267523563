"""
A board's disk: an ext4 file system in a file, on a loop device.

A real file system, so that a board can lose what it had not synced when its power is cut, fill up, and
turn read-only under open files as a worn card does. The file lies in memory; what is not written and
what was deleted takes none.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import time
from collections.abc import Iterable
from pathlib import Path

from . import kernel

PATIENCE_S = 60.0
POLL_S = 0.01
MOUNT_ATTEMPTS = 5
UPPER = "upper"
WORK = "work"
BALLAST = "ballast"
"""Fills the disk; it lies beside what the board sees."""


class DiskError(Exception):
    """A disk cannot be made, mounted or released."""


def make_template(path: Path, size_mib: int) -> None:
    """Write an empty file system, to be copied for every board: it takes a few kB."""
    path.touch(mode=0o600)
    os.truncate(path, size_mib << 20)
    options = ["-E", "lazy_itable_init=1,lazy_journal_init=1", "-J", "size=4", "-m", "0"]
    _run(["mkfs.ext4", "-q", "-F", *options, str(path)])


class Disk:
    """
    One board's disk.

    Args:
        image: The file.
        mount_point: Where the supervisor sees it while the board has power.
    """

    def __init__(self, image: Path, mount_point: Path) -> None:
        self.image = image
        self.mount_point = mount_point
        self.loop: str | None = None
        self.has_failed = False

    def create(self, template: Path) -> None:
        """Make it from the empty *template*."""
        self.image.unlink(missing_ok=True)
        self.has_failed = False
        _run(["cp", "--sparse=always", str(template), str(self.image)])
        self.mount_point.mkdir(parents=True, exist_ok=True)

    def mount(self) -> None:
        """Put it into the board: what a board does to its card when power comes on."""
        if self.has_failed:  # as the boot scripts of a Pi would; 1 = errors corrected
            _run(["e2fsck", "-p", str(self.image)], accept=(0, 1))
            self.has_failed = False
        # Not `discard`: when its power is cut the kernel would give back blocks that a lost transaction had freed, with
        # directories in them that are there again at the next mount.
        # Rarely committed unasked, else what a test has just written reaches the medium in the midst of a stall.
        _mount_image("loop,errors=remount-ro,noatime,commit=60", self.image, self.mount_point)
        kernel.trim(self.mount_point)
        self.loop = f"loop{os.minor(self.mount_point.stat().st_dev)}"
        for name in (UPPER, WORK):
            (self.mount_point / name).mkdir(exist_ok=True)

    def release(self) -> None:
        """Take it out, and wait until the kernel has let it go."""
        self.remove_ballast()
        kernel.unmount(self.mount_point)
        until_s = time.monotonic() + PATIENCE_S
        # A board that is just starting holds a copy of this mount for some milliseconds.
        while self._is_held():
            if time.monotonic() > until_s:
                raise DiskError(
                    f"{self.image.name}: still in use {PATIENCE_S:g} s after its release"
                )
            time.sleep(POLL_S)
        self.loop = None

    def _is_held(self) -> bool:
        """Whether the loop device still has this image, and not already another tower's."""
        try:
            backing = Path(f"/sys/block/{self.loop}/loop/backing_file").read_text()
        except OSError:
            return False
        return backing.strip() == str(self.image)

    def lose_power(self) -> None:
        """Forget what was not synced, and take no more."""
        kernel.lose_power(self.mount_point)

    def fail(self) -> None:
        """Meet an error of the medium: the file system turns read-only, whoever has files open."""
        Path(f"/sys/fs/ext4/{self.loop}/trigger_fs_error").write_text("tower")
        self.has_failed = True

    def fill(self, free_bytes: int = 0) -> None:
        """Leave only *free_bytes* of room."""
        self.remove_ballast()
        kernel.sync(self.mount_point)
        for _ in range(3):  # block maps take room of their own
            state = os.statvfs(self.mount_point)
            size = state.f_bavail * state.f_frsize - free_bytes
            if size <= 0:
                break
            self._grow_ballast(size)

    def remove_ballast(self) -> None:
        """Give the room back."""
        with contextlib.suppress(OSError):  # a failed disk keeps it
            (self.mount_point / BALLAST).unlink(missing_ok=True)

    def destroy(self) -> None:
        """Delete the medium."""
        self.image.unlink(missing_ok=True)
        shutil.rmtree(self.mount_point, ignore_errors=True)

    def _grow_ballast(self, size: int) -> None:
        """Reserve up to *size* more bytes, without writing them."""
        descriptor = os.open(self.mount_point / BALLAST, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC)
        try:
            while size >= 4096:
                end = os.fstat(descriptor).st_size
                try:
                    os.posix_fallocate(descriptor, end, size)
                except OSError:
                    size //= 2
                else:
                    break
        finally:
            os.close(descriptor)


def list_loop_devices() -> set[int]:
    """Return the numbers of the loop devices that the kernel has, used or not."""
    names = (path.name.removeprefix("loop") for path in Path("/sys/block").glob("loop*"))
    return {int(name) for name in names if name.isdecimal()}


def remove_loop_devices(numbers: Iterable[int], patience_s: float) -> None:
    """Take loop devices back out of the kernel, but for those that are still in use after a while."""
    left = set(numbers)
    until_s = time.monotonic() + patience_s
    while True:
        left = {number for number in left if not kernel.remove_loop_device(number)}
        if not left or time.monotonic() > until_s:
            return
        time.sleep(POLL_S)


def _mount_image(options: str, image: Path, mount_point: Path) -> None:
    """Mount a file; again if another tower's end has just taken away the loop device chosen for it."""
    for attempt in range(MOUNT_ATTEMPTS):
        try:
            _run(["mount", "-t", "ext4", "-o", options, str(image), str(mount_point)])
        except DiskError:
            if attempt == MOUNT_ATTEMPTS - 1:
                raise
            time.sleep(POLL_S)
        else:
            return


def _run(command: list[str], accept: tuple[int, ...] = (0,)) -> None:
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    if result.returncode not in accept:
        talk = (result.stderr + result.stdout).strip()
        raise DiskError(f"{' '.join(command)}: exit {result.returncode}: {talk}")
