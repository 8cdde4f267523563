"""
Latency of a loop that is closed through hardware, part by part.

    truth -> device      a stimulus is put out, later than it was due
    device -> reading    a sensor's sample is handed on, after it was taken
    reading -> command   flight software behind an interface answers a tick's report
    command -> truth     the host hears of a command (T_n) and hands out the truth that holds it (T_p)

A sensor that a flight computer reads itself is inside the third part.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from madns_runtime.analysis.distribution import Distribution, Summary
from madns_runtime.analysis.sampling import as_array
from madns_runtime.analysis.tables import RecordedRun, RecordedTable
from madns_runtime.analysis.values import (
    Axis,
    Block,
    Figure,
    FigureChoice,
    Floats,
    Histogram,
    TableBlock,
    headings,
)
from madns_runtime.plain_values import mapping_at

DEVICE, MANEUVERS, ANSWERS, ANSWER = "device_", "host_maneuvers", "flight_answers", "answer_us"
TITLE = "Latency of the loop, ms"
NOTE = "Command to truth is T_n + T_p: from the tick that commanded to the truth that holds it."
PARTS = ("truth to device", "device to reading", "reading to command", "command to truth")
BINS = 60


def loop_latencies(run: RecordedRun) -> dict[str, Summary]:
    """Return the latency of each part of the loop that was closed, us; nothing without answers of flight software."""
    table = run.tables.get(ANSWERS)
    return {} if table is None else _latencies(table, run)


def loop_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return the parts of the loop's latency as a table, and how long answers took as a histogram."""
    parts = _latencies(table, run)
    if not parts:
        return []
    samples = [as_array(columns[ANSWER]) for _, columns in table.each((ANSWER,))]
    return [
        TableBlock(
            title=TITLE,
            headings=headings("part", "count", "p50", "p99", "max"),
            rows=[
                [name, one.count, one.p50 / 1e3, one.p99 / 1e3, one.max / 1e3]
                for name, one in parts.items()
            ],
            note=NOTE,
        ),
        _histogram(np.concatenate(samples) / 1e3),
    ]


def _latencies(answered: RecordedTable, run: RecordedRun) -> dict[str, Summary]:
    if not answered.rows or not answered.has(ANSWER):
        return {}
    answers = Distribution()
    for _, columns in answered.each((ANSWER,)):
        answers.add(Distribution.of(as_array(columns[ANSWER])))
    parts = {
        PARTS[0]: _of_devices(run, "lateness_us", _stimulated(run)),
        PARTS[1]: _of_devices(run, "age_us", _measuring(run)),
        PARTS[2]: answers,
        PARTS[3]: _of_maneuvers(run),
    }
    told = {name: part.summary() for name, part in parts.items()}
    return {name: summary for name, summary in told.items() if summary is not None}


def _histogram(answers_ms: Floats) -> Figure:
    found = answers_ms[np.isfinite(answers_ms)]
    edges = np.linspace(0.0, max(float(found.max(initial=0.0)), 1e-3), BINS + 1)
    counts, _ = np.histogram(found, edges)
    return Figure(
        title="Answers of flight software",
        note="From the tick's report to the whole answer, of all vehicles behind an interface.",
        x=Axis(quantity="time to the answer", unit="ms"),
        y=Axis(quantity="answers"),
        choices=[FigureChoice(marks=[Histogram(edges=edges, counts=counts.astype(np.float64))])],
    )


def _of_devices(run: RecordedRun, field: str, channels: Iterable[str]) -> Distribution:
    """Return the distribution of a field of devices' channels, us."""
    found = Distribution()
    for name in sorted(set(channels)):
        table = run.tables.get(f"{DEVICE}{name}")
        if table is None or not table.has(field):
            continue
        for _, columns in table.each((field,)):
            found.add(Distribution.of(as_array(columns[field])))
    return found


def _of_maneuvers(run: RecordedRun) -> Distribution:
    """Return the distribution of T_n + T_p, us; of refused commands there is none."""
    table = run.tables.get(MANEUVERS)
    fields = ("propagation_s", "network_s")
    found = Distribution()
    if table is None or not table.has(*fields):
        return found
    for _, columns in table.each(fields):
        seconds = as_array(columns[fields[0]]) + as_array(columns[fields[1]])
        found.add(Distribution.of(np.round(seconds * 1e6)))
    return found


def _vehicles(run: RecordedRun) -> Iterator[Mapping[str, object]]:
    """Yield the scenario's descriptions of vehicles."""
    parameters = {} if run.config is None else run.config.parameters
    yield from (each for each in parameters.get("vehicles", ()) if isinstance(each, Mapping))


def _stimulated(run: RecordedRun) -> Iterator[str]:
    """Yield the channels that are given truth, as device.channel."""
    for vehicle in _vehicles(run):
        stimuli = vehicle.get("stimuli", ())
        if isinstance(stimuli, list | tuple):
            yield from (str(each["channel"]) for each in stimuli if "channel" in each)


def _measuring(run: RecordedRun) -> Iterator[str]:
    """Yield the channels that are sensors, as device.channel."""
    for vehicle in _vehicles(run):
        for settings in mapping_at(vehicle, "sensors").values():
            if isinstance(settings, Mapping) and "device" in settings:
                yield str(settings["device"])
