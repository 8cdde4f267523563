"""
Flight software outside the agent's process: a program in any language, or what runs elsewhere already.

To the vehicle it is flight software like any other. In lockstep a tick waits for its answer; in real
time no tick waits for anything: an answer is taken in the first tick after it has come.

    readings, messages, results -> a tick's report -> protocol -> link
    commands, messages, words   <- answers         <- protocol <- link
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from time import monotonic
from typing import Any

from madns_runtime.errors import BlamedError
from madns_runtime.hardware.clock import DeviceClock
from madns_runtime.plugin.api import AgentContext
from madns_runtime.simulations.constellation.flight.api import AnsweredContext, Readings
from madns_runtime.simulations.constellation.flight.asked_ticks import AskedTick, AskedTicks
from madns_runtime.simulations.constellation.flight.held_answers import held_answers, tick_of
from madns_runtime.simulations.constellation.flight.interface.answers import (
    FlightAnswer,
    carry_out,
    shown,
    told_faults,
)
from madns_runtime.simulations.constellation.flight.interface.link import FlightLink
from madns_runtime.simulations.constellation.flight.interface.opening import (
    FlightProtocol,
    make_protocol,
)
from madns_runtime.simulations.constellation.flight.interface.reports import SetupReport, TickReport
from madns_runtime.simulations.constellation.flight_settings import FlightAttached, FlightProcess
from madns_runtime.simulations.constellation.interface_settings import is_played_back
from madns_runtime.simulations.constellation.messages import (
    CommandResult,
    Delivery,
    TransmissionRefusal,
)
from madns_runtime.simulations.constellation.streams import FLIGHT_ANSWERS, FLIGHT_CLOCK

LATE_CHECK = "constellation.flight_answers_late"
"""Ticks that were answered later than answer_s, or never, or not sent to a program that was behind."""
STDERR_TEXT = "flight_stderr"
"""Name of the text that keeps a program's standard error, beside the agent's records."""
UNMEASURED_S = 0.25
"""In lockstep the first part of the wait for an answer is not measured, and does not count."""
MAIL_MAX = 1024
"""Messages, results, and refusals, that wait for the next tick that is sent; older ones are dropped and counted."""
CLOCK_S = 1.0
"""Between two records of its clock, simulated."""
LAST_ANSWERS_S = 3.0
"""In real time, for the answers to the last ticks: of all vehicles of this process together, which end one after the other."""
LOOK_S = 0.02
"""Between two looks for them, at most."""


class ExternalFlight:
    """
    Software that flies a vehicle from outside.

    Args:
        settings: From the scenario.
        agent: The framework as the agent sees it.
    """

    last_answers_s = LAST_ANSWERS_S
    """Rest of that wait, s."""

    def __init__(self, settings: FlightProcess | FlightAttached, agent: AgentContext) -> None:
        self._settings, self._held = settings, held_answers(agent)
        self._agent = agent
        self._is_lockstep = agent.is_lockstep
        interface = settings.interface
        self._has_own_clock = interface is not None and interface.clock == "own"
        self._is_played_back = is_played_back(interface)
        """Whether answers come from a recording, at their times: no tick waits for one."""
        is_simulated = self._is_played_back and agent.is_lockstep
        self._present_s: Callable[[], float] = agent.now_s if is_simulated else monotonic
        self._is_recorded = interface is not None and not agent.is_lockstep
        """Whether what depends on this computer's clock is recorded: nothing is in lockstep."""
        self._mail: dict[str, deque[Any]] = {
            name: deque(maxlen=MAIL_MAX) for name in ("messages", "results", "refusals")
        }
        self._answer_s_max = 0.0
        self._listened_s = 0.0
        """Time at which answers were taken last."""
        names = ("ticks_sent", "ticks_skipped", "answers", "answers_late", "mail_dropped")
        self._counts = dict.fromkeys(names, 0)
        self._answers_unasked = 0
        """Answers to no tick that waits for one."""
        self._clock = DeviceClock()
        self._clock_s = -math.inf
        """Time of its last record."""

    def setup(self, context: AnsweredContext) -> None:
        """
        Start the program, or begin to look for the software, and tell it who it is.

        Raises:
            BlamedError: It cannot be started, or reached.
        """
        self._context = context
        settings, interface = self._settings, self._settings.interface
        folder = self._agent.base_directory
        name = interface.protocol if interface else "json_lines"
        self._protocol: FlightProtocol = make_protocol(name, folder)
        self._link = FlightLink(
            settings,
            folder,
            devices=self._agent.hardware if interface else {},
            values={
                "name": context.name,
                "index": str(context.index),
                "satellite": context.satellite,
            },
            is_lockstep=self._is_lockstep,
        )
        self._asked = AskedTicks(
            settings.answer_s,
            by_time=getattr(self._protocol, "answers_by_time", True),
            may_lose=self._link.transport.may_lose,
        )
        try:
            self._introduce(context)
        except Exception:  # whatever it is, it is raised again
            self.abandon()  # nobody else knows yet that the program runs
            raise

    def _introduce(self, context: AnsweredContext) -> None:
        """Tell the software who it is."""
        settings = self._settings
        if self._is_recorded:
            self._agent.open_stream("flight_answers", FLIGHT_ANSWERS)
            self._agent.open_stream("flight_clock", FLIGHT_CLOCK)
        if settings.interface and settings.interface.transport.kind == "pty":
            context.log("info", f"flight software is expected at {self._link.transport.address}")
        told = SetupReport(
            name=context.name,
            satellite=context.satellite,
            agents=context.agents,
            index=context.index,
            tick_hz=context.tick_hz,
            rate_hz=context.rate_hz,
            duration_s=context.duration_s,
            epoch_utc=context.epoch_utc,
            frame=context.frame,
            input=settings.input,
            first_number=context.first_number,
            seed=int(context.random.integers(2**31)),
            settings=dict(context.settings),
            clock="own" if self._has_own_clock else "stepped",
            is_kept=self._link.transport.keeps_all,
        )
        # One that has ended already is told with its end in the first tick.
        packets = self._protocol.setup(told)
        if not self._link.transport.write(packets) and not self._link.how_it_ended():
            raise BlamedError(
                f"{self._link.name}: its transport has no room for its setup: give fewer settings"
            )

    def receive(self, message: Delivery) -> None:
        """Keep a message for the next tick."""
        self._keep("messages", message)

    def command_result(self, result: CommandResult) -> None:
        """Keep a result for the next tick."""
        self._keep("results", result)

    def message_refused(self, refusal: TransmissionRefusal) -> None:
        """Keep a refusal for the next tick."""
        self._keep("refusals", refusal)

    def step(self, t_s: float, readings: Readings) -> None:
        """
        Send a tick's report, and carry out the answers that are there.

        Raises:
            BlamedError: The software is gone or was never there, or wrote what is no answer; in lockstep
                also: it does not answer in time.
        """
        try:
            for answer, asked_s in self._held.take(t_s) if self._held else ():
                carry_out(answer, self._context, self._link.name, t_s=asked_s)
            self._take_answers(t_s)
            self._send(t_s, readings)
            if self._is_lockstep and not self._is_played_back:
                self._await_answer(t_s)
        except Exception:
            self.abandon()
            raise

    def abandon(self) -> None:
        """End the program at once, as other agents may tick in this process, and keep what it said."""
        self._link.end(is_patient=False)
        self._keep_talk()

    def finish(self) -> Mapping[str, Any]:
        """End the program, and return what came of it; in real time what was late is judged."""
        counts = self._counts
        if not self._is_lockstep:
            self._await_last()
        # Of one that has answered nothing nobody knows whether it works at all: all is overdue.
        overdue = self._asked.count_overdue(self._listened_s if counts["answers"] else math.inf)
        code = self._link.end()
        self._keep_talk()
        if code:
            told = f"{self._link.name} ended with exit code {code}{self._last_words()}"
            self._context.log("warning", told)
        summary: dict[str, Any] = {**counts, "mail_unsent": sum(map(len, self._mail.values()))}
        if self._link.program is not None:
            lines, size_bytes = self._link.program.talk_counts
            summary |= {"stderr_lines": lines, "stderr_bytes": size_bytes, "exit_code": code}
        summary["unanswered"] = len(self._asked)
        if self._settings.interface is not None:
            summary["interface"] = self._interface_summary()
        if not self._is_lockstep:  # where no summary depends on a clock
            summary["answer_s_max"] = round(self._answer_s_max, 6)
            late = counts["answers_late"] + counts["ticks_skipped"] + overdue
            late += self._asked.unanswered
            summary["checks"] = [{"name": LATE_CHECK, "limit": 0, "got": late, "passed": late == 0}]
        return summary

    def _await_last(self) -> None:
        """Count the answers to the last ticks; there is no tick any more in which they could be carried out."""
        began_s = monotonic()
        oldest_s = self._asked.oldest.sent_s if self._asked else math.inf
        is_owed = not self._asked.is_late(oldest_s, self._present_s())  # the overdue had their time
        wait_s = min(self._settings.answer_s, ExternalFlight.last_answers_s) if is_owed else 0.0
        try:
            self._account_for_last()
            while self._asked and monotonic() - began_s < wait_s and not self._link.how_it_ended():
                self._link.wait(LOOK_S)
                self._account_for_last()
        except BlamedError as error:
            if not self._link.how_it_ended():  # whoever is gone answers no more
                self._context.log("error", f"the last answers: {error}")
        ExternalFlight.last_answers_s -= monotonic() - began_s

    def _account_for_last(self) -> None:
        self._listened_s = self._present_s()
        for arrival in self._link.arrivals():
            for answer in self._protocol.feed(arrival.data):
                came_s = self._present_s() if self._is_lockstep else arrival.came_s
                asked = None if self._has_own_clock else self._find_asked(answer, came_s, math.inf)
                if asked is not None:
                    self._count_answer(asked, came_s)

    def _interface_summary(self) -> dict[str, Any]:
        transport = self._link.transport
        summary: dict[str, Any] = {
            "transport": transport.name,
            "ticks_unanswered": self._asked.unanswered,
            "answers_unasked": self._answers_unasked,
            "faults": dict(getattr(self._protocol, "faults", {})),
        }
        # Traffic depends on clocks, which nothing in lockstep does; what was lost is told all the same.
        lost = ("packets_", "peers_", "bytes_dropped")
        summary |= {name: n for name, n in transport.counts.items() if n and name.startswith(lost)}
        if not self._is_lockstep:
            summary |= transport.counts
            if (estimate := self._clock.estimate()) is not None:
                summary |= {
                    "clock_offset_s": round(estimate.offset_s, 9),
                    "clock_drift_ppm": round(estimate.drift_ppm, 3),
                }
        return summary

    def _keep(self, name: str, item: Delivery | CommandResult | TransmissionRefusal) -> None:
        self._counts["mail_dropped"] += len(self._mail[name]) == MAIL_MAX
        self._mail[name].append(item)

    def _send(self, t_s: float, readings: Readings) -> None:
        counts = self._counts
        if self._asked.is_full(t_s):
            if not counts["ticks_skipped"]:
                since = f"the tick at {self._asked.oldest.t_s:g} s"
                one = f" but one every {self._settings.answer_s:g} s"
                rest = one if self._link.transport.may_lose else ""
                self._context.log(
                    "warning",
                    f"{self._link.who} has answered nothing since {since}: no further ones are sent"
                    f"{rest}{self._last_words()}",
                )
            counts["ticks_skipped"] += 1
            return
        mail = {name: list(waiting) for name, waiting in self._mail.items()}
        sent_s = self._present_s()
        packets = self._protocol.tick(TickReport(t_s=t_s, readings=readings, **mail))
        is_sent = self._link.write(packets)
        counts["ticks_sent" if is_sent else "ticks_skipped"] += 1
        if is_sent or not self._link.transport.may_take(packets):  # for which there is never room
            counts["mail_dropped"] += (not is_sent) * sum(map(len, mail.values()))
            for waiting in self._mail.values():
                waiting.clear()
        if is_sent and not self._has_own_clock:
            self._asked.add(sent_s, t_s)

    def _take_answers(self, t_s: float) -> None:
        link = self._link
        self._listened_s = self._present_s()
        for arrival in link.arrivals():
            for answer in self._protocol.feed(arrival.data):
                came_s = self._present_s() if self._is_lockstep else arrival.came_s
                self._take(answer, came_s, t_s)
        self._keep_talk()
        if how := link.how_it_ended():
            self._keep_talk()
            raise BlamedError(f"{link.who} {how} before {t_s:g} s{self._last_words()}")
        if self._is_recorded:
            self._record_clock(t_s)

    def _take(self, answer: FlightAnswer, came_s: float, t_s: float) -> None:
        counts, asked = self._counts, None
        if not self._has_own_clock:
            asked = self._find_asked(answer, came_s, t_s)
            if asked is None:
                self._answers_unasked += 1
                if answer.t_s is not None:  # a second one to its tick, or after that was given up
                    return
            else:
                self._count_answer(asked, came_s)
        else:
            counts["answers"] += 1
        if answer.board_us and self._is_recorded:
            self._clock.add(answer.board_us * 1e-6, self._agent.now_s() - (monotonic() - came_s))
        if self._held and asked and not self._is_played_back:
            self._held.hold(answer, asked.t_s)
        else:
            carry_out(answer, self._context, self._link.name, t_s=asked.t_s if asked else None)

    def _find_asked(self, answer: FlightAnswer, came_s: float, t_s: float) -> AskedTick | None:
        """Return the tick that an answer is for, and forget it and those before; None for one to nothing."""
        asked = self._asked.find(answer, came_s)
        if asked is None and self._asked.must_be_asked(answer):
            if answer.fault:  # such as noise without an end
                raise BlamedError(f"{self._link.name}: {answer.fault}")
            raise BlamedError(
                f"{self._link.name}: expected one line for each tick and none for the setup, got another "
                f"one before {t_s:g} s: {shown(answer.source)}"
            )
        return asked

    def _count_answer(self, asked: AskedTick, came_s: float) -> None:
        sent_s, counts = asked.sent_s, self._counts
        self._answer_s_max = max(self._answer_s_max, came_s - sent_s)
        if not counts["answers"]:
            self._asked.begun_s = came_s
        counts["answers"] += 1
        counts["answers_late"] += self._asked.is_late(sent_s, came_s)
        if self._is_recorded:
            self._record_answer(asked, came_s)

    def _record_answer(self, asked: AskedTick, came_s: float) -> None:
        tick = tick_of(asked.t_s, self._context.tick_hz)
        row = (tick, asked.t_s, round((came_s - asked.sent_s) * 1e6, 1))
        self._agent.record("flight_answers", row)

    def _record_clock(self, t_s: float) -> None:
        if t_s - self._clock_s < CLOCK_S:
            return
        if (estimate := self._clock.estimate()) is not None:
            self._clock_s = t_s
            row = (t_s, round(estimate.offset_s, 9), round(estimate.drift_ppm, 3))
            self._agent.record("flight_clock", row)

    def _await_answer(self, t_s: float) -> None:
        limit_s = self._settings.answer_s
        unmeasured_s, clock = monotonic() + min(UNMEASURED_S, limit_s), None
        while self._asked:
            if not self._link.is_ready:  # it has its own time to come
                unmeasured_s, clock = monotonic() + min(UNMEASURED_S, limit_s), None
            elif clock is None and monotonic() >= unmeasured_s:
                clock = self._link.stopwatch()
            elif clock is not None and clock() >= limit_s:
                raise BlamedError(
                    f"{self._link.who}: expected the answer to the tick "
                    f"at {t_s:g} s within {self._settings.answer_s:g} s (parameters.flight.answer_s)"
                    f"{self._last_words()}"
                )
            self._link.wait(min(limit_s, UNMEASURED_S))
            self._take_answers(t_s)

    def _keep_talk(self) -> None:
        """Keep what the program says on its standard error; in a file of its own, for no run depends on it."""
        if self._link.program and (said := self._link.program.talk()):
            self._agent.keep_text(STDERR_TEXT, said)

    def _last_words(self) -> str:
        """Return how much it said that was no packet, the last line of its standard error, and the file that holds it all."""
        line = self._link.program.last_line if self._link.program else ""
        file = f"agents/{self._context.name}/{STDERR_TEXT}.txt"
        words = f"; its last words: {line!r} ({file})" if line else ""
        rest = getattr(self._protocol, "rest", b"")
        cut = f"; it wrote {shown(rest)} {getattr(self._protocol, 'unended', '')}" if rest else ""
        return told_faults(getattr(self._protocol, "faults", {})) + cut + words
