"""One device in its process's loop: opened, read, written, watched, made safe, closed, and opened anew."""

from __future__ import annotations

import math
import socket
from collections.abc import Callable, Mapping
from functools import partial
from time import monotonic
from typing import Any, Final

from madns_runtime.errors import MachineError, MadnsError, PluginError
from madns_runtime.hardware import driver_answers, messages, page, simulated
from madns_runtime.hardware.contract import Device, SimulatedDevice
from madns_runtime.hardware.descriptor import DriverDescriptor
from madns_runtime.hardware.fault_orders import CarriedOutEnds
from madns_runtime.hardware.intake import Intake
from madns_runtime.hardware.outbox import UserOutbox
from madns_runtime.hardware.outputs import DeviceOutputs, DueOutput
from madns_runtime.hardware.process_resources import has_descriptors, leak_of, resident_bytes
from madns_runtime.hardware.records import DeviceRecords
from madns_runtime.hardware.seat import DeviceSeat
from madns_runtime.hardware.status import LOST_PERIODS, back_off_s, limits_of, sample_period_s
from madns_runtime.plugin.code_places import error_text
from madns_runtime.reactor.reactor import Reactor

BURST_MAX: Final = 256
"""Samples taken in a row from a device that has them ready; then others get their turn."""
STATE_PERIOD_S: Final = 1.0


class DeviceRunner:
    """
    Drives one device.

    Args:
        seat: The device, and what it shares.
        records: Its streams.
        reactor: The loop of its process.
    """

    def __init__(self, seat: DeviceSeat, records: DeviceRecords, reactor: Reactor) -> None:
        self._seat = seat
        self._launch = launch = seat.launch
        self._header = seat.page.header
        self._records = records
        self._reactor = reactor
        self._intake = Intake(
            seat.channels,
            seat.page,
            records,
            seed=[launch.seed, *launch.full_name.encode()],
            frozen_s=launch.frozen_s,
            pass_on=UserOutbox(seat.users, reactor, seat.page.counts).send,
            handed_s=lambda taken_up_s: monotonic(),
        )
        self._outputs = DeviceOutputs(launch, seat.channels, self._intake.count)
        self._ends = CarriedOutEnds()
        self.tell_error: Callable[[str], object] = lambda text: None
        """Told what the driver raised, before the device is closed for it."""
        self.tell_fault: Callable[[str, float | None], object] = lambda action, value: None
        """Told of an inserted fault that came from an agent, before the device is closed for it."""
        self._device: Device | None = None
        self._descriptor: DriverDescriptor | None = None
        self._failures = self._late_us_max = 0
        self._is_ending = self._is_own = False
        self.gave_up = ""
        """Why its process has to be started anew; empty if it has not."""
        self._first_bytes = 0
        """Memory of this process when the device was opened first; 0 before."""
        self._period_s = 1.0 / launch.rate_hz
        self._hang_s = limits_of(launch, seat.channels).hang_s
        sample_s = sample_period_s(launch.rate_hz, seat.channels)
        self._silent_s = max(self._hang_s, LOST_PERIODS * sample_s)
        self._due_s = math.inf
        self._next_s: float | None = None  # of a device that follows simulated time
        # Infinite is never: each timer is made once and moved.
        self._read_timer = reactor.call_at(math.inf, self._read_due)
        self._open_timer = reactor.call_at(math.inf, self.open)
        self._write_timer = reactor.call_at(math.inf, self._write_due)
        self._held_timer = reactor.call_at(math.inf, self._held_due)
        self._state_timer = reactor.call_at(monotonic() + STATE_PERIOD_S, self._tell_state)
        self._alive_timer = reactor.call_at(0.0, self._tell_alive)
        self._take_time()  # one that is started anew in mid-run
        for agent, end in seat.users.items():
            reactor.add_reader(end.fileno(), partial(self._hear, agent, end))

    # Opening and closing ------------------------------------------------------------------------

    def open(self) -> None:
        """Open the device; if that fails, again after a while."""
        if self._is_ending or self._device is not None or self._intake.faults.is_disconnected:
            return
        header = self._header
        header[page.ACTIVE_S] = monotonic()
        method, self._is_own = "__init__", False
        try:
            self._device = device = self._seat.make()
            method = "open"
            device.may_move, device.place = self._launch.may_move, self._launch.place
            self._intake.serve(device)
            identity = driver_answers.identity_of(device.open())
            self._reactor.end_if_forked()
            self._seat.check_identity(identity)
            self._is_own = True
            passed = simulated.pass_over(device, self._records.time, header)
            self._intake.count("passed_while_closed", passed)
            method = "fileno"
            if (fd := driver_answers.descriptor_of(device.fileno())) is not None:
                intake, readable = self._intake, self._readable
                self._descriptor = DriverDescriptor(fd, self._reactor, readable, intake.event)
        except BaseException as error:  # noqa: BLE001 - a driver may raise anything
            self._fail(method, error)
            return
        header[page.OPENED_S] = header[page.ACTIVE_S] = now_s = monotonic()
        header[page.STATE] = page.OPEN
        self._records.event("opened", now_s, identity=identity)
        self._first_bytes = self._first_bytes or resident_bytes()
        if header[page.MOVED]:
            self._make_safe(device)  # what an earlier process, or a failed attempt, has left
        if self._descriptor is None:
            self._due_s = now_s
            self._read_timer.reschedule(now_s)

    def _fail(self, method: str, error: BaseException) -> None:
        """Note what a driver raised, close the device, and open it anew after a while."""
        name = type(self._device).__name__ if self._device is not None else self._launch.kind
        self._blame(name, method, error, self._device)
        self._failures += 1
        self._close_device()
        if not has_descriptors():
            self._give_up(f"{name} leaks descriptors: none is left, so it gets a process anew")
        elif not self._is_ending:
            self._open_timer.reschedule(monotonic() + back_off_s(self._failures))

    def _give_up(self, why: str) -> None:
        """End this process, which the driver has used up."""
        self.gave_up = why
        self._intake.event("error", monotonic(), why=why)
        self._reactor.stop()

    def _check_memory(self) -> None:
        if not self.gave_up and (leak := leak_of(self._first_bytes)):
            self._give_up(f"{type(self._device).__name__} {leak}, so it gets a process anew")

    def _blame(self, driver: str, method: str, error: BaseException, device: Any) -> None:
        """Record, count and tell what a driver's method raised; but what follows a fault is not told over that."""
        self._reactor.end_if_forked()  # by sys.exit, say: whoever forked it goes on
        called = getattr(device, method, None)
        text = driver_answers.describe_fault(error, f"{driver}.{method}", called)
        self._intake.event("error", monotonic(), why=text)
        self._header[page.ERRORS] += 1
        if not (self._failures and method in ("close", "make_safe")):
            self.tell_error(text)

    def _close_device(self) -> None:
        """Make the device safe and close it, whatever either raises."""
        device, self._device = self._device, None
        if device is None:  # it could not even be made, or is closed already
            self._header[page.STATE] = page.CLOSED
            return
        self._read_timer.reschedule(math.inf)
        if self._descriptor is not None:
            self._descriptor.close()
            self._descriptor = None
        self._make_safe(device)
        try:
            device.close()
        except BaseException as error:  # noqa: BLE001 - a driver may raise anything
            self._blame(type(device).__name__, "close", error, device)
        self._header[page.STATE] = page.CLOSED
        self._records.event("closed", monotonic())

    def _make_safe(self, device: Device) -> bool:
        """Bring outputs into their safe state, where they may move at all; return whether they are."""
        if not (self._outputs and self._launch.may_move and self._is_own):
            return True  # nothing has moved, and what is in its place is not to be touched
        self._intake.count("writes_lost", self._outputs.clear_writes())
        self._schedule_write()
        try:
            device.make_safe()
        except BaseException as error:  # noqa: BLE001 - a driver may raise anything
            self._blame(type(device).__name__, "make_safe", error, device)
            return False
        self._reactor.end_if_forked()
        self._header[page.MOVED] = 0.0
        self._header[page.SAFE_COUNT] += 1
        self._records.event("made_safe", monotonic())
        return True

    def end(self, reason: str, timeout_s: float) -> Mapping[str, Any]:
        """Make safe, close, and return what the run came to: counts, and the account of records."""
        self._is_ending = True
        for agent, its_end in self._seat.users.items():
            self._hear(agent, its_end)  # what they last said is not carried out, but counted
        self._records.event("ending", monotonic(), why=reason)
        self._intake.count("writes_left", self._outputs.clear())
        self._close_device()
        self._intake.close()
        if not self._header[page.MOVED]:  # else the guardian tries what the driver could not
            self._header[page.STATE] = page.SAFE
        told = {**self._intake.summary(), **self._outputs.summary(self._seat.page.counts.read())}
        return {**told, "records": self._records.close(timeout_s)}

    # Reading ------------------------------------------------------------------------------------

    def _read_due(self) -> None:
        now_s = monotonic()
        if self._descriptor is not None:
            self._readable()
            return
        self._late_us_max = max(self._late_us_max, int((now_s - self._due_s) * 1e6))
        if not self._read():
            return
        if self._next_s is not None:
            self._due_s = monotonic() + simulated.pause_s(self._records.time, self._next_s)
            self._read_timer.reschedule(self._due_s)
            return
        # The next whole period, so that a slow read does not shift those after it.
        passed = math.floor((monotonic() - self._due_s) / self._period_s)
        self._intake.count("reads_skipped", max(0, passed))
        self._due_s += (max(0, passed) + 1) * self._period_s
        self._read_timer.reschedule(self._due_s)

    def _readable(self) -> None:
        for number in range(BURST_MAX):
            before = self._header[page.SAMPLES]
            if not self._read():
                return
            if self._header[page.SAMPLES] == before:
                if self._descriptor is not None:
                    self._descriptor.note_read(has_samples=number > 0)
                return
        self._read_timer.reschedule(monotonic())  # more is ready, and others get their turn first

    def _read(self) -> bool:
        """Take one sample; return whether the device is still open."""
        device = self._device
        if device is None:
            return False
        self._header[page.ACTIVE_S] = monotonic()
        try:
            if isinstance(device, SimulatedDevice):
                time = self._records.time
                for given in simulated.samples_by_now(device, time, self._header, BURST_MAX):
                    self._take(given)
                self._next_s = simulated.next_of(device)
            elif (sample := device.read()) is not None:
                self._take(sample)
        except BaseException as error:  # noqa: BLE001 - a driver may raise anything
            self._fail("read", error)
            return False
        return True

    def _take(self, sample: Any) -> None:
        self._reactor.end_if_forked()  # a driver's copy gives none
        self._intake.take(sample, monotonic(), ahead_s=self._period_s)
        self._failures = 0
        if (due_s := self._intake.faults.next_due_s()) != math.inf:
            self._held_timer.reschedule(due_s)

    def _held_due(self) -> None:
        self._intake.tell_held(monotonic())
        self._held_timer.reschedule(self._intake.faults.next_due_s())

    # Writing ------------------------------------------------------------------------------------

    def _hear(self, agent: str, end: socket.socket) -> None:
        for word, *rest in messages.receive_all(end):
            try:
                if word in (messages.WRITE, messages.PLAY):
                    self._take_output(agent, word, *rest)
                elif word == messages.TIME:
                    self._take_time()
                elif word == messages.FAULT:
                    self._take_fault(end, *rest)
            except (PluginError, TypeError, ValueError) as error:
                self._refuse(f"{agent}: {error}")

    def _take_time(self) -> None:
        if (told := self._seat.page.time.read()) is not None:
            self._records.set_time(*told)
            self._schedule_write()
            if self._next_s is not None:
                self._read_timer.reschedule(monotonic())

    def _take_output(self, agent: str, word: str, *rest: Any) -> None:
        """Let a value, or points of a profile, wait until they are due."""
        time = self._records.time
        if word == messages.PLAY:
            self._outputs.take_profile(agent, *rest, t_s=time.at(monotonic()))
        else:
            self._outputs.take_write(agent, *rest, t_s=time.at(rest[-1]))
        self._schedule_write()

    def _schedule_write(self) -> None:
        """Have what is due next put out; without the time of the run no point is, nor anything behind its end."""
        time = self._records.time
        self._write_timer.reschedule(max(0.0, self._outputs.next_s(time.local_s, time.end_s)))

    def _write_due(self) -> None:
        now_s, time = monotonic(), self._records.time
        t_s, before_end_s = time.at(now_s), math.nextafter(time.end_s, -math.inf)
        for output in self._outputs.due(now_s, min(t_s, before_end_s), time.local_s):
            if output.point is not None and output.point.is_underrun:
                self._intake.event("underrun", monotonic(), channel=output.channel.name)
            if self._device is None:
                self._outputs.note_lost(output)  # what is due meanwhile is not put out late
            elif output.value is not None and not self._put_out(self._device, output):
                break
        if t_s >= time.end_s:
            self._intake.count("writes_left", self._outputs.clear())
        self._schedule_write()

    def _put_out(self, device: Device, output: DueOutput) -> bool:
        """Put out one value; return whether the device is still open."""
        name = output.channel.name
        self._header[page.ACTIVE_S] = monotonic()
        self._header[page.MOVED] = 1.0
        try:
            device.write({name: output.value}, output.due_s)
        except PluginError as error:
            self._refuse(f"{name}: {error_text(error)}", output)
            return True
        except BaseException as error:  # noqa: BLE001 - a driver may raise anything
            self._outputs.note_lost(output)
            self._fail("write", error)
            return False
        self._reactor.end_if_forked()
        done_s = monotonic()
        self._records.written(name, output.due_s, done_s, output.told)
        if output.point is not None and not output.point.is_underrun:
            self._outputs.note_played(output.point, done_s - output.due_s)
        return True

    def owner_gone(self) -> None:
        """Make outputs safe: the agent that moves them has ended, and what it last said is not carried out."""
        if (end := self._seat.users.get(self._launch.owner)) is not None:
            self._hear(self._launch.owner, end)
        self._intake.count("writes_lost", self._outputs.clear())
        if self._device is not None:
            self._make_safe(self._device)

    # Faults, state ------------------------------------------------------------------------------

    def _take_fault(
        self, end: socket.socket, number: int, action: str, value: float | None
    ) -> None:
        """Put a fault in force that an agent orders for the host, or end it, once, and answer."""
        is_repeated = self._ends.is_repeated(number)
        refusal = "" if is_repeated else self.insert_fault(action, value, is_known=False)
        messages.send(end, [messages.ANSWER, number, refusal])

    def insert_fault(self, action: str, value: float | None, *, is_known: bool = True) -> str:
        """Put a fault in force, or clear all, and return why not, else ""; the supervisor is told one that it does not know."""
        try:
            self._intake.insert_fault(action, value)
        except MadnsError as error:
            self._refuse(str(error))
            return str(error)
        if not is_known:
            self.tell_fault(action, value)
        self._records.event("fault", monotonic(), action=action, value=value)
        self._held_timer.reschedule(self._intake.faults.next_due_s())
        if self._intake.faults.is_disconnected:
            self._close_device()
        elif self._device is None:
            self._open_timer.reschedule(monotonic())
        return ""

    def _tell_state(self) -> None:
        now_s, header = monotonic(), self._header
        details: Mapping[str, Any] = {}
        heard_s = max(header[page.ARRIVED_S], header[page.OPENED_S], self._intake.withheld_s)
        waits = simulated.is_waited_for(self._records.time, self._next_s)
        if self._device is not None and not waits and now_s - heard_s > self._silent_s:
            self._fail("read", MachineError(f"no sample within {self._silent_s:g} s"))
        if self._device is not None:
            try:
                details = driver_answers.details_of(self._device.health())
            except BaseException as error:  # noqa: BLE001 - a driver may raise anything
                self._fail("health", error)
        counts = int(self._header[page.SAMPLES]), int(self._header[page.ERRORS])
        if refusal := self._records.state(now_s, counts, self._late_us_max, details):
            self._refuse(f"health: {refusal}")
        self._late_us_max = 0
        self._check_memory()
        if (estimate := self._intake.clock.estimate()) is not None:
            self._records.clock(now_s, estimate.offset_s, estimate.drift_ppm)
        self._state_timer.reschedule(now_s + STATE_PERIOD_S)

    def _tell_alive(self) -> None:
        """Note that the loop turns, also while the device is closed: who hangs does not come here."""
        self._header[page.ACTIVE_S] = now_s = monotonic()
        self._alive_timer.reschedule(now_s + self._hang_s / 4)

    def _refuse(self, why: str, output: DueOutput | None = None) -> None:
        self._reactor.end_if_forked()
        self._outputs.note_refused(output)
        self._intake.event("refused", monotonic(), why=why)
