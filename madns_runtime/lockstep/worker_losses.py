"""The agents that a worker runs no more while the run goes on without them."""

from __future__ import annotations

from typing import Any

from madns_runtime.lockstep.agent import AgentDevices, LockstepAgent
from madns_runtime.lockstep.frames import Loss


class WorkerLosses:
    """Losses that are still to be told, and what lost agents leave to their next incarnation."""

    def __init__(self) -> None:
        self._untold: dict[int, Loss] = {}
        self._devices: dict[int, AgentDevices] = {}

    def __bool__(self) -> bool:
        return bool(self._untold)

    def add(self, agent: LockstepAgent, reason: str) -> None:
        """Close an agent's records, and keep word of its loss; its devices, made safe, outlive it."""
        # As of a process that a fault ends: it says that it is killed, and no more.
        if not agent.is_killed:
            agent.journal.emergency(reason)
        self._devices[agent.index] = agent.devices
        agent.devices.owner_gone()
        losses = agent.journal.device_losses(agent.devices.hardware.losses())
        self._untold[agent.index] = Loss(
            agent.index,
            reason,
            {**losses, **agent.journal.close().to_mapping()},
            0,
            agent.deadlines_broken,
            agent.mailbox.counts(),
        )

    def unheard(self, index: int) -> bool:
        """Tell whether an agent was lost since the last answer, and count a message that it does not hear."""
        loss = self._untold.get(index)
        if loss is None:
            return False
        self._untold[index] = loss._replace(unheard=loss.unheard + 1)
        return True

    def take(self) -> list[Loss]:
        """Return what is to be told, in the order of agents, and forget it."""
        told = [self._untold[index] for index in sorted(self._untold)]
        self._untold.clear()
        return told

    def devices_of(self, index: int) -> AgentDevices | None:
        """Return the open devices of an agent that returns; None if this worker never had them."""
        devices = self._devices.pop(index, None)
        if devices is not None:
            devices.hardware.forget_statuses()
        return devices

    def follow_devices(self, t_s: float) -> None:
        """Let the devices of lost agents go on to simulated time *t_s*."""
        for devices in self._devices.values():
            devices.follow(t_s)

    def close_devices(self) -> dict[int, dict[str, Any]]:
        """Close those of agents that did not return, and return what the run came to, by agent."""
        counts = {index: devices.close() for index, devices in self._devices.items() if devices}
        self._devices.clear()
        return counts
