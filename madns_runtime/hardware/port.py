"""Devices as an agent sees them: `context.hardware`."""

from __future__ import annotations

import math
import socket
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from time import monotonic
from typing import Any, Final

from madns_runtime.errors import PluginError
from madns_runtime.hardware import messages, page
from madns_runtime.hardware.contract import Channel, Value
from madns_runtime.hardware.count_table import missed_name
from madns_runtime.hardware.fault_orders import ORDERS_FROM
from madns_runtime.hardware.page import DevicePage
from madns_runtime.hardware.profiles import pack_points, packs_max
from madns_runtime.hardware.status import StatusLimits
from madns_runtime.hardware.values import are_finite, from_numbers, to_frame, to_numbers
from madns_runtime.plugin.device_view import (
    ChannelForm,
    ChannelFrame,
    ChannelReading,
    DeviceStatus,
)
from madns_runtime.protocol.messages import FaultOrder

FRAMES_MAX: Final = 10_000
"""Values of a queue that may wait to be taken; the oldest are given up beyond, and counted."""
PACKS_MAX: Final = 64
"""Messages of profiles that may wait for room, or as many as one profile of the widest output takes; the oldest are given up
beyond, and their points counted."""
ANSWERS_MAX: Final = 8
"""Orders whose answers are told; who gave an older one has stopped waiting."""
TOLD_BYTES_MAX: Final = 200
"""Of one sentence in a report, which goes into a datagram ..."""
ANSWERS_BYTES_MAX: Final = 450
"""... and of all answers in it together."""
ANSWER_OVERHEAD_BYTES: Final = 12


class DevicePort:
    """
    One device, as one agent sees it: a `madns_runtime.plugin.device_view.DeviceView`. Nothing here waits.

    Args:
        full_name: The device's among all of the run, such as pi22/imu; the scenario calls it by what stands last.
        channels: The device's.
        shared: Its page, and this agent's end of their pair.
        limits: Ages from which it is stale and lost.
        now_s: Returns the present on this machine's clock, s; in lockstep simulated time.
        agent: Whose end it is; empty where nothing is given up before it comes.
    """

    def __init__(  # noqa: PLR0913 - the collaborators of a seam, most keyword-only
        self,
        full_name: str,
        channels: tuple[Channel, ...],
        *,
        shared: tuple[DevicePage, socket.socket],
        limits: StatusLimits,
        now_s: Callable[[], float] = monotonic,
        agent: str = "",
    ) -> None:
        self.full_name = full_name
        self.name = full_name.rpartition("/")[2]
        self._now_s = now_s
        self.channels = {channel.name: channel for channel in channels}
        self.inputs = tuple(
            each.name for each in channels if each.direction == "in" and not each.is_frame
        )
        self._page, self._end = shared
        self._limits = limits
        self.local_s: Callable[[float], float] = float
        """Returns when a simulated time is on that clock, s."""
        self.make_room: Callable[[], bool] = lambda: False
        """Has the device take what was sent, where it lives in this process, and tells whether it has: in lockstep."""
        self._frames: dict[str, deque[tuple[int, float, Any]]] = {
            channel.name: deque(maxlen=FRAMES_MAX)
            for channel in channels
            if channel.direction == "in" and (channel.is_frame or channel.passing == "queue")
        }
        self._orders: set[int] = set()
        """Faults that were ordered and not answered."""
        self._answers: deque[tuple[int, str]] = deque(maxlen=ANSWERS_MAX)
        self._unsent: dict[str, list[Any]] = {}
        self._packs: deque[list[Any]] = deque()
        """Points of profiles that wait for room, and values that must come before points of their output."""
        played = (c for c in channels if c.direction == "out" and not c.is_frame)
        self._packs_max = max((PACKS_MAX, *map(packs_max, played)))
        self.frames_dropped = 0
        """Values of queues that nobody took in time."""
        self.writes_lost = 0
        """Values for an output that the device's process had no room for."""
        self.points_lost = 0
        """Points of profiles that it had no room for."""
        self._missed_name = missed_name(agent)
        """Under which the device's process counts what it gave up as this agent did not take it, in all its incarnations."""

    @property
    def status(self) -> DeviceStatus:
        """Status of the device, now."""
        return self._page.status(self._limits, self._now_s())

    def __getitem__(self, channel: str) -> ChannelReading:
        """Return the newest value of an input; see `DeviceView`."""
        declared = self.channels.get(channel)
        if declared is None or declared.direction == "out" or declared.is_frame:
            raise PluginError(f"{self.name} has no input {channel!r} of numbers{self._known()}")
        number, taken_s, device_s, values = self._page.read(channel)
        value = from_numbers(declared, values) if number else None
        now_s = self._now_s()
        status = self._page.status(self._limits, now_s)
        return ChannelReading(value, now_s - taken_s, number, status, device_s)

    def form_of(self, channel: str) -> ChannelForm:
        """Return what the values of a channel are; see `DeviceView`."""
        declared = self.channels.get(channel)
        if declared is None:
            raise PluginError(f"{self.name} has no channel {channel!r}{self._known()}")
        return ChannelForm(
            declared.unit, 0 if declared.is_frame else declared.size, declared.is_line
        )

    def frames(self, channel: str) -> list[ChannelFrame]:
        """Return all that has come through a queue since the last call; see `DeviceView`."""
        queue = self._frames.get(channel)
        if queue is None:
            raise PluginError(f"{self.name} has no queue {channel!r}{self._known()}")
        self.collect()
        now_s = self._now_s()
        found = [ChannelFrame(value, number, now_s - taken_s) for number, taken_s, value in queue]
        queue.clear()
        return found

    def write(self, channel: str, value: Value, *, due_s: float | None = None) -> None:
        """Hand over a value for an output, due at simulated time *due_s*; see `DeviceView`."""
        declared = self._output(channel)
        if due_s is not None and not math.isfinite(due_s):
            raise PluginError(
                f"{self.name}.{channel}: due_s: expected a simulated time, s, got {due_s!r}"
            )
        if declared.is_frame:
            sent: Any = to_frame(declared, value)
        else:
            sent = to_numbers(declared, value)
            if not are_finite(sent):
                raise PluginError(f"{self.name}.{channel}: expected numbers, got {value!r:.80}")
            sent = from_numbers(declared, sent)
        local_s = self._now_s() if due_s is None else self.local_s(due_s)
        message = [messages.WRITE, channel, sent, local_s]
        if self._unsent or self._packs:
            self.flush()
        # A value that ends a profile does not overtake it.
        is_behind = declared.passing == "newest" and any(p[1] == channel for p in self._packs)
        if not is_behind and (
            messages.send(self._end, message)
            or (self.make_room() and messages.send(self._end, message))
        ):
            self._unsent.pop(channel, None)  # an older one, which must not come behind it
            return
        if declared.passing == "newest":
            self._unsent[channel] = message
        else:
            self.writes_lost += 1

    def play(
        self,
        channel: str,
        points: Iterable[tuple[float, Any]],
        *,
        from_s: float | None = None,
    ) -> None:
        """Hand over points of an output's profile; see `DeviceView`."""
        declared = self._output(channel)
        if declared.is_frame:
            raise PluginError(
                f"{self.name}.{channel}: frames have no profile: write them with due_s"
            )
        packs = pack_points(declared, points)
        start_s = packs[0][0] if from_s is None and packs[0] else from_s
        if start_s is None or math.isnan(start_s) or (packs[0] and not start_s <= packs[0][0]):
            raise PluginError(
                f"{self.name}.{channel}: expected points, none before from_s ({from_s}); got"
                f" {f'one at {packs[0][0]:g} s' if packs[0] else 'neither'}"
            )
        if channel in self._unsent:
            self.flush()
        if channel in self._unsent:  # behind these points it would end their profile
            self._packs.append(self._unsent.pop(channel))
        for number, pack in enumerate(packs):
            first_s = pack[0] if number else start_s
            self._packs.append([messages.PLAY, channel, first_s, pack.tobytes()])
        self.flush()
        if len(self._packs) > self._packs_max:
            self.make_room()
        while len(self._packs) > self._packs_max:
            given_up = self._packs.popleft()
            self.writes_lost += given_up[0] == messages.WRITE
            self.points_lost += self._count_points(given_up)

    def _count_points(self, pack: list[Any]) -> int:
        if pack[0] == messages.WRITE:
            return 0
        return len(pack[-1]) // 8 // (self.channels[pack[1]].size + 1)

    def size_of(self, channel: str) -> int:
        """Return how many numbers an output takes; see `DeviceView`."""
        declared = self._output(channel)
        if declared.is_frame:
            raise PluginError(f"{self.name}.{channel} takes frames, and no numbers")
        return declared.size

    def _output(self, channel: str) -> Channel:
        declared = self.channels.get(channel)
        if declared is None or declared.direction != "out":
            raise PluginError(f"{self.name} has no output {channel!r}{self._known()}")
        return declared

    def flush(self) -> None:
        """Send what found no room before; the framework calls it in each tick."""
        while self._packs:
            if not messages.send(self._end, self._packs[0]):
                return
            self._packs.popleft()
        for channel, message in list(self._unsent.items()):
            if not messages.send(self._end, message):
                return
            del self._unsent[channel]

    def tell_time(self, local_s: float, t_s: float, rate: float, end_s: float = math.inf) -> None:
        """Tell the device's process what simulated time it is, and when that ends; the framework calls it now and then."""
        self._page.time.write(local_s, t_s, rate, end_s)
        messages.send(self._end, [messages.TIME])

    @property
    def loss(self) -> str | None:
        """Why the device was lost since simulated time runs, the last time; None if it was not."""
        return self._page.loss.read() if self._page.header[page.LOSSES] else None

    def order_fault(self, number: int, action: str, value: float | None) -> None:
        """Have a fault inserted around the device; `answers` tells what became of it."""
        self._orders.add(number)
        if not messages.send(self._end, [messages.FAULT, number, action, value]):
            self._answered(number, f"{self.full_name}: its process does not listen")

    def losses(self) -> dict[str, int]:
        """Return the counts of what found no room on its way from or to the device, or waits for it still; empty for none."""
        counts = {
            "frames_missed": self._page.counts.read().get(self._missed_name, 0),
            "frames_dropped": self.frames_dropped,
            "writes_lost": self.writes_lost,
            "points_lost": self.points_lost,
            "writes_left": len(self._unsent) + sum(p[0] == messages.WRITE for p in self._packs),
            "points_left": sum(map(self._count_points, self._packs)),
        }
        return {name: count for name, count in counts.items() if count}

    def answers(self) -> list[tuple[int, str]]:
        """Return the newest orders' numbers, each with the reason of its refusal, else empty."""
        if self._orders:
            self.collect()
        return list(self._answers)

    def _answered(self, number: int, refusal: str) -> None:
        self._orders.discard(number)
        if number < ORDERS_FROM:
            self._answers.append((number, refusal))

    def collect(self) -> None:
        """Take what has come from the device's process into the queues; in lockstep that makes room for more."""
        for word, *rest in messages.receive_all(self._end):
            if word == messages.ANSWER:
                self._answered(rest[0], rest[1])
            if word != messages.FRAME:
                continue
            name, number, taken_s, value = rest
            queue = self._frames[name]
            if len(queue) == FRAMES_MAX:
                self.frames_dropped += 1
            if not self.channels[name].is_frame:
                value = from_numbers(self.channels[name], value)
            queue.append((number, taken_s, value))

    def _known(self) -> str:
        return f"; it has {', '.join(self.channels) or 'none'}"


class Hardware(Mapping[str, DevicePort]):
    """The devices that one agent uses, by name."""

    def __init__(self, ports: Mapping[str, DevicePort] | None = None) -> None:
        self._ports = dict(ports or {})
        self._statuses: dict[str, DeviceStatus] = dict.fromkeys(self._ports, "never")
        self._reports = 0

    def __getitem__(self, name: str) -> DevicePort:
        """
        Return a device.

        Raises:
            PluginError: The scenario gives this agent no device of that name.
        """
        try:
            return self._ports[name]
        except KeyError:
            known = ", ".join(self._ports) or "none"
            raise PluginError(
                f"this agent uses no device {name!r} (it uses {known}); say so under hardware: use: of the scenario"
            ) from None

    def get(self, name: str, default: Any = None) -> Any:
        """Return a device, or *default* if this agent uses none of that name."""
        return self._ports.get(name, default)

    def __contains__(self, name: object) -> bool:
        return name in self._ports

    def __iter__(self) -> Iterator[str]:
        return iter(self._ports)

    def __len__(self) -> int:
        return len(self._ports)

    def use_clock(self, local_s: Callable[[float], float]) -> None:
        """Let writes that are due at a simulated time find it on this machine's clock by *local_s*."""
        for port in self._ports.values():
            port.local_s = local_s

    def changes(self) -> list[tuple[str, DeviceStatus]]:
        """Return the devices whose status has changed since the last call; the framework calls it in each tick."""
        found: list[tuple[str, DeviceStatus]] = []
        for name, port in self._ports.items():
            port.flush()
            status = port.status
            if status != self._statuses[name]:
                self._statuses[name] = status
                found.append((name, status))
        return found

    def forget_statuses(self) -> None:
        """Forget which statuses `changes` has told: the agent has returned, and knows of none."""
        self._statuses = dict.fromkeys(self._ports, "never")

    def order_fault(self, order: FaultOrder) -> None:
        """Have a fault inserted around a device; `report` tells what became of it."""
        for port in self._ports.values():
            if port.full_name == order.device:
                value = None if math.isnan(order.value) else order.value
                port.order_fault(order.number, order.action, value)

    def report(self) -> dict[str, Any]:
        """
        Return what the host of a run without an operator is told: a device that was lost, and answers to orders.

        Of several lost ones another with each report; the newest answers, as many as fit; sentences are cut to TOLD_BYTES_MAX.
        """
        lost = [
            (p.full_name, _cut(why)) for p in self._ports.values() if (why := p.loss) is not None
        ]
        answers: list[tuple[int, str]] = []
        left = ANSWERS_BYTES_MAX
        every = [answer for port in self._ports.values() for answer in port.answers()]
        for number, refusal in sorted(every, reverse=True):
            refusal = _cut(refusal)
            left -= len(refusal.encode()) + ANSWER_OVERHEAD_BYTES
            if left < 0:
                break
            answers.append((number, refusal))
        self._reports += 1
        told: dict[str, Any] = {"lost_device": lost[self._reports % len(lost)]} if lost else {}
        return {**told, "fault_answers": answers} if answers else told

    def losses(self) -> dict[str, dict[str, int]]:
        """Return the devices with which something found no room, by full name, and counts of what; see `DevicePort.losses`."""
        return {port.full_name: lost for port in self._ports.values() if (lost := port.losses())}

    def tell_time(self, local_s: float, t_s: float, rate: float, end_s: float = math.inf) -> None:
        """Tell all devices what simulated time it is, and when that ends."""
        for port in self._ports.values():
            port.tell_time(local_s, t_s, rate, end_s)


def _cut(text: str) -> str:
    return text.encode()[:TOLD_BYTES_MAX].decode(errors="ignore")


NO_HARDWARE: Final = Hardware()
