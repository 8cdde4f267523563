"""
Numbers of commands: those of flight software and those of devices have ranges of their own. Pure.

A vehicle that rejoins counts on behind all that it can have given before. In a long run that passes the range below the
first number of a device; what is counted from there on has another one, far behind.
"""

from __future__ import annotations

DEVICE_NUMBER_FIRST = 2**30
"""Of a device's first command; those of flight software are below it, and from DEVICE_NUMBER_END on."""
DEVICE_NUMBER_END = 2**31
DEVICE_NUMBER_FIRST_LATER = 2**52
"""Of a device's first command in a vehicle that rejoins when all lower numbers may be used up."""
COMMANDS_MAX = 2**53
"""Numbers of commands are below it: up to there 64-bit floats, which JSON is read as, tell whole numbers apart."""
SPARE_NUMBERS = 2**24
"""Left in a range for the commands of whoever begins to count in it."""


def first_number(given: int, *, of_device: bool = False) -> int:
    """Return the number of the first command of a vehicle that may have given so many before it was lost."""
    is_early = given <= DEVICE_NUMBER_FIRST - SPARE_NUMBERS
    if of_device:
        return given + (DEVICE_NUMBER_FIRST if is_early else DEVICE_NUMBER_FIRST_LATER)
    return given if is_early else given + DEVICE_NUMBER_END


def is_of_device(number: int) -> bool:
    """Return whether a command is a device's, by its number."""
    return DEVICE_NUMBER_FIRST <= number < DEVICE_NUMBER_END or number >= DEVICE_NUMBER_FIRST_LATER
