"""
Records of a run that does not wait for the disk by itself: here the disk holds up the run, and nothing is dropped.

No thread, and no byte that depends on the wall clock: a run recorded twice is recorded the same.
"""

from __future__ import annotations

from pathlib import Path

from madns_runtime.config import RunConfig
from madns_runtime.errors import MachineError
from madns_runtime.lockstep.clock import T0_UTC, SimulatedClock
from madns_runtime.recording.number_rows import ROWS_TOGETHER
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.recording.recorder import Recorder, StreamTap
from madns_runtime.recording.run_journal import RunJournal


class DirectWriter:
    """
    Writes what waits in whoever records, when much does; see `RecordWriter`.

    Args:
        files: What it writes.
    """

    def __init__(self, files: RecordFiles) -> None:
        self._files = files
        self._is_closed = False

    def start(self) -> None:
        """Do nothing: there is no thread."""

    def flush(self) -> None:
        """
        Write what waits.

        Raises:
            MachineError: The disk refuses: a run that goes on would only lose records.
        """
        if not self._is_closed and not self._files.write_waiting():
            raise MachineError(f"records cannot be written: {'; '.join(self._files.errors)}")

    def close(self, timeout_s: float) -> None:
        """Write what waits and the end lines, and make it durable."""
        del timeout_s  # the host waits, not this process
        if not self._is_closed:
            self._is_closed = True
            self._files.write_waiting()
            self._files.finish()


def open_journal(  # noqa: PLR0913 - what a journal is of; two are optional and by name
    directory: Path,
    config: RunConfig,
    *,
    source: str,
    clock: SimulatedClock,
    tap: StreamTap | None = None,
    incarnation: int = 1,
) -> RunJournal:
    """
    Return the journal, with a recorder, of the host or of one agent.

    The schema lines name the scenario where those of other runs name the run: its number would
    differ from one run to the next.

    Args:
        directory: Where the files go.
        config: The run.
        source: host, or the agent's name.
        clock: What events and logged sentences carry the time of.
        tap: Looks at the records; None if nobody does.
        incarnation: Which incarnation of its source this is.

    Raises:
        MachineError: The directory cannot be made, or takes no new file.
    """
    files = RecordFiles(directory, run=config.scenario, source=source, incarnation=incarnation)
    recorder = Recorder(
        files, config.recording, DirectWriter(files), rows_together=ROWS_TOGETHER, tap=tap
    )
    recorder.set_t0(T0_UTC)
    return RunJournal(recorder, config.recording.verbosity, t_s=clock.now_s, utc=clock.utc)
