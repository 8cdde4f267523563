"""Devices of a run that goes on without its operator: the host hears of their losses, and takes orders of faults."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Final

from madns_runtime.errors import MadnsError
from madns_runtime.hardware.order_socket import Fault, OrderSocket
from madns_runtime.plugin.context import clean_text
from madns_runtime.protocol.messages import FaultOrder, Service
from madns_runtime.realtime.host_core import RealtimeCore

ANSWER_S: Final = 5.0
"""An agent that has not answered an order by then is not waited for."""
LOOK_PERIOD_S: Final = 0.1
"""Time between two looks at the agents' pings, while an order waits for its answer."""
SHOWN_MAX: Final = 20
TEXT_CHARACTERS_MAX: Final = 500


@dataclass(frozen=True, slots=True)
class _Order:
    fault: Fault
    agent: str
    """Passes it on, and answers."""
    until_s: float


class UnwatchedDevices:
    """
    Does for the devices of a detached run what its operator would do; nothing in other runs.

    Agents that use a device tell of its losses and of answers to orders in the report of their pings.

    Args:
        core: Of the host.
    """

    def __init__(self, core: RealtimeCore) -> None:
        launch, reactor = core.launch, core.reactor
        self._session = core.port.session
        self._journal = core.journal
        self._end = core.end
        self._pump = core.pump
        self._does_abort = launch.config.hardware.on_device_loss == "abort"
        self._users = {each.full_name: each.users for each in launch.devices}
        self._told: set[tuple[str, str]] = set()
        self._orders: dict[int, _Order] = {}
        self._socket: OrderSocket | None = None
        self._reactor = reactor
        self._timer = reactor.call_at(math.inf, self._look_again)
        if not launch.is_detached or not launch.devices:
            return
        try:
            self._socket = OrderSocket(Path(launch.directory).parent, reactor, self._ordered)
        except OSError as error:
            core.journal.say("warning", f"no fault can be inserted in this run: {error}")

    def look(self) -> None:
        """Take what the agents' newest pings say."""
        for name, peer in self._session.peers.items():
            lost = peer.report.get("lost_device")
            if isinstance(lost, list | tuple) and len(lost) == 2 and lost[0] in self._users:
                self._lost(str(lost[0]), clean_text(str(lost[1]))[:TEXT_CHARACTERS_MAX])
            answers = peer.report.get("fault_answers")
            for number, refusal in answers if isinstance(answers, list | tuple) else ():
                order = self._orders.get(number)
                if order is not None and order.agent == name:
                    self._answer(number, clean_text(str(refusal))[:TEXT_CHARACTERS_MAX])

    def close(self) -> None:
        """Take no more orders."""
        for number in list(self._orders):
            self._answer(number, "the run is over")
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _lost(self, device: str, why: str) -> None:
        if (device, why) in self._told:
            return
        self._told.add((device, why))
        self._journal.event("device", device=device, status="lost", why=why)
        self._journal.say("error", f"device {device}: lost {why}".rstrip())
        if self._does_abort:
            self._end(device, f"lost: {why or 'it gives no samples'}", "failed")

    # Orders -------------------------------------------------------------------------------------

    def _ordered(self, number: int, fault: Fault) -> None:
        """Pass an order on to an agent that uses the device, or refuse it."""
        device, action, value = fault
        users = self._users.get(device)
        self._orders[number] = _Order(fault, "", monotonic() + ANSWER_S)
        if users is None:
            shown = ", ".join(list(self._users)[:SHOWN_MAX]) or "none"
            self._answer(number, f"no device {device!r} in this run; there are {shown}")
            return
        message = FaultOrder(number, device, action, math.nan if value is None else value)
        for agent in users:
            if self._send(agent, message):
                self._orders[number] = _Order(fault, agent, monotonic() + ANSWER_S)
                self._timer.reschedule(monotonic() + LOOK_PERIOD_S)
                self._pump()
                return
        self._answer(number, f"no agent that uses {device} is there at present")

    def _send(self, agent: str, message: FaultOrder) -> bool:
        try:
            return self._session.send(agent, message, Service.RELIABLE, monotonic())
        except MadnsError:  # it takes nothing
            return False

    def _look_again(self) -> None:
        self.look()
        now_s = monotonic()
        for number, order in list(self._orders.items()):
            if now_s > order.until_s:
                self._answer(number, f"{order.agent} has not answered within {ANSWER_S:g} s")
        self._timer.reschedule(now_s + LOOK_PERIOD_S if self._orders else math.inf)

    def _answer(self, number: int, refusal: str) -> None:
        device, action, value = self._orders.pop(number).fault
        self._journal.event("fault", target=device, action=action, value=value, refusal=refusal)
        if self._socket is not None:
            self._socket.answer(number, refusal)
