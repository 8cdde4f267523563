"""Commands to the children of a run, as they go over their lines. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cosmos_cli.launch.events import DeviceChanged
from cosmos_cli.launch.run_events import FaultOrdered

Command = Mapping[str, Any]

STOP: Command = {"command": "stop", "reason": "the run is over"}


def stop_host(status: str, why: str, who: str) -> Command:
    """Return the order to end the run with *status*, for what *who* did."""
    order = {"command": "stop", "reason": why, "status": status}
    return order if who == "operator" else {**order, "who": who}


def agent_exited(agent: str, how: str, pid: int | None) -> Command:
    """Return word of an agent's process that has ended."""
    return {"command": "agent_exited", "agent": agent, "how": how, "pid": pid}


def device_changed(event: DeviceChanged) -> Command:
    """Return word of a device's status, for the host's log."""
    return {
        "command": "device",
        "device": event.device,
        "status": event.status,
        "why": event.why,
    }


def inject(order: FaultOrdered) -> Command:
    """Return the order to insert a fault around a device; its answer bears the same number, beside the line's own."""
    return {**fault_recorded(order), "order": order.number}


def fault_recorded(order: FaultOrdered) -> Command:
    """Return such an order as the host records it, with what became of it."""
    return {
        "command": "inject",
        "target": order.target,
        "action": order.action,
        "value": order.value,
    }


def ping(number: int) -> Command:
    """Return the question for a sign of life."""
    return {"command": "ping", "n": number}
