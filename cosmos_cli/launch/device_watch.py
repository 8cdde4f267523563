"""Devices of a run as its operator hears of them, and which loss ends the run. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Literal

from cosmos_cli.launch.actions import Agenda
from cosmos_cli.launch.events import DeviceChanged
from madns_runtime.config import DeviceLaunch

LOST = "lost"
LEVELS = {"lost": "error", "stale": "warning"}
"""How loud a status is told; others are news."""

TOLD_MAX = 20
"""Changes of one device that are shown; its losses always are."""


def with_devices(devices: Iterable[DeviceLaunch], machine: str) -> str:
    """Return what a loss of a machine is told with: the devices that hang on it."""
    names = [device.full_name for device in devices if device.place == machine]
    return f", with {', '.join(names)}" if names else ""


class DeviceWatch:
    """
    The statuses of all devices.

    Args:
        agenda: The supervision's.
        on_loss: hardware.on_device_loss of the scenario.
        record: Takes what is to stand in the run's log.
        abort: Called with the device's full name and the reason, once, when a loss ends the run.
    """

    def __init__(
        self,
        agenda: Agenda,
        on_loss: Literal["abort", "continue"],
        *,
        record: Callable[[DeviceChanged], None],
        abort: Callable[[str, str], None],
    ) -> None:
        self._agenda = agenda
        self._is_ruled = on_loss == "abort"
        self._record = record
        self._abort = abort
        self._lost: dict[str, str] = {}
        """Devices that are lost at present, and why."""
        self._told: dict[str, int] = {}
        self._is_running = self._is_over = False

    def heard(self, event: DeviceChanged) -> None:
        """Take note of a device's status; what comes when the run is over is no news."""
        if self._is_over:
            return
        self._tell(event)
        self._record(event)
        self._lost.pop(event.device, None)
        if event.status == LOST:
            self._lost[event.device] = event.why
            self._rule()

    def machine_lost(self, devices: Iterable[DeviceLaunch], machine: str, why: str) -> None:
        """Take the devices that hang on a lost machine for lost; a scenario's own come back with their agents."""
        for device in devices:
            if device.place == machine:
                self.heard(DeviceChanged(device=device.full_name, status=LOST, why=why))

    def running(self) -> None:
        """Let simulated time run: from now on a loss counts, and so does one that was not mended by now."""
        self._is_running = True
        self._rule()

    def over(self) -> None:
        """Expect nothing more: devices are closed at the end of a run."""
        self._is_over = True

    def _tell(self, event: DeviceChanged) -> None:
        """Show a change; not that a device has come up, and of one that flaps not all."""
        level, told = LEVELS.get(event.status, "info"), self._told.get(event.device, 0)
        if level == "info" and not told:
            return
        self._told[event.device] = told + 1
        if told < TOLD_MAX or event.status == LOST:
            self._agenda.say(event.text, level)
        elif told == TOLD_MAX:
            text = f"device {event.device}: what else changes stands in the host's events alone"
            self._agenda.say(text, "warning")

    def _rule(self) -> None:
        if not (self._is_ruled and self._is_running and self._lost) or self._is_over:
            return
        self._is_over = True
        device, why = next(iter(self._lost.items()))
        self._abort(device, f"lost: {why or 'it gives no samples'}")
