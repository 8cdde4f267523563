"""The host's half of the counting benchmark: increments and returns, at once or on a tick of its own."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from madns_runtime.plugin.api import HostContext, HostSimulation
from madns_runtime.protocol.messages import Service
from madns_runtime.simulations.counter.answer_times import AnswerTimes, ahead_of
from madns_runtime.simulations.counter.parameters import ANSWER_ROUND_TRIPS, DEVICE_SAMPLES

WAITING_MAX = 100_000
"""Packets of all agents that wait for the host's tick; one beyond that is not answered, and counted."""


class CounterHost(HostSimulation):
    """Increments each packet's value and sends it back in the class of service it came in."""

    def setup(self, context: HostContext) -> None:
        """Prepare."""
        self._send = context.send
        self._services = {
            agent: Service[own.service.upper()] for agent, own in context.agent_parameters.items()
        }
        self._returned_count = 0
        self._samples: Counter[str] = Counter()
        """Samples of a device that have come, by agent."""
        self._context = context
        self._answer_hz: float = context.parameters.answer_hz
        self._ahead = ahead_of(len(context.agents))
        self._ticks = 0
        self._missed_count = 0
        self._waiting: list[tuple[str, Any]] = []
        self._refused_count = 0
        self._answer_times = AnswerTimes() if context.parameters.host_round_trips else None
        if self._answer_times is not None:
            context.open_stream("answer_round_trips", ANSWER_ROUND_TRIPS)
        if context.parameters.send_device:
            context.open_stream("device_samples", DEVICE_SAMPLES)

    def receive(self, agent: str, message: Any) -> None:
        """Return [packet, value + 1, payload], or keep it for the next tick; record [device, samples]."""
        if len(message) == 2:
            self._record_samples(agent, *message)
            return
        if not self._answer_hz:
            self._answer(agent, message)
        elif len(self._waiting) < WAITING_MAX:
            self._waiting.append((agent, message))
        else:
            self._refused_count += 1

    def timer(self, t_s: float) -> float | None:
        """Answer all that waits, on the host's own tick."""
        if not self._answer_hz:
            return None
        waiting, self._waiting = self._waiting, []
        for agent, message in waiting:
            self._answer(agent, message)
        by_clock = math.floor(self._context.now_s() * self._answer_hz + self._ahead)
        following: int = max(self._ticks, by_clock) + 1
        self._missed_count += following - self._ticks - 1
        self._ticks = following
        return (following - self._ahead) / self._answer_hz

    def _answer(self, agent: str, message: Any) -> None:
        packet, value, payload, *newest = message
        if self._answer_times is not None:
            self._time_answer(agent, *newest)
            self._answer_times.answered(agent, packet, self._context.now_s())
        self._send(agent, [packet, value + 1, payload], self._services[agent])
        self._returned_count += 1

    def _time_answer(self, agent: str, newest: int) -> None:
        """Record how long ago the answer went out that the agent had when it sent its packet."""
        assert self._answer_times is not None
        now_s = self._context.now_s()
        sent_s = self._answer_times.seen(agent, newest)
        if sent_s is not None:
            values = (round(now_s, 6), agent, newest, round((now_s - sent_s) * 1e6))
            self._context.record("answer_round_trips", values)

    def finish(self) -> Mapping[str, Any]:
        """Return how many packets went back, and what came of a device."""
        summary: dict[str, Any] = {"returned": self._returned_count}
        if self._answer_hz:
            summary |= {
                "ticks": self._ticks,
                "ticks_missed": self._missed_count,
                "unanswered": len(self._waiting),
                "refused": self._refused_count,
            }
        if self._answer_times is not None:
            summary["answers_not_seen"] = self._answer_times.not_seen
        if self._context.parameters.send_device:
            absent = int(not self._samples)
            summary["device_samples"] = dict(self._samples)
            summary["checks"] = [
                {
                    "name": "counter.device_absent",
                    "limit": 0,
                    "got": absent,
                    "passed": not absent,
                    "worst": self._context.parameters.send_device,
                }
            ]
        return summary

    def _record_samples(self, agent: str, device: str, samples: Sequence[Any]) -> None:
        now_s = self._context.now_s()
        for channel, number, taken_s, value in samples:
            delay_us = round((now_s - taken_s) * 1e6)
            self._context.record(
                "device_samples",
                (round(taken_s, 6), f"{agent}/{device}", channel, number, delay_us, value),
            )
        self._samples[agent] += len(samples)
