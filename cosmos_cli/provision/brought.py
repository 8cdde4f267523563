"""What was asked of `cosmos up`, and what became of one machine."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

from cosmos_cli.fleet.failure import MachineFailure
from cosmos_cli.provision.apply import Done
from cosmos_cli.provision.facts import Facts
from cosmos_cli.provision.step import Step


@dataclass(frozen=True, slots=True, kw_only=True)
class UpOptions:
    """What `cosmos up` was asked for."""

    is_check: bool = False
    """Show the plan and change nothing."""
    has_texts: bool = False
    """Contents of files are wanted, for --diff."""
    host: str | None = None
    """The machine that will run the host's half; None for this computer."""


@dataclass(slots=True, kw_only=True)
class Brought:
    """What became of one machine; filled while it is worked on, so that a failure hides nothing."""

    facts: Facts | None = None
    planned: tuple[Step, ...] = ()
    done: Sequence[Done] = ()
    notes: list[str] = dataclasses.field(default_factory=list)
    failure: MachineFailure | None = None
    is_local: bool = False

    @property
    def changed_count(self) -> int:
        """How many steps changed something, or would."""
        return sum(done.changed for done in self.done)
