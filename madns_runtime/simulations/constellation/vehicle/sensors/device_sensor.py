"""A sensor that is hardware: its readings come from a device, and truth is recorded beside them."""

from __future__ import annotations

from madns_runtime.plugin.api import AgentContext
from madns_runtime.simulations.constellation.flight.api import Reading
from madns_runtime.simulations.constellation.streams import OF_AGENTS
from madns_runtime.simulations.constellation.vehicle.sensors.channel_source import ChannelSource
from madns_runtime.simulations.constellation.vehicle.sensors.environment import Scene
from madns_runtime.simulations.constellation.vehicle.sensors.instruments import Instrument
from madns_runtime.simulations.constellation.vehicle.sensors.truth_beside import (
    TruthBeside,
    TruthOfTicks,
)


class DeviceSensor:
    """
    A device in the place of an instrument's model.

    Args:
        instrument: The model, which truth is measured with.
        source: Of readings.
        beside: Records of truth.
        context: Where readings are recorded.
        surroundings: Those of the vehicle, and truth at its last ticks.
    """

    def __init__(
        self,
        instrument: Instrument,
        source: ChannelSource,
        beside: TruthBeside,
        *,
        context: AgentContext,
        surroundings: tuple[Scene, TruthOfTicks],
    ) -> None:
        self.name = instrument.name
        self.news: list[Reading] = []
        """All that became known when it was read last."""
        self._digits = instrument.digits
        self._is_mean = instrument.is_mean
        self._stream = instrument.stream or instrument.name
        self._source, self._beside = source, beside
        self._scene, self._history = surroundings
        self._record = context.record
        self._samples = 0
        context.open_stream(self._stream, OF_AGENTS[self._stream])

    def read(self, tick: int, t_s: float) -> Reading | None:
        """Return and record the device's newest sample if it is a fresh one; called once in a tick."""
        reading = self._source.take()
        self.news = [] if reading is None else [reading]
        if reading is not None:
            self._samples += 1
            values = [round(value, self._digits) for value in reading.values]
            self._record(self._stream, (tick, reading.t_s, *values))
            if self._is_mean:
                self._beside.settle_now(tick, self._scene, t_s)
            else:
                self._beside.add(tick, reading.t_s)
        self._beside.settle(self._history, self._scene)
        return reading

    @property
    def is_silent(self) -> bool:
        """Whether it never gave anything, though its device was there: for one that was not the limits of devices hold."""
        return self._source.was_ok and not self._samples

    def counts(self) -> dict[str, int]:
        """Return what became of the device's samples."""
        source, beside = self._source, self._beside
        return {
            "samples": self._samples,
            "skipped": source.skipped,
            "absent": source.absent,
            "refused": source.refused,
            "unpaired": source.unpaired,
            "without_truth": beside.without_truth + beside.waiting,
        }
