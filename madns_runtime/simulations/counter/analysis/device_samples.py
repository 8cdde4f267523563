"""Samples of a device that agents sent to the host: the sixth plot of the thesis's section 7.1."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from madns_runtime.analysis.distribution import summarise
from madns_runtime.analysis.lines import grouped_lines
from madns_runtime.analysis.tables import RecordedRun, RecordedTable
from madns_runtime.analysis.values import Axis, Block, Floats, ReportRemark, TableBlock, headings

DELAY = "delay_us"
COLUMNS = ("t_s", "device", "channel", DELAY)
Delays = Mapping[str, tuple[Floats, Floats]]
"""By device and channel: when each sample was taken, s, and how much later the host had it, ms."""


def device_sample_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return the delay between a device's reading and the host's record over time, and its statistics."""
    if not table.rows:
        return [ReportRemark(text="No sample of a device reached the host.")]
    delays = _delays(table)
    figure = grouped_lines(
        delays,
        title="Delay from a device's reading to the host's record",
        y=Axis(unit="ms", from_zero=True),
        note="From the time at which a sample was true to its record at the host: the device's own delay,"
        " the wait for the agent's tick, and the way to the host.",
        form="points",
        group="devices",
    )
    rows = [
        [name, s.count, *(round(value, 4) for value in (s.mean, s.sd, s.min, s.max, s.p99))]
        for name, (_, values_ms) in delays.items()
        if (s := summarise(values_ms))
    ]
    statistics = TableBlock(
        title="Delay from reading to record, ms",
        headings=headings("device", "samples", "mean", "sd", "min", "max", "p99"),
        rows=rows,
    )
    return [*figure, statistics]


def _delays(table: RecordedTable) -> Delays:
    found: dict[str, tuple[Floats, Floats]] = {}
    for _, columns in table.each(COLUMNS):
        t_s = np.asarray(columns["t_s"], dtype=np.float64)
        delay_ms = np.asarray(columns[DELAY], dtype=np.float64) / 1000.0
        devices, channels = columns["device"].astype(str), columns["channel"].astype(str)
        for device, channel in dict.fromkeys(zip(devices.tolist(), channels.tolist(), strict=True)):
            rows = np.flatnonzero((devices == device) & (channels == channel))
            found[f"{device} {channel}"] = (t_s[rows], delay_ms[rows])
    return found
