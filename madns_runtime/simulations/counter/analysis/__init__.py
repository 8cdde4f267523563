"""The counting benchmark's chapters of a report: which of its streams gets which figures."""

from __future__ import annotations

from madns_runtime.analysis.chapters import Chapter, build_sections
from madns_runtime.analysis.tables import RecordedRun
from madns_runtime.analysis.values import Section
from madns_runtime.recording.records import Field
from madns_runtime.simulations.counter.analysis.benchmark import document
from madns_runtime.simulations.counter.analysis.device_samples import device_sample_blocks
from madns_runtime.simulations.counter.analysis.round_trips import ROUND_TRIP, round_trip_blocks
from madns_runtime.simulations.counter.parameters import DEVICE_SAMPLES

__all__ = ["CHAPTERS", "document", "figures"]

CHAPTERS = {
    "round_trips": Chapter(
        "Round trips",
        round_trip_blocks,
        (Field("packet", "", "int"), Field(ROUND_TRIP, "us", "int")),
    ),
    "host_device_samples": Chapter("Device samples", device_sample_blocks, DEVICE_SAMPLES),
}


def figures(run: RecordedRun) -> list[Section]:
    """Return the chapters of a run."""
    return build_sections(CHAPTERS, run)
