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
from collections.abc import Callable, Mapping
from pathlib import Path
from time import monotonic
from typing import Any

import orjson

from madns_runtime.errors import BlamedError
from madns_runtime.plugin.context import clean_text
from madns_runtime.simulations.constellation.flight.api import FlightContext, Readings
from madns_runtime.simulations.constellation.flight.json_protocol import carry_out
from madns_runtime.simulations.constellation.flight.line_process import LineProcess
from madns_runtime.simulations.constellation.messages import (
    CommandResult,
    Delivery,
    TransmissionRefusal,
)
from madns_runtime.simulations.constellation.parameters import FlightProcess

LATE_CHECK = "constellation.flight_answers_late"
"""Ticks that were answered later than answer_s, or never, or not sent to a program that was behind."""
STDERR_TEXT = "flight_stderr"
"""Name of the text that keeps a program's standard error, beside the agent's records."""
UNMEASURED_S = 0.25
"""In lockstep the first part of the wait for an answer is not measured, and does not count."""
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
        keep_text: Keeps what the program writes to its standard error, under a name.
    """

    def __init__(
        self,
        settings: FlightProcess,
        base_directory: Path,
        *,
        is_lockstep: bool,
        keep_text: Callable[[str, bytes], None],
    ) -> None:
        self._keep_text = keep_text
        self._settings = settings
        self._base_directory = base_directory
        self._is_lockstep = is_lockstep
        self._asked: deque[tuple[float, float]] = deque()
        """Ticks without an answer: when they were sent, by the computer's clock, and their times."""
        self._mail: dict[str, deque[dict[str, Any]]] = {
            name: deque(maxlen=MAIL_MAX) for name in ("messages", "results", "refusals")
        }
        self._answer_s_max = 0.0
        self._listened_s = 0.0
        """Time at which answers were taken last: those to the last tick come when nobody listens any more."""
        self._begun_s = -math.inf
        """Time of its first answer: what it had to do before that is no lateness of the ticks asked meanwhile."""
        self._counts = {
            "ticks_sent": 0,
            "ticks_skipped": 0,
            "answers": 0,
            "answers_late": 0,
            "mail_dropped": 0,
        }

    def setup(self, context: FlightContext) -> None:
        """
        Start the program and tell it who it is.

        Raises:
            BlamedError: It cannot be started.
        """
        self._context = context
        self._process = LineProcess(
            self._settings.command, self._base_directory, is_patient=self._is_lockstep
        )
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
        self._keep("messages", message)

    def command_result(self, result: CommandResult) -> None:
        """Keep a result for the next line."""
        self._keep("results", result)

    def message_refused(self, refusal: TransmissionRefusal) -> None:
        """Keep a refusal for the next line."""
        self._keep("refusals", refusal)

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
            self._keep_talk()
            raise

    def finish(self) -> Mapping[str, Any]:
        """End the program, and return what came of it; in real time what was late is judged."""
        overdue = sum(self._is_late(sent_s, self._listened_s) for sent_s, _ in self._asked)
        code = self._process.end()
        self._keep_talk()
        if code != 0:
            told = f"{self._process.name} ended with exit code {code}{self._last_words()}"
            self._context.log("warning", told)
        counts = self._counts
        lines, size_bytes = self._process.talk_counts
        summary: dict[str, Any] = {
            **counts,
            "stderr_lines": lines,
            "stderr_bytes": size_bytes,
            "unanswered": len(self._asked),
            "exit_code": code,
        }
        if not self._is_lockstep:  # where no summary depends on a clock
            summary["answer_s_max"] = round(self._answer_s_max, 6)
            late = counts["answers_late"] + counts["ticks_skipped"] + overdue
            summary["checks"] = [{"name": LATE_CHECK, "limit": 0, "got": late, "passed": late == 0}]
        return summary

    def _keep(self, name: str, item: Delivery | CommandResult | TransmissionRefusal) -> None:
        self._counts["mail_dropped"] += len(self._mail[name]) == MAIL_MAX
        self._mail[name].append(dataclasses.asdict(item))

    def _send(self, t_s: float, readings: Readings) -> None:
        counts = self._counts
        tick = {
            "t_s": t_s,
            "readings": {
                name: {"t_s": reading.t_s, "values": reading.values}
                for name, reading in readings.items()
            },
            **{name: list(waiting) for name, waiting in self._mail.items()},
        }
        line = orjson.dumps(tick, _to_plain, orjson.OPT_SERIALIZE_NUMPY)
        if len(self._asked) >= UNANSWERED_MAX or not self._process.write(line):
            counts["ticks_skipped"] += 1
            return
        for waiting in self._mail.values():
            waiting.clear()
        self._asked.append((monotonic(), t_s))
        counts["ticks_sent"] += 1

    def _take_answers(self, t_s: float) -> None:
        process = self._process
        self._listened_s = monotonic()
        for line in process.lines():
            self._take(line, t_s)
        self._keep_talk()
        if process.has_ended:
            how = process.how_it_ended()
            self._keep_talk()
            told = f"{process.name} (pid {process.pid}) {how} before {t_s:g} s{self._last_words()}"
            raise BlamedError(told)

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
        limit_s = self._settings.answer_s
        unmeasured_s, clock = monotonic() + min(UNMEASURED_S, limit_s), None
        while self._asked:
            if clock is None and monotonic() >= unmeasured_s:
                clock = self._process.stopwatch()
            elif clock is not None and clock() >= limit_s:
                raise BlamedError(
                    f"{self._process.name} (pid {self._process.pid}): expected the answer to the tick "
                    f"at {t_s:g} s within {self._settings.answer_s:g} s (parameters.flight.answer_s)"
                    f"{self._last_words()}"
                )
            self._process.wait(min(limit_s, UNMEASURED_S))
            self._take_answers(t_s)

    def _keep_talk(self) -> None:
        """Keep what the program says on its standard error; in a file of its own, for no run depends on it."""
        said = self._process.talk()
        if said:
            self._keep_text(STDERR_TEXT, said)

    def _last_words(self) -> str:
        """Return the last line of its standard error, and where all of it lies; nothing if it said nothing."""
        line = self._process.last_line
        where = f"agents/{self._context.name}/{STDERR_TEXT}.txt"
        return f"; its last words: {line!r} ({where})" if line else ""


def _to_plain(value: Any) -> Any:
    """Return what JSON has no form for in one that it has."""
    if isinstance(value, bytes):
        return {"base64": base64.b64encode(value).decode()}
    raise TypeError(type(value).__name__)
