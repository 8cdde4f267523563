"""The process of one device, or of some that cannot block: its loop, from the fork to its last word."""

from __future__ import annotations

import os
import signal
import socket
import traceback
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from madns_runtime.config import RunConfig
from madns_runtime.errors import MadnsError
from madns_runtime.hardware import messages
from madns_runtime.hardware.records import DeviceRecords
from madns_runtime.hardware.runner import DeviceRunner
from madns_runtime.hardware.seat import DeviceSeat
from madns_runtime.plugin.code_places import error_text
from madns_runtime.plugin.isolation import said
from madns_runtime.reactor.forking import leave_parent
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.reactor.scheduling import apply as apply_scheduling
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.recording.recorder import Recorder
from madns_runtime.recording.run_journal import RunJournal
from madns_runtime.recording.writer_thread import WriterThread

RECORDS_TIMEOUT_S = 2.0
ERROR_CHARACTERS_MAX = 500
"""Characters told of what a driver raised; all of it is recorded."""
REPORT, GONE = "report", "gone"
"""First words to the manager: [REPORT, counts by device] at the end, in as many messages as it takes; [GONE, why] before where nobody said stop."""


def run_devices(
    seats: Sequence[DeviceSeat], control: socket.socket, config: RunConfig, directory: Path
) -> None:
    """
    Drive devices until the manager says stop, or is gone; never returns. Called in a forked child.

    Args:
        seats: The devices.
        control: This process's end of its pair with the manager.
        config: The run.
        directory: The run directory here; devices record below devices/.
    """
    code = 1
    try:
        users = {end.fileno() for seat in seats for end in seat.users.values()}
        claims = frozenset[int]().union(*(seat.claims for seat in seats))
        leave_parent(keep={control.fileno(), *users, *claims})
        report = DeviceLoop(seats, control, config, directory).run()
        for part in messages.in_parts(REPORT, report):
            messages.send(control, part)
        code = 0
    except BaseException as error:  # noqa: BLE001 - the last frame of a process
        why = error_text(error) if isinstance(error, MadnsError) else said(error)
        messages.send(control, [GONE, why])
        traceback.print_exception(error)
    finally:
        os._exit(code)


class DeviceLoop:
    """The loop of such a process; arguments as of `run_devices`."""

    def __init__(
        self,
        seats: Sequence[DeviceSeat],
        control: socket.socket,
        config: RunConfig,
        directory: Path,
    ) -> None:
        self._reactor = reactor = Reactor()
        self._control = control
        self._config = config
        self._why = ""
        self._records: list[DeviceRecords] = []
        self._runners: dict[str, DeviceRunner] = {}
        self._writer = WriterThread(config.recording)
        for seat in seats:
            launch = seat.launch
            folder = directory / "devices" / launch.place / launch.name
            files = RecordFiles(folder, run=config.run, source=launch.full_name)
            recorder = Recorder(files, config.recording, self._writer.writes(files))
            journal = RunJournal(recorder, config.recording.verbosity, t_s=lambda: None)
            records = DeviceRecords(journal, seat.channels)
            self._records.append(records)
            runner = self._runners[launch.full_name] = DeviceRunner(seat, records, reactor)
            runner.tell_error = partial(self._tell_error, launch.full_name)
            runner.tell_fault = partial(self._tell_fault, launch.full_name)

    def run(self) -> Mapping[str, Any]:
        """Run to the end, and return the devices' reports by their full names."""
        reactor = self._reactor
        reactor.on_signal(signal.SIGTERM, lambda: self._stop("SIGTERM"))
        reactor.on_signal(signal.SIGINT, lambda: None)  # a terminal's Ctrl-C is the operator's
        reactor.add_reader(self._control.fileno(), self._obey)
        for records in self._records:
            records.journal.recorder.start()
        # The recorders' thread runs already: only the loop is raised to its priority.
        grant = apply_scheduling(self._config.scheduling, is_host=False)
        self._writer.follow(grant.priority)
        for runner in self._runners.values():
            runner.open()
        reactor.run()
        gave_up = [runner.gave_up for runner in self._runners.values() if runner.gave_up]
        if gave_up:
            self._why = self._why or gave_up[0]
            messages.send(self._control, [GONE, gave_up[0]])
        return {
            name: runner.end(self._why, RECORDS_TIMEOUT_S) for name, runner in self._runners.items()
        }

    def _tell_error(self, name: str, text: str) -> None:
        messages.send(self._control, [messages.ERROR, name, text[:ERROR_CHARACTERS_MAX]])

    def _tell_fault(self, name: str, action: str, value: float | None) -> None:
        messages.send(self._control, [messages.FAULT, name, action, value])

    def _obey(self) -> None:
        has_heard = False
        for word, *rest in messages.receive_all(self._control):
            has_heard = True
            if word == messages.END:
                self._stop(str(rest[0]))
            elif word == messages.OWNER_GONE:
                self._runners[rest[0]].owner_gone()
            elif word == messages.FAULT:
                self._runners[rest[0]].insert_fault(*rest[1:])
        if not has_heard and messages.is_over(self._control):
            self._stop("its supervisor is gone")

    def _stop(self, why: str) -> None:
        self._why = self._why or why
        self._reactor.stop()
