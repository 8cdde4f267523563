"""How many allocations the processes of a command make, by a shared object that is loaded before the C library."""

import shutil
import struct
import subprocess
from pathlib import Path

SOURCE = Path(__file__).with_name("count_allocations.c")
COMPILER = shutil.which("cc") or shutil.which("gcc")


class Allocations:
    """
    The counts of all processes that have these variables in their environment.

    Args:
        folder: Where the object is built and the counts are kept.
    """

    def __init__(self, folder: Path) -> None:
        self._counts = folder / "allocations"
        self._counts.mkdir()
        library = folder / "count_allocations.so"
        build = [COMPILER, "-O2", "-shared", "-fPIC", "-o", library, SOURCE, "-lpthread"]
        subprocess.run(build, check=True)
        self.environment = {
            "COUNT_ALLOCATIONS": str(self._counts),
            "LD_PRELOAD": str(library),
            # Python's own allocator takes what it hands out from memory that it got in large pieces.
            "PYTHONMALLOC": "malloc",
        }

    def of(self, pid: int) -> int:
        """Return how many allocations a process has made."""
        return struct.unpack("<Q", (self._counts / str(pid)).read_bytes())[0]
