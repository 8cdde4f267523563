"""Actions of the framework that a timeline orders of an agent in real time: a stop, load, faults of its devices."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Mapping, Sequence
from time import monotonic
from typing import Any

from madns_runtime.errors import ConfigurationError
from madns_runtime.faults.clock_faults import FaultableClock
from madns_runtime.hardware.fault_actions import check_fault, check_fault_fits
from madns_runtime.hardware.fault_orders import timeline_order
from madns_runtime.health.stress_process import (
    end_stress_processes,
    reap,
    start_stress_processes,
)
from madns_runtime.plain_values import from_mapping
from madns_runtime.plugin.agent_actions import AgentActions, OwnAction
from madns_runtime.protocol.messages import ActionOrder
from madns_runtime.realtime.agent_calls import LoopSeat
from madns_runtime.recording.run_journal import RunJournal
from madns_runtime.timeline.action import ActionKind, ActionRefused
from madns_runtime.timeline.kinds import (
    DEVICE_FAULT,
    DRIFT_CLOCK,
    STEP_CLOCK,
    STOP,
    STRESS,
    ClockDrift,
    ClockStep,
    DeviceFault,
    Stress,
)


class OrderedActions(AgentActions):
    """
    Carries them out.

    Args:
        seat: The agent, and the devices that it uses.
        declared: Actions of the simulation.
        journal: Of the agent.
        call: Calls a method of the agent's half.
        end_at: Ends the agent's simulated time at one that is to come, s.
        clock: The process's estimate of the host's clock.
    """

    def __init__(  # noqa: PLR0913 - the collaborators of a seam, most keyword-only
        self,
        seat: LoopSeat,
        declared: Sequence[ActionKind],
        journal: RunJournal,
        *,
        call: Callable[..., Any],
        end_at: Callable[[float], None],
        clock: FaultableClock,
    ) -> None:
        self._hardware = seat.hardware
        self._end_at = end_at
        self._clock = clock
        self._stress: dict[int, tuple[subprocess.Popen[bytes], ...]] = {}
        self._ended: list[subprocess.Popen[bytes]] = []
        self._drifts: dict[int, float] = {}
        """Drifts of the clock that this agent takes part in, 1e-6, by number of the action."""
        own: Mapping[str, OwnAction] = {
            STOP.word: lambda order: self._end_at(order.t_s),
            STRESS.word: self._load,
            STEP_CLOCK.word: self._step_clock,
            DRIFT_CLOCK.word: self._drift_clock,
            DEVICE_FAULT.word: self._device_fault,
        }
        super().__init__(seat.name, declared, call=call, journal=journal, own=own)

    def leave_clock(self) -> None:
        """End the drifts of the clock that were this agent's alone: it is lost, and hears of no end."""
        for number in list(self._drifts):
            self._end_drift(number)

    def close(self) -> None:
        """End what goes on beside the agent."""
        for number in list(self._stress):
            self._end_load(number)
        reap(self._ended)
        self._ended.clear()

    def _load(self, order: ActionOrder) -> None:
        if order.is_end:
            self._end_load(order.number)
            return
        workers = from_mapping(Stress, order.parameters).workers
        try:
            self._stress[order.number] = start_stress_processes(workers)
        except OSError as error:
            raise ActionRefused(f"no process can be started: {error.strerror}") from error

    def _end_load(self, number: int) -> None:
        processes = self._stress.pop(number, ())
        end_stress_processes(processes)
        self._ended += processes

    def _step_clock(self, order: ActionOrder) -> None:
        by_ms = from_mapping(ClockStep, order.parameters).by_ms
        if self._clock.step(order.number, by_ms * 1e-3, monotonic()):
            self._journal.event("clock_stepped", number=order.number, by_ms=by_ms)

    def _drift_clock(self, order: ActionOrder) -> None:
        ppm = from_mapping(ClockDrift, order.parameters).ppm
        if order.is_end:
            self._end_drift(order.number)
        elif order.number not in self._drifts:
            self._drifts[order.number] = ppm
            if self._clock.drift(order.number, ppm, monotonic()):
                self._journal.event("clock_drift_begins", number=order.number, ppm=ppm)

    def _end_drift(self, number: int) -> None:
        ppm = self._drifts.pop(number, None)
        if ppm is not None and self._clock.end_drift(number, monotonic()):
            self._journal.event("clock_drift_ends", number=number, ppm=ppm)

    def _device_fault(self, order: ActionOrder) -> None:
        fault = from_mapping(DeviceFault, order.parameters)
        device = self._hardware.get(fault.device)
        if device is None:
            known = ", ".join(self._hardware) or "none"
            raise ActionRefused(f"this agent uses no device {fault.device!r}; it uses {known}")
        word, value = ("clear", None) if order.is_end else (fault.fault, fault.value)
        try:
            check_fault(word, value)
            check_fault_fits(word, device.channels.values())
        except ConfigurationError as error:
            raise ActionRefused(str(error)) from None
        device.order_fault(timeline_order(order.number, is_end=order.is_end), word, value)
