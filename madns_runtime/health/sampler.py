"""
State of health, sampled in a process of its own: no look at the machine ever costs a tick.

The process is forked from whoever starts it, records the HEALTH stream, and ends with its parent.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from madns_runtime.config import Health, Recording
from madns_runtime.health.lifeline import ChildProcess, Lifeline, fork_child
from madns_runtime.health.probe import Probe
from madns_runtime.health.snapshot import to_record
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.recording.recorder import Recorder
from madns_runtime.recording.records import HEALTH

NICENESS = 10
"""Added to the sampler's niceness: it waits for the loops, not they for it."""
RECORDS_TIMEOUT_S = 5.0
SAMPLER_TIMEOUT_S = RECORDS_TIMEOUT_S + 1.0
"""Wait for the sampler's end: its records need their own time."""


def start_sampler(  # noqa: PLR0913 - who records, and how; all by name
    directory: Path,
    *,
    run: str,
    machine: str,
    settings: Health,
    recording: Recording,
    incarnation: int = 1,
) -> ChildProcess:
    """
    Start the process that records this machine's state of health. Call it before threads are started.

    To wait for the process ends it, and its report is its record counts (`RecordCounts.to_mapping`).

    Args:
        directory: Where health.jsonl goes.
        run: Name of the run.
        machine: Name of this machine.
        settings: The period.
        recording: How its records reach the disk.
        incarnation: Which incarnation of the process that starts it this is; the file is numbered by it.
    """

    def main(lifeline: Lifeline) -> Mapping[str, Any]:
        files = RecordFiles(directory, run=run, source=machine, incarnation=incarnation)
        recorder = Recorder(files, recording)
        recorder.open_stream(HEALTH)
        recorder.start()
        _sample(lifeline, Probe(directory), recorder, period_s=settings.period_s)
        return recorder.close(RECORDS_TIMEOUT_S).to_mapping()

    return fork_child(main, nice=NICENESS)


def _sample(lifeline: Lifeline, probe: Probe, recorder: Recorder, *, period_s: float) -> None:
    """Record a sample now, every period, and at the end."""
    started_s = time.monotonic()
    before = probe.read()
    recorder.record(HEALTH.name, to_record(before, None))
    count, is_over = 0, False
    while not is_over:
        # The next whole period, so that a slow look does not shift those after it.
        count = max(count + 1, int((time.monotonic() - started_s) / period_s))
        is_over = lifeline.has_ended(started_s + count * period_s - time.monotonic())
        now = probe.read()
        recorder.record(HEALTH.name, to_record(now, before))
        before = now
