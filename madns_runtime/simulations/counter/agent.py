"""The agent's half of the counting benchmark: increments, sends, and times what comes back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from madns_runtime.plugin.api import HOST, AgentContext, AgentSimulation, DeviceView, Tick
from madns_runtime.protocol.messages import Service
from madns_runtime.simulations.counter.answer_times import last_answer_s
from madns_runtime.simulations.counter.parameters import ROUND_TRIPS
from madns_runtime.simulations.counter.round_trips import RoundTrips

IN_FLIGHT_MAX = 10_000
"""Packets whose return is still awaited; an older one counts as lost when it leaves."""
UNREAD_MAX = 10_000
"""Answers that wait for the next tick; one beyond that is not read, and its packet counts as lost."""


class CounterAgent(AgentSimulation):
    """
    Each tick sends [packet, value, payload]; the host returns value + 1.

    Where the host times its answers, too, a fourth value names the newest packet whose answer was read; -1 for none.
    """

    def setup(self, context: AgentContext, initial: Mapping[str, Any]) -> None:
        """Prepare the stream of round trips."""
        self._context = context
        self._service = Service[context.parameters.service.upper()]
        self._payload = bytes(context.parameters.payload_bytes)
        self._value = 0
        self._in_flight: dict[int, tuple[float, int]] = {}
        self._sent_count = 0
        self._newest = -1
        self._duplicated_count = 0
        self._reordered_count = 0
        self._wrong_count = 0
        self._returned_count = 0
        self._round_trips = RoundTrips()
        self._count_round_trip = self._round_trips.add
        context.open_stream("round_trips", ROUND_TRIPS)
        name = context.parameters.send_device
        self._device = context.hardware[name] if name and name in context.hardware else None
        self._numbers: dict[str, int] = {}
        self._reads_on_tick = context.parameters.read_on_tick
        self._unread: list[Any] = []
        self._unread_refused_count = 0
        self._names_newest = context.parameters.host_round_trips

    def step(self, tick: Tick) -> None:
        """Increment and send."""
        packet = tick.index
        if self._unread:
            unread, self._unread = self._unread, []
            for message in unread:
                self._read(message)
        self._value += 1
        if len(self._in_flight) >= IN_FLIGHT_MAX:
            del self._in_flight[next(iter(self._in_flight))]
        self._in_flight[packet] = (self._context.now_s(), self._value)
        self._sent_count += 1
        message = [packet, self._value, self._payload]
        if self._names_newest:
            message.append(self._newest)
        self._context.send(HOST, message, self._service)
        if self._device is not None:
            self._send_samples(self._device)

    def _send_samples(self, device: DeviceView) -> None:
        """Send [device, [[channel, number, time at which it was taken, value], ...]] of all that is new."""
        samples = []
        # By name: a device that is played back has its channels in that order.
        for channel in sorted(device.inputs):
            reading = device[channel]
            if reading.number > self._numbers.get(channel, 0):
                self._numbers[channel] = reading.number
                taken_s = self._context.now_s() - reading.age_s
                samples.append([channel, reading.number, taken_s, reading.value])
        if samples:
            self._context.send(HOST, [device.name, samples], Service.BEST)

    def receive(self, message: Any) -> None:
        """Read a packet that came back, or keep it for the next tick."""
        if not self._reads_on_tick:
            self._read(message)
        elif len(self._unread) < UNREAD_MAX:
            self._unread.append(message)
        else:
            self._unread_refused_count += 1

    def _read(self, message: Any) -> None:
        """Time a packet that came back."""
        now_s = self._context.now_s()
        packet, value, _ = message
        sent = self._in_flight.pop(packet, None)
        if sent is None:
            self._duplicated_count += 1
            return
        sent_s, sent_value = sent
        if value != sent_value + 1:
            self._wrong_count += 1
        if packet < self._newest:
            self._reordered_count += 1
        self._newest = max(self._newest, packet)
        self._value = max(self._value, value)
        self._returned_count += 1
        round_trip_us = round((now_s - sent_s) * 1e6)
        self._count_round_trip(round_trip_us)
        self._context.record("round_trips", (packet, value, round_trip_us))

    def finish(self) -> Mapping[str, Any]:
        """Return the thesis's figures over all round trips, in whole microseconds."""
        for (
            packet,
            *_,
        ) in self._unread:  # it came back, but the tick at which it would be timed does not follow
            self._returned_count += self._in_flight.pop(packet, None) is not None
        self._unread = []
        unanswered = self._count_unanswered()
        lost = self._sent_count - self._returned_count - unanswered
        summary: dict[str, Any] = {
            "service": self._service.name.lower(),
            "sent": self._sent_count,
            "returned": self._returned_count,
            "lost": lost,
            "duplicated": self._duplicated_count,
            "out_of_order": self._reordered_count,
            "wrong_values": self._wrong_count,
            "round_trip_us": self._round_trips.statistics(),
            "round_trips_left_out": self._round_trips.left_out,
        }
        if self._reads_on_tick:
            summary["unread_refused"] = self._unread_refused_count
        if self._context.parameters.answer_hz:
            summary["unanswered"] = unanswered
        summary["checks"] = [
            {"name": f"counter.{name}", "limit": 0, "got": got, "passed": got == 0}
            for name, got in (("lost", lost), ("wrong_values", self._wrong_count))
        ]
        return summary

    def _count_unanswered(self) -> int:
        """Return how many packets the host holds for a tick that comes no more: those sent after its last one."""
        context = self._context
        answer_hz: float = context.parameters.answer_hz
        if not answer_hz:
            return 0
        end_s = min(context.now_s(), context.duration_s)
        last_s = last_answer_s(end_s, answer_hz, len(context.agents))
        return sum(sent_s > last_s for sent_s, _ in self._in_flight.values())
