"""Orders of the operator in the midst of a run in real time, taken from their JSON lines and carried out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from time import monotonic
from typing import Any

from madns_runtime.protocol.host_session import HostSession
from madns_runtime.recording.run_journal import RunJournal


class OperatorOrders:
    """
    Carries out orders.

    Args:
        session: Of the run; the end of an agent's process is told to it.
        journal: Of the host.
        end: Ends the run, given who wants it, why, and the status.
        refuse: Takes an order that is none here.
    """

    def __init__(
        self,
        session: HostSession,
        journal: RunJournal,
        *,
        end: Callable[[str, str, str], None],
        refuse: Callable[[Mapping[str, Any]], None],
    ) -> None:
        self._session = session
        self._journal = journal
        self._end = end
        self._refuse = refuse

    def obey(self, order: Mapping[str, Any]) -> None:
        """Carry one out."""
        match order:
            case {"command": "stop"}:
                reason = str(order.get("reason", "stopped by the operator"))
                who, status = order.get("who", "operator"), order.get("status", "interrupted")
                self._end(str(who), reason, str(status))
            case {"command": "device", "device": device, "status": status, **rest}:
                why = rest.get("why")
                self._journal.event("device", device=device, status=status, why=why)
                level = "error" if status == "lost" else "info"
                self._journal.say(level, f"device {device}: {status} {why or ''}".rstrip())
            case {"command": "inject", **fault}:
                fault.pop("number", None)  # that of a line between machines
                self._journal.event("fault", **fault)
            case {"command": "agent_exited"}:
                pid = None if order.get("pid") is None else int(order["pid"])
                agent, how = str(order.get("agent")), str(order.get("how"))
                self._session.agent_exited(agent, how, monotonic(), pid=pid)
            case _:
                self._refuse(order)
