"""Folders within folders, deeper than what is recursive goes."""

import contextlib
import os

FILE = "deep.txt"


@contextlib.contextmanager
def nested_folders(folder, name, count):
    """Make folders of a name, each within the one before, with a file in the last; they are gone behind the block."""
    made, above = [], os.open(folder, os.O_RDONLY)
    for _ in range(count):
        os.mkdir(name, dir_fd=above)
        made.append(above)
        above = os.open(name, os.O_RDONLY, dir_fd=above)
    os.close(os.open(FILE, os.O_CREAT | os.O_WRONLY, dir_fd=above))
    try:
        yield
    finally:
        os.unlink(FILE, dir_fd=above)
        os.close(above)
        for above in reversed(made):
            os.rmdir(name, dir_fd=above)
            os.close(above)
