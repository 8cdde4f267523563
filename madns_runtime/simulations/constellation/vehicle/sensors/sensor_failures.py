"""A sensor that fails for a while: stuck, biased or dead. Pure."""

from __future__ import annotations

import math

from madns_runtime.simulations.constellation.actions import SensorFault

Measured = tuple[float, ...]


class SensorFailures:
    """
    The failures of one sensor; several may be in force at a time.

    Args:
        is_unit: Whether its measurements are of length 1, as a direction and a quaternion are, also biased ones.
    """

    def __init__(self, *, is_unit: bool = False) -> None:
        self._is_unit = is_unit
        self._failures: dict[int, SensorFault] = {}
        self._last: Measured | None = None

    def __bool__(self) -> bool:
        return bool(self._failures)

    def begin(self, number: int, fault: SensorFault) -> None:
        """Put a failure in force."""
        self._failures[number] = fault

    def end(self, number: int) -> None:
        """Lift a failure."""
        self._failures.pop(number, None)
        if all(each.fault != "stuck" for each in self._failures.values()):
            self._last = None

    @property
    def is_dead(self) -> bool:
        """Whether no measurement comes."""
        return any(each.fault == "dead" for each in self._failures.values())

    def altered(self, values: Measured) -> Measured | None:
        """Return what a measurement becomes; None if none comes. A stuck one repeats the first since it stuck."""
        if self.is_dead:
            return None
        kinds = {each.fault for each in self._failures.values()}
        for each in self._failures.values():
            if each.fault == "biased":
                added = (*each.bias, *(0.0,) * (len(values) - len(each.bias)))
                values = tuple(v + b for v, b in zip(values, added, strict=False))
        if self._is_unit:
            length = math.hypot(*values)
            if not length:
                return None
            values = tuple(value / length for value in values)
        if "stuck" not in kinds:
            return values
        self._last = values if self._last is None else self._last
        return self._last
