"""
Somebody else's flight computer: MicroPython on a micro:bit, programmed and asked over its serial line.

A protocol of one's own (docs/flight-software.md): it waits for MicroPython's raw REPL, hands it the program below, and
then sends one line per tick with the gyro's rates. The program answers with the torque that brakes them.
"""

from __future__ import annotations

from madns_runtime.simulations.constellation.flight.interface.answers import (
    CommandRequest,
    FlightAnswer,
)
from madns_runtime.simulations.constellation.flight.interface.reports import SetupReport, TickReport

PROGRAM = b"""
while True:
    words = input().split()
    if len(words) == 4:
        torque = ["%.9f" % (-0.02 * float(word)) for word in words[1:]]
        print("!" + words[0], *torque)
"""
BREAK_AND_ASK = b"\r\x03\x03\x01"
"""Ends whatever runs, twice, and asks for the raw REPL."""
PROMPT = b"raw REPL; CTRL-B to exit\r\n>"
RUN = b"\x04"
LINE_BYTES_MAX = 4096
LEAD_S, DURATION_S = 1.0, 0.5


class Microbit:
    """One line of text per tick, each way."""

    def __init__(self) -> None:
        self.faults = {"other_text": 0}
        self._rest = b""
        self._is_programmed = False
        self._has_prompt = False

    def setup(self, setup: SetupReport) -> list[bytes]:
        """Return what asks for the raw REPL."""
        return [BREAK_AND_ASK]

    def tick(self, tick: TickReport) -> list[bytes]:
        """Return the program once the prompt is there, then a line with the rates; before, ask again."""
        if not self._has_prompt:
            return [BREAK_AND_ASK]
        if not self._is_programmed:
            self._is_programmed = True
            return [PROGRAM + RUN]
        gyro = tick.readings.get("gyro")
        if gyro is None:
            return []
        rates = " ".join(f"{rate:.6f}" for rate in gyro.values)
        return [f"{tick.t_s:.3f} {rates}\r".encode()]

    def feed(self, data: bytes) -> list[FlightAnswer]:
        """Return the answers among the lines that came."""
        self._rest = (self._rest + data)[-LINE_BYTES_MAX:]
        if not self._has_prompt:
            if PROMPT in self._rest:
                self._has_prompt, self._rest = True, b""
            return []
        *lines, self._rest = self._rest.split(b"\n")
        found = [self._answer(line.strip()) for line in lines if line.strip()]
        return [answer for answer in found if answer is not None]

    def _answer(self, line: bytes) -> FlightAnswer | None:
        """Return the answer that a line is; None for an echo, or what cannot be read."""
        if not line.startswith(b"!"):
            self.faults["other_text"] += 1
            return None
        try:
            t_s, *torque = (float(word) for word in line[1:].split())
        except ValueError:
            self.faults["other_text"] += 1
            return None
        command = CommandRequest(
            kind="torque", value=tuple(torque), at_s=t_s + LEAD_S, duration_s=DURATION_S
        )
        return FlightAnswer(t_s=t_s, commands=(command,))
