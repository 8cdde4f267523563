"""Folders within folders, deeper than what is recursive goes."""

import contextlib
import os

FILE = "deep.txt"


@contextlib.contextmanager
def nested_folders(folder, name, count):
    """Make folders of a name, each within the one before, with a file in the last; they are gone behind the block."""
    deepest = os.open(folder, os.O_RDONLY)
    for _ in range(count):
        os.mkdir(name, dir_fd=deepest)
        deepest = _moved(deepest, name)
    os.close(os.open(FILE, os.O_CREAT | os.O_WRONLY, dir_fd=deepest))
    try:
        yield
    finally:
        os.unlink(FILE, dir_fd=deepest)
        for _ in range(count):
            deepest = _moved(deepest, "..")
            os.rmdir(name, dir_fd=deepest)
        os.close(deepest)


def _moved(descriptor, to):
    """Return the folder *to* as seen from an open one, which is closed: a process may have 1,024 files open, and no more."""
    try:
        return os.open(to, os.O_RDONLY, dir_fd=descriptor)
    finally:
        os.close(descriptor)
