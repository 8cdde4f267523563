"""
Reports as structs of `content`, and structs as answers: what frames and Space Packets have in common. Pure.

What arrives twice, late, damaged or not at all is counted by kind and never raises; a whole, valid request that
cannot be is an answer's fault.
"""

from __future__ import annotations

import base64
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np
import orjson

from madns_runtime.simulations.constellation.flight.api import Reading
from madns_runtime.simulations.constellation.flight.interface import content
from madns_runtime.simulations.constellation.flight.interface.answers import (
    CommandRequest,
    FlightAnswer,
)
from madns_runtime.simulations.constellation.flight.interface.content import FlightContent
from madns_runtime.simulations.constellation.flight.interface.reports import SetupReport, TickReport

PENDING_MAX: Final = 1024
"""Requests that may come before a done; further ones are dropped and counted."""
U32: Final = 2**32 - 1
U16: Final = 2**16 - 1
PAYLOAD_BYTES_MAX: Final = U16 - content.MESSAGE.size - 9
"""Of a message to the program, whose struct, and in a Space Packet time and checksum less one, count in the same 16 bits."""
FAULTS: Final = (
    "cut",
    "corrupt",
    "wrong_length",
    "overlong",
    "unknown",
    "lost",
    "duplicate",
    "other_time",
    "overflow",
    "restarts",
)
"""Kinds of faults that are counted: too short to be whole; checksum or stuffing wrong; not as long as its kind or
its head says; longer than any; of no known kind or version; missing by their sequence numbers; come twice or out
of order; of another tick than the answer they came with; more than a bound; sequences that began anew."""


class Said(NamedTuple):
    """One struct on its way to the program."""

    content: FlightContent
    values: Mapping[str, Any]
    tail: Any = b""


class SequenceCount:
    """SequenceCount numbers of one sender: what is missing and what came twice is counted."""

    OLD_MAX: Final = 64
    """So far back a number is a duplicate; farther back the sender began anew."""

    def __init__(self, modulus: int, faults: Counter[str]) -> None:
        self._modulus = modulus
        self._faults = faults
        self._next: int | None = None

    def restart(self) -> None:
        """Take whatever number comes next."""
        self._next = None

    def is_next(self, number: int) -> bool:
        """Tell whether a number is the one that is expected, or the first of all."""
        return self._next in (None, number)

    def takes(self, number: int) -> bool:
        """Return whether what bears a number is new."""
        if self._next is not None:
            ahead = (number - self._next) % self._modulus
            if ahead >= self._modulus - self.OLD_MAX:
                self._faults["duplicate"] += 1
                return False
            if ahead >= self._modulus // 2:
                self._faults["restarts"] += 1
            else:
                self._faults["lost"] += ahead
        self._next = (number + 1) % self._modulus
        return True


class Dialogue:
    """Both directions of a conversation in structs."""

    def __init__(self) -> None:
        self.faults: Counter[str] = Counter({name: 0 for name in FAULTS})
        self._setup: SetupReport | None = None
        self._pending: list[tuple[float, FlightContent, dict[str, Any]]] = []
        self._estimates: dict[str, None] = {}
        """Names of what was believed first, which stay: a packet of one may be lost."""
        self.is_greeted = False
        """Whether a hello has come that `setup_again` has not answered."""
        self._knows_setup = False
        """Whether the hello still to come is of software that finds the setup where it listens."""

    # To the program ----------------------------------------------------------------------------

    def setup(self, setup: SetupReport) -> Iterator[Said]:
        """Yield the structs of a setup."""
        if self._setup is None:
            # Whether its hello comes before the first tick or behind it is chance, and must not show.
            self._knows_setup = setup.is_kept
        self._setup = setup
        settings = list(_settings(setup.settings))
        values = {
            "tick_hz": setup.tick_hz,
            "duration_s": setup.duration_s,
            "first_number": setup.first_number & U32,
            "seed": setup.seed & U32,
            "index": min(setup.index, U16),
            "agents": min(len(setup.agents), U16),
            "settings": min(len(settings), U16),
            "input": content.INPUTS.index(setup.input),
            "clock": content.CLOCKS.index(setup.clock),
            "name": setup.name,
            "satellite": setup.satellite,
            "epoch_utc": setup.epoch_utc,
        }
        yield Said(content.SETUP, values)
        for one in settings:
            yield Said(content.SETTING, one)

    def setup_again(self) -> Iterator[Said]:
        """Yield the setup again for software that said hello."""
        if self.is_greeted and self._setup is not None:
            yield from self.setup(self._setup)
        self.is_greeted = False

    def tick(self, tick: TickReport) -> Iterator[Said]:
        """Yield the structs of a tick: what it brings, then its end."""
        samples: Mapping[str, Iterable[Reading]] = getattr(tick.readings, "samples", {})
        readings = [
            (name, one)
            for name, newest in tick.readings.items()
            if name in content.SENSORS
            for one in samples.get(name, (newest,))
        ]
        for name, reading in readings:
            values = {
                "valid_s": reading.t_s,
                "sensor": content.SENSORS.index(name),
                "count": len(reading.values),
            }
            yield Said(content.READING, values, reading.values)
        encoded = [(one, *_payload(one.payload)) for one in tick.messages]
        messages = [one for one in encoded if len(one[2]) <= PAYLOAD_BYTES_MAX]
        self.faults["overflow"] += len(encoded) - len(messages)
        for message, encoding, payload in messages:
            yield Said(
                content.MESSAGE,
                {
                    "sent_s": message.sent_s,
                    "arrives_s": message.arrives_s,
                    "size": len(payload),
                    "encoding": content.ENCODINGS.index(encoding),
                    "sender": message.sender,
                },
                payload,
            )
        for result in tick.results:
            yield Said(
                content.RESULT,
                {
                    "at_s": result.at_s,
                    "delta_v_m_s": result.delta_v_m_s,
                    "propellant_kg": result.propellant_kg,
                    "number": result.number & U32,
                    "revision": result.revision & U32,
                    "status": content.STATUSES.index(result.status),
                    "reason": result.reason,
                },
            )
        for refusal in tick.refusals:
            yield Said(
                content.REFUSAL,
                {
                    "sent_s": refusal.sent_s,
                    "number": refusal.number & U32,
                    "to": refusal.to,
                    "reason": refusal.reason,
                },
            )
        counts = {
            "readings": len(readings),
            "messages": len(messages),
            "results": len(tick.results),
            "refusals": len(tick.refusals),
        }
        yield Said(content.TICK, {name: min(count, U16) for name, count in counts.items()})

    # From the program --------------------------------------------------------------------------

    def take(
        self, number: int, t_s: float, order: content.ByteOrder, data: bytes
    ) -> FlightAnswer | None:
        """Take a whole, valid packet's content; return an answer if one is complete now."""
        known = content.BY_NUMBER.get(number)
        if known is None or known not in content.FROM_PROGRAM:
            self.faults["unknown"] += 1
            return None
        values = known.unpack(order, data)
        if values is None:
            self.faults["wrong_length"] += 1
            return None
        if known is content.HELLO:
            self._pending.clear()
            self.is_greeted = not self._knows_setup
            self._knows_setup = False
            return None
        if known is not content.DONE:
            if len(self._pending) >= PENDING_MAX:
                self.faults["overflow"] += 1
            else:
                self._pending.append((t_s, known, values))
            return None
        pending, self._pending = self._pending, []
        # Bits, not numbers: time comes back as it was given, and not a number is a time of nothing.
        of_this = [one for one in pending if one[0] == t_s]
        self.faults["other_time"] += len(pending) - len(of_this)
        answer = _answer(t_s, values["board_us"], [(one, said) for _, one, said in of_this])
        if not answer.estimate:
            return answer
        self._estimates = self._estimates or dict.fromkeys(answer.estimate)
        return replace(answer, estimate={**self._estimates, **answer.estimate})


def _answer(
    t_s: float, board_us: int, said: list[tuple[FlightContent, dict[str, Any]]]
) -> FlightAnswer:
    commands: list[CommandRequest] = []
    sends: list[tuple[Any, Any]] = []
    logs: list[tuple[Any, Any]] = []
    estimate: dict[str, float | None] = {}
    fault = ""
    for one, values in said:
        if one is content.SEND:
            to, encoding = values["to"], _word(content.ENCODINGS, values["encoding"])
            try:
                payload = orjson.loads(values["tail"]) if encoding == "json" else values["tail"]
            except orjson.JSONDecodeError:
                payload, fault = None, fault or f"send to {to!r:.80}: expected JSON as its payload"
            if encoding not in content.ENCODINGS:
                fault = fault or f"send: expected encoding 0 or 1, got {encoding}"
            sends.append((to, payload))
        elif one is content.ESTIMATE:
            value = values["value"]
            estimate[values["name"]] = None if math.isnan(value) else value
        elif one is content.LOG:
            level = _word(content.LOG_LEVELS, values["level"])
            logs.append((level, values["tail"].decode("utf-8", "replace")))
        else:
            commands.append(_command(one, values))
    return FlightAnswer(
        t_s=t_s,
        commands=tuple(commands),
        sends=tuple(sends),
        estimate=estimate or None,
        logs=tuple(logs),
        board_us=board_us,
        fault=fault,
    )


def _command(one: FlightContent, values: Mapping[str, Any]) -> CommandRequest:
    return CommandRequest(
        kind=one.name,
        value=values[one.fields[0].name],
        at_s=values["at_s"],
        frame=_word(content.FRAMES, values.get("frame", 1)),
        duration_s=values.get("duration_s", 0.0),
    )


def _word(words: tuple[str, ...], number: int) -> str:
    """Return what a number stands for; of an unknown one a text that nothing takes for a word."""
    return words[number] if number < len(words) else f"number {number}"


def _settings(settings: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    for name, given in settings.items():
        is_list = isinstance(given, list | tuple)
        values = list(given) if is_list else [given]
        for index, value in enumerate(values):
            is_text = isinstance(value, str)
            yield {
                "value": 0.0 if is_text else float(value),
                "index": min(index, U16),
                "count": min(len(values), U16) if is_list else 0,
                "is_text": is_text,
                "name": name,
                "text": value if is_text else "",
            }


def _payload(payload: Any) -> tuple[str, bytes]:
    """Return how a message's payload is encoded, and its bytes."""
    if isinstance(payload, bytes):
        return "bytes", payload
    data = orjson.dumps(payload, to_plain, orjson.OPT_SERIALIZE_NUMPY)
    return "json", data


def to_plain(value: Any) -> Any:
    """
    Return what JSON has no form for in one that it has.

    Raises:
        TypeError: There is none.
    """
    if isinstance(value, bytes):
        return {"base64": base64.b64encode(value).decode()}
    if isinstance(value, np.ndarray) and not value.ndim:  # orjson knows those with axes alone
        return value.item()
    raise TypeError(type(value).__name__)
