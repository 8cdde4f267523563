"""
Carries a plan out on one machine, in order. A step is before or after, wherever the connection is cut.

Who calls holds the machine's lock. A step that fails ends the plan of its machine: what comes after
may build on it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from cosmos_cli.fleet.board import Board
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.layout import Layout
from cosmos_cli.provision.environment import install_environment
from cosmos_cli.provision.step import Kind, Request, Step
from cosmos_cli.provision.trees import send_tree

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Done:
    """A step that was carried out, or would be."""

    step: Step
    changed: bool

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for --json."""
        return {"kind": self.step.kind.value, "title": self.step.title, "changed": self.changed}


class Teller(Protocol):
    """Shows people what is done on one machine."""

    def step(self, title: str) -> None:
        """Say that a step begins."""

    def detail(self, text: str) -> None:
        """Say how far it is, or what else is done; may be left out."""


@dataclass(slots=True, kw_only=True)
class Applier:
    """
    Carries steps out on one machine.

    Args:
        board: What works there, started with all parts that steps need.
        layout: Of the machine.
        teller: Told each step as it begins, and how far a long one is.
    """

    board: Board
    layout: Layout
    teller: Teller
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
                changed = _CARRIERS.get(step.kind, Applier._ask_all)(self, step)
            except MachineFailure as failure:
                raise _of_step(step, failure) from None
            self.done.append(Done(step=step, changed=changed))

    def _ask_all(self, step: Step) -> bool:
        changed = False
        for request in step.requests:
            changed |= self._ask(request, step)
        return changed

    def _ask(self, request: Request, step: Step) -> bool:
        how: dict[str, Any] = {"as_root": request.as_root, "timeout_s": request.timeout_s}
        if not request.streams:
            answer = self.board.call(request.verb, request.arguments, body=request.body, **how)
            return _has_changed(request.verb, answer.value)
        value: Mapping[str, Any] = {}
        for part in self.board.parts(request.verb, request.arguments, **how):
            value = part.value or {}
            if value.get("doing"):
                self.teller.detail(str(value["doing"]))
        self.notes += [f"{step.title}: {note}" for note in value.get("notes") or ()]
        return _has_changed(request.verb, value)

    def _tell_share(self, what: str, share: float) -> None:
        self.teller.detail(f"{what} ({share:.0%})")

    def _environment(self, step: Step) -> bool:
        return install_environment(self.board, self.layout, step.subject, self._tell_share)

    def _tree(self, step: Step) -> bool:
        return send_tree(self.board, self.layout, step.subject, self._tell_share)


_CARRIERS: Mapping[Kind, Callable[[Applier, Step], bool]] = {
    Kind.ENVIRONMENT: Applier._environment,
    Kind.TREE: Applier._tree,
}
"""Steps that are more than requests."""


def _has_changed(verb: str, value: Any) -> bool:
    match verb:
        case "packages":
            return bool(value.get("changes"))
        case "command":
            return bool(value.get("ran"))
        case "prune_installed":
            return any(value.values())
        case "service" | "set_values":
            return True
    return bool(value)


def _of_step(step: Step, failure: MachineFailure) -> MachineFailure:
    if failure.kind is FailureKind.LOST:
        return MachineFailure(failure.kind, f"{failure.text}, at {step.title}", REPEAT)
    if failure.kind not in OWN_KINDS:
        return failure
    return MachineFailure(failure.kind, f"{step.title}: {failure.text}", failure.advice)
