"""
Flight software in any language: a program that reads and writes JSON lines.

To the vehicle it is flight software like any other. In lockstep a tick waits for its answer; in real
time no tick waits for anything: an answer is taken in the first tick after it has come.

    to the program      {"setup": {...}}
                        {"t_s": 0.1, "readings": {...}, "messages": [...], "results": [...], "refusals": [...]}
    from the program    {"commands": [...], "send": [...], "estimate": {...}, "log": [...]}
"""

from __future__ import annotations

import base64
import dataclasses
import math
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from time import monotonic
from typing import Any

import orjson

from madns_runtime.context import clean_text
from madns_runtime.errors import BlamedError
from madns_runtime.simulations.constellation.flight.answers import carry_out
from madns_runtime.simulations.constellation.flight.api import FlightContext, Readings
from madns_runtime.simulations.constellation.flight.line_process import (
    TALK_LINES_MAX,
    LineProcess,
)
from madns_runtime.simulations.constellation.messages import CommandResult, Delivery, Refusal
from madns_runtime.simulations.constellation.parameters import FlightProcess

LATE_CHECK = "constellation.flight_answers_late"
"""Ticks that were answered later than answer_s, or never, or not sent to a program that was behind."""
UNANSWERED_MAX = 64
"""Ticks under way to the program in real time; further ones are not sent and counted."""
MAIL_MAX = 1024
"""Messages, results, and refusals, that wait for the next tick that is sent; older ones are dropped and counted."""


class ExternalFlight:
    """
    A program that flies a vehicle.

    Args:
        settings: From the scenario.
        base_directory: Folder of the scenario.
        is_lockstep: Whether simulated time waits for the answers.
    """

    def __init__(self, settings: FlightProcess, base_directory: Path, *, is_lockstep: bool) -> None:
        self._settings = settings
        self._base_directory = base_directory
        self._is_lockstep = is_lockstep
        self._asked: deque[tuple[float, float]] = deque()
        """Ticks without an answer: when they were sent, by the computer's clock, and their times."""
        self._messages: deque[dict[str, Any]] = deque(maxlen=MAIL_MAX)
        self._results: deque[dict[str, Any]] = deque(maxlen=MAIL_MAX)
        self._refusals: deque[dict[str, Any]] = deque(maxlen=MAIL_MAX)
        self._answer_s_max = 0.0
        self._listened_s = 0.0
        """When answers were taken last: those to the last tick come when nobody listens any more."""
        self._begun_s = -math.inf
        """When its first answer came: what it had to do before that is no lateness of the ticks asked meanwhile."""
        self._counts = {
            "ticks_sent": 0,
            "ticks_skipped": 0,
            "answers": 0,
            "answers_late": 0,
            "mail_dropped": 0,
        }
        self._has_told_all = False

    def setup(self, context: FlightContext) -> None:
        """
        Start the program and tell it who it is.

        Raises:
            BlamedError: It cannot be started.
        """
        self._context = context
        self._process = LineProcess(self._settings.command, self._base_directory)
        told = {
            "name": context.name,
            "satellite": context.satellite,
            "agents": context.agents,
            "index": context.index,
            "tick_hz": context.tick_hz,
            "duration_s": context.duration_s,
            "epoch_utc": context.epoch_utc,
            "frame": context.frame,
            "input": self._settings.input,
            "first_number": context.first_number,
            "seed": int(context.random.integers(2**31)),
            "settings": dict(context.settings),
        }
        self._process.write(orjson.dumps({"setup": told}))

    def receive(self, message: Delivery) -> None:
        """Keep a message for the next line."""
        self._counts["mail_dropped"] += len(self._messages) == MAIL_MAX
        self._messages.append(dataclasses.asdict(message))

    def command_result(self, result: CommandResult) -> None:
        """Keep a result for the next line."""
        self._counts["mail_dropped"] += len(self._results) == MAIL_MAX
        self._results.append(dataclasses.asdict(result))

    def message_refused(self, refusal: Refusal) -> None:
        """Keep a refusal for the next line."""
        self._counts["mail_dropped"] += len(self._refusals) == MAIL_MAX
        self._refusals.append(dataclasses.asdict(refusal))

    def step(self, t_s: float, readings: Readings) -> None:
        """
        Send a tick's line, and carry out the answers that are there.

        Raises:
            BlamedError: The program is gone, or wrote what is no answer; in lockstep also: it does
                not answer in time.
        """
        try:
            self._take_answers(t_s)
            self._send(t_s, readings)
            if self._is_lockstep:
                self._await_answer(t_s)
        except BlamedError:
            # At once: other agents may tick in this process.
            self._process.end(is_patient=False)
            self._log_talk()
            raise

    def finish(self) -> Mapping[str, Any]:
        """End the program, and return what came of it; in real time what was late is judged."""
        overdue = sum(self._is_late(sent_s, self._listened_s) for sent_s, _ in self._asked)
        code = self._process.end()
        self._log_talk()
        if code != 0:
            self._context.log("warning", f"{self._process.name} ended with exit code {code}")
        counts = self._counts
        summary: dict[str, Any] = {
            **counts,
            "log_lines": self._process.talk_lines,
            "unanswered": len(self._asked),
            "exit_code": code,
        }
        if not self._is_lockstep:  # where no summary depends on a clock
            summary["answer_s_max"] = round(self._answer_s_max, 6)
            late = counts["answers_late"] + counts["ticks_skipped"] + overdue
            check = {"name": LATE_CHECK, "limit": 0, "got": late, "passed": late == 0}
            summary["checks"] = [check]
        return summary

    def _send(self, t_s: float, readings: Readings) -> None:
        counts = self._counts
        tick = {
            "t_s": t_s,
            "readings": {
                name: {"t_s": reading.t_s, "values": reading.values}
                for name, reading in readings.items()
            },
            "messages": list(self._messages),
            "results": list(self._results),
            "refusals": list(self._refusals),
        }
        line = orjson.dumps(tick, _to_plain, orjson.OPT_SERIALIZE_NUMPY)
        if len(self._asked) >= UNANSWERED_MAX or not self._process.write(line):
            counts["ticks_skipped"] += 1
            return
        self._messages.clear()
        self._results.clear()
        self._refusals.clear()
        self._asked.append((monotonic(), t_s))
        counts["ticks_sent"] += 1

    def _take_answers(self, t_s: float) -> None:
        process = self._process
        self._listened_s = monotonic()
        for line in process.lines():
            self._take(line, t_s)
        self._log_talk()
        if process.has_ended:
            how = process.how_it_ended()
            self._log_talk()
            raise BlamedError(f"{process.name} (pid {process.pid}) {how} before {t_s:g} s")

    def _take(self, line: bytes, t_s: float) -> None:
        process, counts = self._process, self._counts
        if not self._asked:
            raise BlamedError(
                f"{process.name}: expected one line for each tick and none for the setup, got another "
                f"one before {t_s:g} s: {clean_text(repr(line[:200]))}"
            )
        sent_s, asked_s = self._asked.popleft()
        now_s = monotonic()
        self._answer_s_max = max(self._answer_s_max, now_s - sent_s)
        if not counts["answers"]:
            self._begun_s = now_s
        counts["answers"] += 1
        counts["answers_late"] += self._is_late(sent_s, now_s)
        carry_out(line, self._context, process.name, t_s=asked_s)

    def _is_late(self, sent_s: float, now_s: float) -> bool:
        return now_s - max(sent_s, self._begun_s) > self._settings.answer_s

    def _await_answer(self, t_s: float) -> None:
        deadline_s = monotonic() + self._settings.answer_s
        while self._asked:
            left_s = deadline_s - monotonic()
            if left_s <= 0.0:
                raise BlamedError(
                    f"{self._process.name} (pid {self._process.pid}): expected the answer to the tick "
                    f"at {t_s:g} s within {self._settings.answer_s:g} s (parameters.flight.answer_s)"
                )
            self._process.wait(left_s)
            self._take_answers(t_s)

    def _log_talk(self) -> None:
        """Log what the program says on its standard error, as far as that is bounded."""
        process = self._process
        for line in process.talk():
            self._context.log("info", f"{process.name}: {line.decode('utf-8', 'replace')}")
        if process.talk_lines > TALK_LINES_MAX and not self._has_told_all:
            self._has_told_all = True
            self._context.log("warning", f"{process.name}: no more of its words are logged")


def _to_plain(value: Any) -> Any:
    """Return what JSON has no form for in one that it has."""
    if isinstance(value, bytes):
        return {"base64": base64.b64encode(value).decode()}
    raise TypeError(type(value).__name__)
