"""Where lines go: data to standard output, talk to standard error."""

from __future__ import annotations

import sys


def show(line: str) -> None:
    """Write a line of data, at once: a program may wait for it."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def say(line: str) -> None:
    """Write a line for people."""
    sys.stderr.write(line + "\n")
    sys.stderr.flush()
