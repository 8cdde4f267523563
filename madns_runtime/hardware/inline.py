"""A device in lockstep: asked in the agent's own process, by simulated time alone, with the same samples each time."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final

from madns_runtime.config import DeviceLaunch
from madns_runtime.errors import BlamedError, MadnsError, PluginError
from madns_runtime.hardware import messages, page
from madns_runtime.hardware.contract import Device, SimulatedDevice
from madns_runtime.hardware.driver_answers import identity_of
from madns_runtime.hardware.fault_actions import DISCONNECTED
from madns_runtime.hardware.intake import Intake, least_stale_age_s, silent_inputs
from madns_runtime.hardware.kind_registry import DeviceProgram
from madns_runtime.hardware.outputs import DeviceOutputs, DueOutput
from madns_runtime.hardware.page import DevicePage
from madns_runtime.hardware.port import DevicePort
from madns_runtime.hardware.records import DeviceRecords
from madns_runtime.hardware.simulated import TimeProgress, next_of
from madns_runtime.hardware.status import StatusAccount, limits_of
from madns_runtime.plugin.code_places import error_text
from madns_runtime.plugin.context import describe_exception

RECORDS_TIMEOUT_S: Final = 10.0
ROUNDING: Final = 1e-9
"""Of a time in periods: 0.3 s are three of 0.1 s."""


class InlineDevice:
    """
    One device of one agent.

    Args:
        launch: The device.
        program: Its kind and parameters.
        records: Its records.
        now_s: Returns the simulated time, s.

    Raises:
        PluginError: Its kind does not follow simulated time, or its driver raised as it was made.
    """

    def __init__(
        self,
        launch: DeviceLaunch,
        program: DeviceProgram,
        records: DeviceRecords,
        *,
        now_s: Callable[[], float],
    ) -> None:
        device = _made(launch, program)
        if not isinstance(device, SimulatedDevice):
            raise PluginError(
                f"{launch.full_name}: a {program.kind.name} does not follow simulated time"
            )
        self.name = launch.name
        self._device = device
        self._records = records
        self._page = DevicePage([each for each in program.channels if each.direction == "in"])
        self._limits = limits_of(launch, program.channels)
        self._account = StatusAccount()
        self._rate_hz = launch.rate_hz
        self._count = 0
        self._progress = TimeProgress(device)
        self._launch = launch
        self._why = ""
        """Words for what its driver raised last, or why it was lost before."""
        self._failure: PluginError | None = None
        """Error of its driver while its agent took no step."""
        self._handed_s = 0.0
        """When agents handed over what is heard next, simulated, s."""
        self._own_end, other_end = messages.make_pair()
        self._intake = Intake(
            program.channels,
            self._page,
            records,
            seed=[launch.seed, *launch.full_name.encode()],
            frozen_s=launch.frozen_s,
            pass_on=self._pass_on,
        )
        self._outputs = DeviceOutputs(launch, program.channels, self._intake.count)
        self._device.may_move, self._device.place = launch.may_move, launch.place
        self._intake.serve(self._device)
        self._now_s = now_s
        self.port = DevicePort(
            launch.name,
            program.channels,
            shared=(self._page, other_end),
            limits=self._limits,
            now_s=now_s,
        )

        self.port.make_room = self._make_room

    def _make_room(self) -> bool:
        self._hear()
        return True

    def open(self) -> None:
        """
        Open it at simulated time 0, or where that is over, in an agent's return to another process, at the present.

        Raises:
            PluginError: The driver raised, or its identity is none.
        """
        now_s = self._handed_s = max(self._now_s(), 0.0)
        try:
            identity = identity_of(self._call("open", self._device.open))
        except PluginError as error:
            self._note_error(str(error))
            raise
        header = self._page.header
        header[page.STATE], header[page.OPENED_S] = page.OPEN, now_s
        self._records.time.set(0.0, 0.0, 1.0)
        self._records.event("opened", now_s, identity=identity)
        self._account.begin(0.0)
        if now_s > 0.0:
            self._pass_over(now_s)

    def _pass_over(self, t_s: float) -> None:
        """Leave out what it had to tell before it was opened: a recording goes on, and does not begin anew."""
        self._count = math.ceil(t_s * self._rate_hz - ROUNDING)
        while (next_s := self._call("next_s", next_of, self._device)) is not None and next_s < t_s:
            self._call("next_s", self._progress.note, next_s)
            sample = self._call("sample_at", self._device.sample_at, max(next_s, 0.0))
            self._intake.count("passed_while_closed", int(sample is not None))

    def advance(self, t_s: float) -> None:
        """
        Take all samples up to simulated time *t_s*, and put out what is due by then; called before the agent's step.

        What is put out at the time of a sample comes first.

        Raises:
            PluginError: The driver gave what is no sample, or lets time stand still; now, or in `follow`.
        """
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure
        try:
            self._advance(t_s)
        except PluginError as error:
            self._note_error(str(error))
            raise

    def _advance(self, t_s: float) -> None:
        self._hear()
        while True:
            next_s = self._call("next_s", next_of, self._device)
            due_s = self._count / self._rate_hz if next_s is None else max(next_s, 0.0)
            output_s = min(self._outputs.next_write_s(), self._outputs.next_point_s())
            if min(due_s, output_s) > t_s:
                break
            if output_s <= due_s:
                self._put_out_due(max(output_s, self._handed_s))
                continue
            self._count += 1
            if next_s is not None:
                self._call("next_s", self._progress.note, next_s)
            sample = self._call("sample_at", self._device.sample_at, due_s)
            if sample is None:
                continue
            if self._intake.faults.is_disconnected:
                self._intake.count("passed_while_closed")
                continue
            handed_s = due_s if sample.handed_s is None else sample.handed_s
            self._intake.take(sample, handed_s, ahead_s=1.0 / self._rate_hz)
        self._intake.tell_held(t_s)
        self._account.observe(self._page.status(self._limits, t_s), t_s)
        self._handed_s = t_s

    def follow(self, t_s: float) -> None:
        """Go on to simulated time *t_s* while its agent takes no step: what it raises is told in the agent's next, if there is one."""
        if self._failure is not None:  # nothing comes any more
            self._account.observe(self._page.status(self._limits, t_s), t_s)
            return
        try:
            self.advance(t_s)
        except PluginError as error:
            self._failure = error

    def owner_gone(self) -> None:
        """Make it safe: the agent that moves it has ended, and what that last said is not carried out."""
        self._hear()
        self._intake.count("writes_lost", self._outputs.clear())
        self._make_safe(max(self._now_s(), 0.0))

    def insert_fault(self, action: str, value: float | None, t_s: float) -> None:
        """
        Put a fault in force, or clear all, at simulated time *t_s*, s: the samples before it are as they were.

        One that is disconnected is made safe, and lost at once: no sample of it is heard, and nothing is put out.

        Raises:
            ConfigurationError: There is no such fault, its value is none, or it would alter nothing.
        """
        before_s = math.nextafter(t_s, -math.inf)
        if before_s > self._handed_s:
            self.follow(before_s)
        self._intake.insert_fault(action, value)
        now_s = t_s
        self._intake.event("fault", now_s, action=action, value=value)
        is_open = self._page.header[page.STATE] == page.OPEN
        if self._intake.faults.is_disconnected and is_open:
            self._make_safe(now_s)
            self._page.header[page.STATE], self._why = page.CLOSED, self._why or DISCONNECTED
            self._records.event("closed", now_s)
        elif not self._intake.faults.is_disconnected and not is_open:
            self._page.header[page.STATE], self._page.header[page.OPENED_S] = page.OPEN, now_s
            self._records.event("opened", now_s)

    def _hear(self) -> None:
        """Take what the agent has handed over since the last time."""
        has_heard = True
        while has_heard:
            has_heard = False
            self.port.flush()  # what found no room goes on where this makes some
            for word, *rest in messages.receive_all(self._own_end):
                has_heard = True
                try:
                    if word == messages.WRITE:
                        self._outputs.take_write(self._launch.owner, *rest, t_s=rest[-1])
                    elif word == messages.PLAY:
                        self._outputs.take_profile(self._launch.owner, *rest, t_s=self._handed_s)
                except (PluginError, TypeError, ValueError) as error:
                    self._intake.count("refused")
                    self._intake.event("refused", self._handed_s, why=str(error))

    def _put_out_due(self, now_s: float) -> None:
        for output in self._outputs.due(now_s, now_s, float):
            if output.point is not None and output.point.is_underrun:
                self._intake.event("underrun", now_s, channel=output.channel.name)
            if self._intake.faults.is_disconnected:
                self._outputs.note_lost(output)
            elif output.value is not None:
                self._put_out(output, now_s)

    def _put_out(self, output: DueOutput, now_s: float) -> None:
        self._page.header[page.MOVED] = 1.0
        values = {output.channel.name: output.value}
        try:
            self._call("write", self._device.write, values, output.due_s)
        except BlamedError as error:
            if not isinstance(error.__cause__, PluginError):
                raise
            self._outputs.note_refused(output)
            why = f"{output.channel.name}: {error_text(error.__cause__)}"
            self._intake.event("refused", now_s, why=why)
            return
        self._records.written(output.channel.name, output.due_s, now_s, output.told)
        if output.point is not None and not output.point.is_underrun:
            self._outputs.note_played(output.point, now_s - output.due_s)

    def close(self) -> dict[str, Any]:
        """Make it safe and close it, and return what the run came to."""
        self._hear()
        # What came behind the last tick is no age of a sample, which nobody asked for since; a disconnection is a loss.
        is_gone = self._page.header[page.STATE] == page.CLOSED
        self._account.observe("lost" if is_gone else self._account.status, self._now_s())
        self._intake.count("writes_left", self._outputs.clear())
        self._make_safe(self._now_s())
        self._tried("close", self._device.close)
        self._intake.close()
        self._own_end.close()
        account = self._account
        return {
            "status": account.status,
            "stale_ratio": account.stale_ratio(),
            "lost": account.times_lost,
            "restarts": 0,
            "unsafe": int(self._page.header[page.MOVED]),
            "least_stale_age_s": least_stale_age_s(self._page, self._limits),
            "silent_inputs": silent_inputs(self.port.channels.values(), self._page),
            "why": self._why,
            **self._intake.summary(),
            **self._outputs.summary(self._page.counts.read()),
            "records": self._records.close(RECORDS_TIMEOUT_S),
        }

    def _make_safe(self, now_s: float) -> None:
        """Make outputs safe if any has moved; what was still to be put out, but for a profile's points, is lost."""
        self._intake.count("writes_lost", self._outputs.clear_writes())
        if self._page.header[page.MOVED] and self._tried("make_safe", self._device.make_safe):
            self._page.header[page.MOVED] = 0.0
            self._records.event("made_safe", now_s)

    def _call(self, method: str, call: Callable[..., Any], *arguments: Any) -> Any:
        """
        Call a method of the driver.

        Raises:
            BlamedError: It raised; the text says where.
        """
        try:
            return call(*arguments)
        except BaseException as error:  # a driver may raise anything
            text = describe_exception(error, f"{type(self._device).__name__}.{method}", call)
            raise BlamedError(f"device {self.name}: {text}") from error

    def _tried(self, method: str, call: Callable[[], object]) -> bool:
        """Call a method at whose fault the rest is to go on all the same; return whether it raised nothing."""
        try:
            self._call(method, call)
        except BlamedError as error:
            self._note_error(str(error))
            return False
        return True

    def _note_error(self, why: str) -> None:
        self._why = why
        self._page.header[page.ERRORS] += 1
        self._records.event("error", self._now_s(), why=why)

    def _pass_on(self, message: list[Any]) -> int:
        if messages.send(self._own_end, message):
            return 0
        self.port.collect()  # nobody else makes room before the tick; what is too much is counted there
        return int(not messages.send(self._own_end, message))


def _made(launch: DeviceLaunch, program: DeviceProgram) -> Device:
    """
    Return the driver.

    Raises:
        BlamedError: It raised; the text says where.
        MadnsError: There is none, or a library that it needs is not installed.
    """
    try:
        return program.make()
    except MadnsError:
        raise
    except BaseException as error:  # a driver may raise anything
        text = describe_exception(error, f"{launch.kind}.__init__")
        raise BlamedError(f"device {launch.name}: {text}") from error
