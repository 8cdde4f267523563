"""The way to one vehicle's flight software: a transport, and the program at its other end if the agent starts it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from time import monotonic
from typing import Any

from madns_runtime.errors import BlamedError
from madns_runtime.simulations.constellation.flight.interface.arrival_thread import ArrivalThread
from madns_runtime.simulations.constellation.flight.interface.local_transports import StdioLink
from madns_runtime.simulations.constellation.flight.interface.opening import make_transport
from madns_runtime.simulations.constellation.flight.interface.program import FlightProgram, wait_for
from madns_runtime.simulations.constellation.flight.interface.transport import (
    READ_BYTES,
    RETRY_S,
    Arrival,
    Transport,
)
from madns_runtime.simulations.constellation.flight_settings import FlightAttached, FlightProcess
from madns_runtime.simulations.constellation.interface_settings import FlightInterface
from madns_runtime.simulations.constellation.substitution import substitute

ASK_S = 0.001
"""Between two looks at a transport that has no descriptor to wait on."""


class FlightLink:
    """
    Bytes to and from flight software, and its life.

    Args:
        settings: From the scenario.
        base_directory: Folder of the scenario.
        devices: Those that the agent uses.
        values: What stands for ${name} and the others.
        is_lockstep: Whether simulated time waits for the answers.

    Raises:
        BlamedError: The program cannot be started, or its place cannot be opened.
    """

    def __init__(
        self,
        settings: FlightProcess | FlightAttached,
        base_directory: Path,
        *,
        devices: Mapping[str, Any],
        values: Mapping[str, str],
        is_lockstep: bool,
    ) -> None:
        given = settings.interface or FlightInterface()
        self._start_s = given.start_s
        self._is_lockstep = is_lockstep
        self._has_thread = not is_lockstep  # what came between two ticks has its own time
        self._thread: ArrivalThread | None = None
        self.transport: Transport = make_transport(given, values, base_directory, devices)
        self.program: FlightProgram | None = None
        self._has_ended = False
        self._code: int | None = None
        """Exit code of the program."""
        self._missed_s: Callable[[], float] | None = None
        """Time for which the software was looked for, s; None before nobody was found."""
        self.transport.open()
        if isinstance(settings, FlightProcess):
            try:
                self.program = self._start(settings, base_directory, values)
            except BlamedError:
                self.transport.close()
                raise
        self.name = self.program.name if self.program else self.transport.name
        """For who is to blame."""

    def _start(
        self, settings: FlightProcess, base_directory: Path, values: Mapping[str, str]
    ) -> FlightProgram:
        address = self.transport.address
        known = {**values, "address": address, "pty": address}
        program = FlightProgram(
            [substitute(word, known) for word in settings.command],
            base_directory,
            environment={
                name: substitute(text, known) for name, text in settings.environment.items()
            },
            has_pipes=isinstance(self.transport, StdioLink),
            is_patient=self._is_lockstep,
        )
        if program.pipes is not None and isinstance(self.transport, StdioLink):
            self.transport.use(*program.pipes)
        return program

    @property
    def who(self) -> str:
        """Name of the software, with the program's process id."""
        return f"{self.name} (pid {self.program.pid})" if self.program else self.name

    @property
    def is_ready(self) -> bool:
        """Whether the software is there."""
        return self.transport.is_ready

    def arrivals(self) -> list[Arrival]:
        """
        Return what has come by now; never waits.

        Raises:
            BlamedError: The software was not there in time.
        """
        transport = self.transport
        if self._thread is None:
            found = transport.arrivals()
            if self._has_thread and transport.is_ready and transport.fds():
                self._thread = ArrivalThread(transport)
        else:
            transport.push()
            found = []
            for arrival in self._thread.take():
                found += transport.taken(*arrival)
        transport.counts["floods"] += sum(len(one.data) for one in found) >= READ_BYTES
        if not transport.is_ready:
            self._miss()
        return found

    def _miss(self) -> None:
        """Count the time for which nobody is there; before the first look, others may have been set up."""
        if self._missed_s is None:
            self._missed_s = self.stopwatch()
        elif self._missed_s() > self._start_s:
            ended = self.how_it_ended()
            granted = " of its own" if self.program is not None and self._is_lockstep else ""
            raise BlamedError(
                f"{self.who}: expected somebody at {self.transport.name} within {self._start_s:g} s{granted} "
                f"(parameters.flight.interface.start_s), waiting for {self.transport.awaited}"
                f"{f', but it {ended}' if ended else ''}"
            )

    def write(self, packets: Sequence[bytes]) -> bool:
        """
        Send packets; False, and none of them, if too much waits already.

        Raises:
            BlamedError: So it is in lockstep, where nothing that software is told may be left out.
        """
        if self.transport.write(packets):
            return True
        if self._is_lockstep and not self.how_it_ended():
            size_bytes = sum(map(len, packets))
            raise BlamedError(
                f"{self.who}: {self.transport.name} has no room for {size_bytes} bytes in {len(packets)} packets at "
                "once: let it be told less in one step, by shorter messages, slower sensors or a faster rate_hz"
            )
        return False

    def how_it_ended(self) -> str:
        """Return how the software ended, in words; empty while it has not."""
        program = self.program
        if program is not None and (self.transport.is_closed or program.has_exited):
            return program.how_it_ended()
        return "closed its end" if self.transport.is_closed else ""

    def wait(self, timeout_s: float) -> None:
        """Wait until the software says something; or until the time is over."""
        fds = self.transport.fds()
        talk = self.program.talk_fds if self.program else ()
        limit_s = timeout_s if fds else ASK_S
        wait_for((*fds, *talk), min(limit_s, timeout_s if self.is_ready else RETRY_S))

    def stopwatch(self) -> Callable[[], float]:
        """Return what tells the time since now, s: not counting a program's waits for a processor."""
        if self.program is not None:
            return self.program.stopwatch()
        began_s = monotonic()
        return lambda: monotonic() - began_s

    def end(self, *, is_patient: bool = True) -> int | None:
        """
        End the conversation, and the program if there is one; return its exit code. Only the first call does.

        Args:
            is_patient: False kills it at once.
        """
        if self._has_ended:
            return self._code
        self._has_ended = True
        if self._thread is not None:
            self._thread.stop()
            self._thread = None
        self._has_thread = False
        if self.program is not None:
            transport = self.transport
            self._code = self.program.end(
                transport.close_input, transport.arrivals, is_patient=is_patient
            )
            if isinstance(transport, StdioLink):
                transport.release()
        else:
            self.transport.close_input()
        self.transport.close()
        return self._code
