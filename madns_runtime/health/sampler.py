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
from madns_runtime.health.lifeline import Child, Lifeline, fork_child
from madns_runtime.health.probe import Probe
from madns_runtime.health.snapshot import to_record
from madns_runtime.recording.records import HEALTH
from madns_runtime.recording.writer import Recorder

NICENESS = 10
"""Added to the sampler's niceness: it waits for the loops, not they for it."""
RECORDS_TIMEOUT_S = 5.0
SAMPLER_TIMEOUT_S = RECORDS_TIMEOUT_S + 1.0
"""How long whoever ends the sampler should wait for it: its records need their own time."""


def start_sampler(  # noqa: PLR0913 - who records, and how; all by name
    directory: Path,
    *,
    run: str,
    machine: str,
    settings: Health,
    recording: Recording,
    life: int = 1,
) -> Child:
    """
    Start the process that records this machine's state of health. Call it before threads are started.

    Args:
        directory: Where health.jsonl goes.
        run: Name of the run.
        machine: Name of this machine.
        settings: The period.
        recording: How its records reach the disk.
        life: Which life of the process that starts it this is; the file is numbered by it.
    """

    def main(lifeline: Lifeline) -> Mapping[str, Any]:
        recorder = Recorder(directory, run=run, source=machine, settings=recording, life=life)
        recorder.open_stream(HEALTH)
        recorder.start()
        _sample(lifeline, Probe(directory), recorder, period_s=settings.period_s)
        return recorder.close(RECORDS_TIMEOUT_S).to_mapping()

    return fork_child(main, nice=NICENESS)


def stop_sampler(handle: Child, timeout_s: float) -> Mapping[str, Any]:
    """
    End the sampler and return its record counts (`RecordCounts.to_mapping`).

    Args:
        handle: What `start_sampler` returned.
        timeout_s: After this it is killed, and "errors" says so.
    """
    return handle.wait(timeout_s)


def _sample(lifeline: Lifeline, probe: Probe, recorder: Recorder, *, period_s: float) -> None:
    """Record a sample now, every period, and at the end."""
    started_s = time.monotonic()
    before = None
    count = 0
    is_over = False
    while True:
        reading = probe.read()
        recorder.record(HEALTH.name, to_record(reading, before))
        before = reading
        if is_over:
            return
        # The next whole period, so that a slow look does not shift those after it.
        count = max(count + 1, int((time.monotonic() - started_s) / period_s))
        is_over = lifeline.has_ended(started_s + count * period_s - time.monotonic())
