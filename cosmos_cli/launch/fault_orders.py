"""Orders to insert a fault around a device of the living run: who carries them out, and what became of each. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial

from cosmos_cli.launch import actions
from cosmos_cli.launch.actions import Agenda
from cosmos_cli.launch.child_commands import fault_recorded, inject
from cosmos_cli.launch.children import Children
from cosmos_cli.launch.events import FaultInserted
from cosmos_cli.launch.run_events import FaultOrdered
from madns_runtime.config import DeviceLaunch

ANSWER_S = 5.0
"""A supervisor that has not answered by then is not waited for."""
SHOWN_MAX = 20


class FaultOrders:
    """
    The orders that wait for their supervisor's answer.

    Args:
        agenda: The supervision's.
        children: Of the run.
        devices: By machine: what it drives.
    """

    def __init__(
        self,
        agenda: Agenda,
        children: Children,
        devices: Mapping[str, tuple[DeviceLaunch, ...]],
    ) -> None:
        self._agenda = agenda
        self._children = children
        self._machine_of = {
            each.full_name: machine for machine, there in devices.items() for each in there
        }
        self._waiting: dict[int, FaultOrdered] = {}

    def ordered(self, order: FaultOrdered) -> None:
        """Pass an order on to the supervisor that drives the device, or refuse it."""
        machine = self._machine_of.get(order.target)
        if machine is None:
            shown = ", ".join(list(self._machine_of)[:SHOWN_MAX]) or "none"
            self._answer(order, f"no device {order.target!r} in this run; there are {shown}")
            return
        child = next(self._living_on(machine), None)
        if child is None:
            self._answer(order, f"nobody drives {order.target} at present")
            return
        self._waiting[order.number] = order
        self._agenda.do(actions.Send(child, inject(order)))
        late = f"{machine} has not answered within {ANSWER_S:g} s"
        self._agenda.after(self._name(order), ANSWER_S, partial(self._answer, order, late))

    def answered(self, event: FaultInserted) -> None:
        """Take a supervisor's answer; of an order that is not waited for any more it is no other's."""
        order = self._waiting.get(event.number)
        if order is not None:
            self._answer(order, event.refusal)

    def _answer(self, order: FaultOrdered, refusal: str) -> None:
        """Tell who has ordered it what became of it, and record that."""
        self._waiting.pop(order.number, None)
        self._agenda.cancel(self._name(order))
        self._agenda.do(actions.AnswerOrder(order.number, refusal))
        self._children.tell_host({**fault_recorded(order), "refusal": refusal})
        value = "" if order.value is None else f" {order.value:g}"
        became = f"refused: {refusal}" if refusal else "in force"
        self._agenda.say(f"fault {order.target} {order.action}{value}: {became}", "warning")

    def _living_on(self, machine: str) -> Iterator[str]:
        for child in reversed(self._children.supervisors):
            if child.machine == machine and not child.has_exited:
                yield child.name

    @staticmethod
    def _name(order: FaultOrdered) -> str:
        return f"order {order.number}"
