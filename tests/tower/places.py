"""Where a tower keeps what others must find: /run/cosmos-tower/<index>, readable by root alone."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

RUN = Path("/run/cosmos-tower")
TOWERS_MAX = 64


@dataclass(frozen=True, slots=True)
class Places:
    """The files of the tower with this index."""

    index: int

    @property
    def folder(self) -> Path:
        return RUN / str(self.index)

    @property
    def control(self) -> Path:
        return self.folder / "control"

    @property
    def loops(self) -> Path:
        """The loop devices that were there before this tower."""
        return self.folder / "loops_before.json"

    @property
    def key(self) -> Path:
        return self.folder / "key"

    @property
    def known_hosts(self) -> Path:
        return self.folder / "known_hosts"

    @property
    def ssh_config(self) -> Path:
        return self.folder / "ssh_config"

    @property
    def logs(self) -> Path:
        return self.folder / "log"

    @property
    def private(self) -> Path:
        """The supervisor's own mounts; empty for everyone else."""
        return self.folder / "private"

    @property
    def uplink(self) -> str:
        """The operator's network interface into the tower."""
        return f"cosmos{self.index}"

    @property
    def cgroup(self) -> str:
        return f"cosmos-tower-{self.index}"

    def remove(self) -> None:
        """Delete the files, and the parent folder with the last tower."""
        for path in self.folder.iterdir() if self.folder.is_dir() else ():
            if path.is_dir() and not os.path.ismount(path):  # never into what is mounted there
                shutil.rmtree(path, ignore_errors=True)
            elif not path.is_dir():
                path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            self.folder.rmdir()
        with contextlib.suppress(OSError):
            RUN.rmdir()


def lock(places: Places) -> int | None:
    """
    Take a tower's index.

    Returns:
        A descriptor whose holder, and whose children that inherit it, own the index; None if it is owned.
        The lock lies on the folder itself: whoever owns it may delete it, and no lock file stays behind.
    """
    while True:
        places.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        try:
            descriptor = os.open(places.folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except FileNotFoundError:
            continue
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            return None
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), places.folder.stat()):
                return descriptor
        os.close(descriptor)  # its owner deleted the folder between our open and our lock


def is_owned(places: Places) -> bool:
    """Tell whether somebody runs this tower, or still cleans it up."""
    try:
        descriptor = os.open(places.folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


def list_towers() -> list[Places]:
    """Return the towers that left any trace, running or not."""
    numbers = (int(path.name) for path in RUN.glob("[0-9]*")) if RUN.is_dir() else ()
    return [Places(number) for number in sorted(numbers)]
