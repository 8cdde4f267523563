"""A disk that takes nothing more."""

import errno


def refuse(*_arguments, **_more):
    """Fail as a call of the system does where a disk is full."""
    raise OSError(errno.ENOSPC, "No space left on device")
