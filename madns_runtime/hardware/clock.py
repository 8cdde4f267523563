"""
Offset and drift of a device's own clock against the machine's, from samples alone.

A sample is taken after the device has stamped it, by a delay that is never negative: of all lines below the
points (device time, machine time) the one nearest to them is the clock, since delays only ever lift points.
It is an edge of the points' lower convex hull: the one that lies below their mean. (Moon, Skelly and Towsley,
"Estimation and Removal of Clock Skew from Network Delay Measurements", 1999.)
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

WINDOW_S = 120.0
POINTS_MAX = 1024
"""Of the window: one per WINDOW_S / POINTS_MAX is kept, that with the least delay."""
RATE_MAX = 2.0
"""Of one clock by the other: beyond, samples were not taken as the device stamped them, as of a buffer that was read at once."""
SPAN_S_MIN = 2.0
"""Before so much time has passed, a rate would be noise."""


@dataclass(frozen=True, slots=True)
class DeviceClockEstimate:
    """The machine's clock as a line over the device's."""

    offset_s: float
    """Machine time minus device time, at the newest sample, s."""
    drift_ppm: float
    """How much faster the device's clock runs than the machine's, parts per million; negative if slower."""


class DeviceClock:
    """Estimate of one device's clock; bounded, and made anew after a step of the device's clock."""

    def __init__(self) -> None:
        self._points: deque[tuple[float, float]] = deque()
        self.steps = 0
        """How often the device's clock went back or leapt."""

    def add(self, device_s: float, taken_s: float) -> None:
        """Take note of a sample's two times, s; those that are no numbers are left out."""
        if not (math.isfinite(device_s) and math.isfinite(taken_s)):
            return
        points = self._points
        if points and not self._continues(device_s, taken_s):
            points.clear()
            self.steps += 1
        spacing_s = WINDOW_S / POINTS_MAX
        if len(points) > 1 and device_s - points[-2][0] < spacing_s:
            # Of two in one stretch the one with the less delay stays.
            if taken_s - device_s > points[-1][1] - points[-1][0]:
                return
            points.pop()
        points.append((device_s, taken_s))
        while points[-1][1] - points[0][1] > WINDOW_S or len(points) > POINTS_MAX:
            points.popleft()

    def _continues(self, device_s: float, taken_s: float) -> bool:
        """Tell whether a sample may be of the same clock: it goes on, and less than twice as fast as the machine's."""
        before_device_s, before_taken_s = self._points[-1]
        passed_s, elapsed_s = device_s - before_device_s, taken_s - before_taken_s
        return 0 <= passed_s <= RATE_MAX * elapsed_s + 1.0

    def estimate(self) -> DeviceClockEstimate | None:
        """Return the estimate; None while too little time has passed, or the times are those of no clock."""
        points = self._points
        if len(points) < 3 or points[-1][0] - points[0][0] < SPAN_S_MIN:
            return None
        hull = _lower_hull(points)
        mean_s = sum(device_s for device_s, _ in points) / len(points)
        below = next(number for number, (device_s, _) in enumerate(hull[1:]) if device_s >= mean_s)
        (a_device_s, a_taken_s), (b_device_s, b_taken_s) = hull[below], hull[below + 1]
        rate = (b_taken_s - a_taken_s) / (b_device_s - a_device_s)
        if not 1.0 / RATE_MAX <= rate <= RATE_MAX:
            return None
        newest_s = points[-1][0]
        offset_s = a_taken_s + (newest_s - a_device_s) * rate - newest_s
        return DeviceClockEstimate(offset_s=offset_s, drift_ppm=(1.0 / rate - 1.0) * 1e6)


def _lower_hull(points: deque[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the lower convex hull of points in rising order of their first coordinate."""
    hull: list[tuple[float, float]] = []
    for point in points:
        while len(hull) > 1 and _turn(hull[-2], hull[-1], point) <= 0:
            hull.pop()
        if hull and hull[-1][0] == point[0]:
            continue
        hull.append(point)
    return hull


def _turn(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    """Return a positive number if the way from *a* over *b* to *c* turns left."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
