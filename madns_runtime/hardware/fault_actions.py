"""Names of the faults that may be inserted around a device, and the value that each takes. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final, get_args

from madns_runtime.errors import ConfigurationError
from madns_runtime.hardware.contract import Channel
from madns_runtime.timeline.kinds import DeviceFaultWord

ACTIONS: Final[tuple[str, ...]] = get_args(DeviceFaultWord)
WITH_VALUE: Final = {
    "bias": "the number that is added to each element",
    "noise": "the standard deviation of what is added to each element",
    "drop": "the share of samples that is lost, 0 to 1",
    "delay": "the time by which samples come late, s",
}

DISCONNECTED: Final = "an inserted fault disconnects it"
"""Why a device is lost that is closed on purpose."""
ON_NUMBERS: Final = frozenset(("bias", "noise"))


def check_fault_fits(action: str, channels: Iterable[Channel]) -> None:
    """
    Refuse a fault that would alter nothing of a device.

    Raises:
        ConfigurationError: It acts on numbers, and no input is of any.
    """
    inputs = [each for each in channels if each.direction == "in"]
    if action in ON_NUMBERS and all(each.is_frame for each in inputs):
        told = ", ".join(each.name for each in inputs) or "none"
        raise ConfigurationError(
            f"{action} is added to numbers, and the device has no input of numbers (inputs: {told}): drop, delay, freeze and"
            " disconnect act on frames, too"
        )


def check_fault(action: str, value: float | None) -> None:
    """
    Refuse a fault that is none.

    Raises:
        ConfigurationError: The action is unknown, or its value is missing, needless or out of range.
    """
    if action not in ACTIONS:
        raise ConfigurationError(f"expected an action of {', '.join(ACTIONS)}; got {action!r}")
    if action not in WITH_VALUE:
        if value is not None:
            raise ConfigurationError(f"{action} takes no value, got {value:g}")
        return
    if value is None:
        raise ConfigurationError(f"{action} needs a value: {WITH_VALUE[action]}")
    is_good = math.isfinite(value) and (action == "bias" or value >= 0)
    if not is_good or (action == "drop" and value > 1):
        raise ConfigurationError(f"{action}: expected {WITH_VALUE[action]}; got {value:g}")
