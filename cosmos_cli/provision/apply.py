"""
Carries a plan out on one machine, in order. A step is before or after, wherever the connection is cut.

Who calls holds the machine's lock. A step that fails ends the plan of its machine: what comes after
may build on it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.layout import Layout
from cosmos_cli.provision.environment import install_environment
from cosmos_cli.provision.step import Done, Kind, Step, StepRequest
from cosmos_cli.provision.trees import Progress, send_tree
from cosmos_cli.provision.up_view import MachineTeller
from cosmos_cli.ui.step_times import timed

OWN_KINDS = (
    FailureKind.STEP,
    FailureKind.TIMEOUT,
    FailureKind.DATA,
    FailureKind.UNSUPPORTED,
    FailureKind.DISK_FULL,
    FailureKind.READ_ONLY,
    FailureKind.BUSY,
)
"""Failures of a step itself, told with its title; others are the machine's or the connection's."""
REPEAT = "repeat `cosmos up` when it answers again: it goes on from there"


@dataclass(slots=True, kw_only=True)
class Applier:
    """
    Carries steps out on one machine.

    Args:
        helper: What works there, started with all parts that steps need.
        layout: Of the machine.
        teller: Told each step as it begins, and how far a long one is.
    """

    helper: Helper
    layout: Layout
    teller: MachineTeller
    done: list[Done] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def apply(self, steps: Sequence[Step]) -> None:
        """
        Carry them out; `done` tells what came of each that ended well.

        Raises:
            MachineFailure: Of the first that failed.
        """
        for step in steps:
            self.teller.step(step.title)
            try:
                with timed(self.helper.machine, step.title):
                    changed = self._carry_out(step)
            except MachineFailure as failure:
                raise _of_step(step, failure) from None
            self.done.append(Done(step=step, changed=changed))

    def _carry_out(self, step: Step) -> bool:
        if step.kind in _SENDERS:
            return _SENDERS[step.kind](self.helper, self.layout, step.subject, self._tell_share)
        return any([self._ask(request, step) for request in step.requests])  # every one is asked

    def _ask(self, request: StepRequest, step: Step) -> bool:
        how: dict[str, Any] = {"as_root": request.as_root, "timeout_s": request.timeout_s}
        if not request.streams:
            answer = self.helper.call(request.verb, request.arguments, body=request.body, **how)
            return _has_changed(request.verb, answer.value)
        value: Mapping[str, Any] = {}
        for piece in self.helper.pieces(
            request.verb, request.arguments, **how, whole_s=request.whole_s
        ):
            value = piece.value or {}
            if value.get("doing"):
                self.teller.detail(str(value["doing"]))
        self.notes += [f"{step.title}: {note}" for note in value.get("notes") or ()]
        return _has_changed(request.verb, value)

    def _tell_share(self, what: str, share: float) -> None:
        self.teller.detail(f"{what} ({share:.0%})")


_SENDERS: Mapping[Kind, Callable[[Helper, Layout, Any, Progress], bool]] = {
    Kind.ENVIRONMENT: install_environment,
    Kind.TREE: send_tree,
}
"""Steps that are more than requests."""
_CHANGES: Mapping[str, Callable[[Any], Any]] = {
    "packages": lambda value: value.get("changes"),
    "command": lambda value: value.get("ran"),
    "prune_installed": lambda value: any(value.values()),
    "service": lambda value: value.get("did"),
    "set_values": lambda value: True,
}
"""Whether the answer of a verb tells of a change; of other verbs the answer itself does."""


def _has_changed(verb: str, value: Any) -> bool:
    return bool(_CHANGES.get(verb, bool)(value))


def _of_step(step: Step, failure: MachineFailure) -> MachineFailure:
    if failure.kind is FailureKind.LOST:
        return MachineFailure(failure.kind, f"{failure.text}, at {step.title}", REPEAT)
    if failure.kind not in OWN_KINDS:
        return failure
    return MachineFailure(failure.kind, f"{step.title}: {failure.text}", failure.advice)
