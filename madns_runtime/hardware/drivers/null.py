"""Driver of `null`; see `madns_runtime.hardware.kinds.null`."""

from __future__ import annotations

from collections.abc import Mapping

from madns_runtime.hardware.contract import Sample, SimulatedDevice, Value


class NullDevice(SimulatedDevice):
    """Forgets what it is told."""

    def sample_at(self, t_s: float) -> Sample | None:
        """Return the time."""
        return Sample(values={"time": t_s}, taken_s=t_s)

    def write(self, values: Mapping[str, Value], due_s: float) -> None:
        """Forget the values."""
