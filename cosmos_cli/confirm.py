"""Asking before what cannot be undone."""

from __future__ import annotations

import sys

from cosmos_cli.errors import InputError

AGREEMENTS = ("y", "yes")


def confirm(question: str, *, is_sure: bool) -> bool:
    """
    Ask on the terminal whether to go on; the answer no is the default.

    Args:
        question: Names what will be done.
        is_sure: Whether --yes was given: nobody is asked.

    Raises:
        InputError: There is no terminal to ask at.
    """
    if is_sure:
        return True
    if not sys.stdin.isatty():
        raise InputError(f"{question} there is no terminal to ask at: give --yes to agree")
    sys.stderr.write(f"{question} [y/N] ")
    sys.stderr.flush()
    return sys.stdin.readline().strip().lower() in AGREEMENTS
