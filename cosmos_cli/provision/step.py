"""A step of provisioning: one frozen value that says what it does to people, and how to the machine. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

REQUEST_TIMEOUT_S = 30.0


class Kind(StrEnum):
    """Kinds of change; scripts may rely on these words."""

    DIRECTORY = "directory"
    PACKAGE = "package"
    FILE = "file"
    LINE = "line"
    SERVICE = "service"
    COMMAND = "command"
    SETTING = "setting"
    ENVIRONMENT = "environment"
    TREE = "tree"
    PRUNE = "prune"
    CHECK = "check"


@dataclass(frozen=True, slots=True, kw_only=True)
class StepRequest:
    """Request to a machine: a verb of the helper there."""

    verb: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    body: bytes = field(default=b"", repr=False)
    as_root: bool = False
    timeout_s: float = REQUEST_TIMEOUT_S
    """For the answer; of one that streams, for each sign of life."""
    whole_s: float = REQUEST_TIMEOUT_S
    """For all of an answer that streams."""
    streams: bool = False
    """Whether the answer comes in parts: signs of life, and the result as the last one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """A content before and after, for --diff; None where there is no text."""

    path: str
    before: str | None
    after: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One thing that must change."""

    kind: Kind
    title: str
    """For people, such as "package i2c-tools: install"."""
    requests: tuple[StepRequest, ...] = ()
    """In this order; a cut between two of them is repaired by the next `up`."""
    subject: Any = None
    """Subject of the step, where others ask: an environment, a tree, the name of a setting."""
    change: Change | None = None
    size_bytes: int = 0
    """Room that it takes on the machine's disk."""

    @property
    def needs_root(self) -> bool:
        """Whether any of it is done as root."""
        return any(request.as_root for request in self.requests)


@dataclass(frozen=True, slots=True, kw_only=True)
class Done:
    """A step that was carried out, or would be."""

    step: Step
    changed: bool

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for --json."""
        return {"kind": self.step.kind.value, "title": self.step.title, "changed": self.changed}
