"""Writes a layer of an overlay file system: files, folders, and what hides those of the layers below."""

from __future__ import annotations

import os
import shutil
import stat
from collections.abc import Collection
from pathlib import Path

OPAQUE = "trusted.overlay.opaque"
BOARD_FILES = Path(__file__).with_name("board_files")


class Layer:
    """
    One layer.

    Args:
        folder: Where it is written.
        lower: What lies below it.
    """

    def __init__(self, folder: Path, lower: Path) -> None:
        self.folder = folder
        self.lower = lower
        folder.mkdir(parents=True, exist_ok=True)

    def add(self, path: str, content: str | bytes, mode: int = 0o644) -> None:
        """Write a file; folders above it show what lies below them, too."""
        target = self.folder / path
        self.share(os.path.dirname(path))
        target.unlink(missing_ok=True)
        target.write_bytes(content.encode() if isinstance(content, str) else content)
        target.chmod(mode)

    def install(self, path: str, name: str, mode: int = 0o755) -> None:
        """Write a file of `board_files`."""
        self.add(path, (BOARD_FILES / name).read_bytes(), mode)

    def link(self, path: str, target: str) -> None:
        """Write a symbolic link."""
        self.share(os.path.dirname(path))
        (self.folder / path).unlink(missing_ok=True)
        (self.folder / path).symlink_to(target)

    def renew(self, path: str, mode: int = 0o755) -> None:
        """Make a folder that shows nothing of what lies below it."""
        self.share(os.path.dirname(path))
        (self.folder / path).mkdir(exist_ok=True)
        (self.folder / path).chmod(mode)
        os.setxattr(self.folder / path, OPAQUE, b"y")

    def share(self, path: str) -> None:
        """Make a folder like the one below, unless it is there; it shows what lies below."""
        if path and not (self.folder / path).is_dir():
            self.share(os.path.dirname(path))
            below = self.lower / path
            mode = stat.S_IMODE(below.stat().st_mode) if below.is_dir() else 0o755
            (self.folder / path).mkdir()
            (self.folder / path).chmod(mode)

    def hide(self, path: str) -> None:
        """Make nothing be there."""
        self.share(os.path.dirname(path))
        os.mknod(self.folder / path, stat.S_IFCHR, os.makedev(0, 0))

    def keep_only(self, path: str, names: Collection[str]) -> None:
        """Hide every entry of a folder below but these."""
        for entry in sorted(os.listdir(self.lower / path)):
            if entry not in names:
                self.hide(os.path.join(path, entry))

    def copy(self, path: str, source: Path) -> None:
        """Write a copy of a file."""
        self.share(os.path.dirname(path))
        shutil.copy2(source, self.folder / path)
