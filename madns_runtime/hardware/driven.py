"""A device of a run as its machine's supervisor knows it, its status over the run, and the process that drives it."""

from __future__ import annotations

import math
import os
import socket
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

from madns_runtime.config import DeviceLaunch
from madns_runtime.errors import ConfigurationError
from madns_runtime.hardware import messages, page
from madns_runtime.hardware.contract import Device
from madns_runtime.hardware.count_table import NOT_FINITE
from madns_runtime.hardware.fault_actions import DISCONNECTED, check_fault_fits
from madns_runtime.hardware.intake import counts_of, least_stale_age_s, silent_inputs
from madns_runtime.hardware.kind_declaration import CHANNELS_MAX
from madns_runtime.hardware.kind_registry import DeviceProgram
from madns_runtime.hardware.page import DevicePage
from madns_runtime.hardware.port import DevicePort
from madns_runtime.hardware.records import SimulatedTime
from madns_runtime.hardware.seat import DeviceSeat
from madns_runtime.hardware.status import StatusAccount, StatusLimits, limits_of, sample_period_s
from madns_runtime.plugin.device_view import DeviceStatus
from madns_runtime.reactor.descriptors import allow_descriptors, ready
from madns_runtime.signal_names import signal_name

NOT_MADE_SAFE: Final = "could not be made safe: its driver failed, look at the device"
DESCRIPTORS_BESIDE: Final = 256
"""Descriptors of a process that drives devices or looks after them, beside those for each."""
DESCRIPTORS_EACH: Final = CHANNELS_MAX + 16
"""Descriptors for one device: a file per channel, and others."""
DESCRIPTORS_PER_USER: Final = 3
"""Descriptors for one agent that uses a device."""
TELLING: Final = (NOT_FINITE, "received_bytes", "garbage_bytes", "bad_checksums")
"""Ends of the names of counts that tell why there may be no sample: values that are no numbers, bytes that make no frame."""


@dataclass(slots=True)
class DrivenDevice:
    """One device and what became of it."""

    seat: DeviceSeat
    limits: StatusLimits
    ends: Mapping[str, socket.socket]
    """The agents' ends of their pairs with it."""
    account: StatusAccount = field(default_factory=StatusAccount)
    observed_s: float = math.inf
    """When its status was noted last, s."""
    restarts: int = 0
    faults: dict[str, float | None] = field(default_factory=dict)
    """Inserted faults in force, by action."""
    report: Mapping[str, Any] | None = None
    why: str = ""
    """Why it is lost, or about to be; empty while all is well."""
    why_samples: float = 0
    """Samples that had come when that was told."""
    loss: str = ""
    """Why it was lost the last time."""

    @classmethod
    def share(
        cls, launch: DeviceLaunch, program: DeviceProgram, claims: frozenset[int] = frozenset()
    ) -> DrivenDevice:
        """Make what a device and its users share, beside its claims' descriptors; before anybody is forked."""
        pairs = {agent: messages.make_pair() for agent in launch.users}
        seat = DeviceSeat(
            launch=launch,
            make=program.make,
            channels=program.channels,
            page=DevicePage([c for c in program.channels if c.direction == "in"]),
            users={agent: pair[1] for agent, pair in pairs.items()},
            claims=claims,
        )
        return cls(
            seat=seat,
            limits=limits_of(launch, program.channels),
            ends={agent: pair[0] for agent, pair in pairs.items()},
        )

    @property
    def name(self) -> str:
        """Full name of the device, such as pi22/imu."""
        return self.seat.launch.full_name

    @property
    def has_moving_outputs(self) -> bool:
        """Whether it has outputs that may move."""
        is_out = (channel.direction == "out" for channel in self.seat.channels)
        return self.seat.launch.may_move and any(is_out)

    def port_of(self, agent: str) -> DevicePort:
        """Return it as an agent that uses it sees it; called in the agent's process."""
        return DevicePort(
            self.name,
            self.seat.channels,
            shared=(self.seat.page, self.ends[agent]),
            limits=self.limits,
            agent=agent,
        )

    def alter(self, alter: Callable[[Device], None]) -> None:
        """Have each driver of it altered when it is made."""
        make = self.seat.make

        def make_altered() -> Device:
            made = make()
            alter(made)
            return made

        self.seat = replace(self.seat, make=make_altered)

    def refusal_of(self, action: str) -> str:
        """Return why a fault cannot be inserted around it; empty if it can."""
        try:
            check_fault_fits(action, self.seat.channels)
        except ConfigurationError as error:
            return f"{self.name}: {error}"
        return ""

    def note_fault(self, action: str, value: float | None) -> None:
        """Take note of an inserted fault in force: a process that is started anew is told it again."""
        self.faults[action] = value
        if action == "clear":
            self.faults.clear()

    def observe(self, status: DeviceStatus, now_s: float) -> DeviceStatus | None:
        """Note its status, which counts while simulated time runs, and return the one before if it has changed."""
        told, time = self.seat.page.time.read(), SimulatedTime()
        if told is not None:  # by an agent
            time.set(*told[:3])
            self.account.end_s = time.local_s(told[3])
        before = self.account.observe(status, now_s)
        if self.account.counted_s is None and time.at(now_s) >= 0.0:
            self.account.begin(min(now_s, max(time.local_s(0.0), self.observed_s)))
        self.observed_s = now_s
        return before

    def blame(self, why: str) -> None:
        """Take note of why it is about to be lost: closing it may take a while, in which its newest sample is still fresh."""
        self.why, self.why_samples = why, self.seat.page.header[page.SAMPLES]

    def forgive(self) -> None:
        """Forget that once a sample has come since."""
        if self.seat.page.header[page.SAMPLES] > self.why_samples:
            self.why = ""

    def why_silent(self) -> str:
        """Return why it is lost though its driver has raised nothing, and its process lives."""
        state = self.seat.page.header[page.STATE]
        if state == page.OPENING:
            return f"it has not opened within {self.limits.lost_s:g} s"
        if state == page.OPEN:
            rate_hz = self.seat.launch.rate_hz
            period_s = sample_period_s(rate_hz, self.seat.channels)
            promise = f"rate_hz ({rate_hz:g})"
            if period_s > 1.0 / rate_hz:
                promise = "its fastest input"
            counts = self.seat.page.counts.read().items()
            told = [f"{name} {n}" for name, n in counts if n and name.endswith(TELLING)]
            return (
                f"no sample for {self.limits.lost_s:g} s, where {promise} promises one every {period_s:g} s"
                f"{'; so far ' if told else ''}{', '.join(told)}"
            )
        return DISCONNECTED if "disconnect" in self.faults else "it is closed"

    def _counts(self) -> dict[str, Any]:
        """Return what its processes counted, where the last one ended without its report."""
        return {**counts_of(self.seat.page), "unreported": 1}

    def close(self) -> dict[str, Any]:
        """Close both ends of every pair, which nobody uses any longer, and return what the run came to."""
        for end in (*self.ends.values(), *self.seat.users.values()):
            end.close()
        return self.summary()

    def summary(self) -> dict[str, Any]:
        """Return what the run came to."""
        header, account = self.seat.page.header, self.account
        is_unsafe = bool(header[page.MOVED] or header[page.ATTEMPTED])
        return {
            "status": account.status,
            "samples": int(header[page.SAMPLES]),
            "errors": int(header[page.ERRORS]),
            "stale_ratio": account.stale_ratio(),
            "lost": account.times_lost,
            "restarts": self.restarts,
            "unsafe": int(is_unsafe),
            "least_stale_age_s": least_stale_age_s(self.seat.page, self.limits),
            "silent_inputs": silent_inputs(self.seat.channels, self.seat.page),
            "why": NOT_MADE_SAFE if is_unsafe else self.loss or self.why,
            "report": dict(self.report) if self.report is not None else self._counts(),
        }


@dataclass(slots=True)
class DeviceProcess:
    """One process of devices."""

    devices: list[DrivenDevice]
    pid: int = 0
    control: socket.socket | None = None
    failures: int = 0
    started_s: float = 0.0
    killed_why: str = ""
    gave_up_why: str = ""
    """Its own words before its end."""

    def tell(self, message: list[Any]) -> bool:
        """Send it a message; False if it does not listen."""
        return self.control is not None and messages.send(self.control, message)

    def note_exit(self, code: int) -> None:
        """Blame it, when the run is over, for an end otherwise than in good order: not with 0, or without its report."""
        for driven in self.devices:
            if code or driven.report is None:
                driven.blame(self.gave_up_why or exit_text(code))

    def has_words(self) -> bool:
        """Tell whether it has said something that nobody has heard, or has closed its end."""
        return self.control is not None and bool(ready([self.control.fileno()], [], 0)[0])

    def is_opening(self) -> bool:
        """Tell whether it lives and has a device that was neither opened nor has failed."""
        headers = [driven.seat.page.header for driven in self.devices]
        if not any(h[page.STATE] == page.OPENING and not h[page.ERRORS] for h in headers):
            return False
        return os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None


def allow_descriptors_of(devices: Iterable[DeviceLaunch]) -> None:
    """Let this process, and those that it forks, have as many descriptors as such devices need."""
    each = (DESCRIPTORS_EACH + DESCRIPTORS_PER_USER * len(device.users) for device in devices)
    allow_descriptors(DESCRIPTORS_BESIDE + sum(each))


def exit_text(code: int) -> str:
    """Return how a process ended, in words."""
    return f"killed by {signal_name(-code)}" if code < 0 else f"exit code {code}"
