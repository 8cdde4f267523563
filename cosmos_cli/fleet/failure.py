"""Why a machine could not do what it was asked to, in words, and what to do about it."""

from __future__ import annotations

from enum import StrEnum
from typing import Any

SAID_CHARACTERS_MAX = 200


class FailureKind(StrEnum):
    """Kinds of failure; scripts may rely on these words."""

    UNREACHABLE = "unreachable"
    """No route, or nothing answers."""
    REFUSED = "refused"
    """The machine answers, but no SSH server listens on that port."""
    FROZEN = "frozen"
    """The connection opens, but nothing is said: a hung machine, or one that is just starting."""
    HOST_KEY_CHANGED = "host_key_changed"
    HOST_KEY_UNKNOWN = "host_key_unknown"
    AUTHENTICATION = "authentication"
    """Wrong key or wrong user, the server does not tell which; or a user who may run no commands."""
    LOST = "lost"
    """The connection broke, or the machine stopped answering, in the midst of it."""
    TIMEOUT = "timeout"
    """The machine answers, but did not finish in time."""
    PYTHON = "python"
    """No Python there, or one that is too old."""
    NO_SUDO = "no_sudo"
    DISK_FULL = "disk_full"
    READ_ONLY = "read_only"
    BUSY = "busy"
    """Another command works there."""
    STEP = "step"
    """A step of provisioning failed; the text quotes its last words."""
    UNSUPPORTED = "unsupported"
    """The request cannot be carried out on such a machine."""
    DATA = "data"
    """The data that came are not those announced."""
    DEFECT = "defect"
    """COSMoS itself is to blame."""


ELSEWHERE_NOW = (FailureKind.UNREACHABLE, FailureKind.REFUSED, FailureKind.HOST_KEY_CHANGED)
"""Failures of a machine whose address may be another by now."""


class MachineFailure(Exception):
    """
    One machine's failure. Others' results are never hidden by it.

    Args:
        kind: What went wrong.
        text: A sentence with what was expected and what came; without the machine's name.
        advice: What to do, starting with a small letter; may be empty.
    """

    def __init__(self, kind: FailureKind, text: str, advice: str = "") -> None:
        super().__init__(f"{text}; {advice}" if advice else text)
        self.kind = kind
        self.text = text
        self.advice = advice

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for --json."""
        return {"kind": self.kind.value, "text": self.text, "advice": self.advice}


class EndedEarly(MachineFailure):
    """A program that ended by itself before it was told to; its kind is LOST."""


def ended_early(said: str, exit_status: int | None) -> EndedEarly:
    """
    Return the failure of a program that ended before it was told to.

    Args:
        said: What it wrote to standard error.
        exit_status: Negative for a signal; None when nobody knows.
    """
    said = said.strip()
    by_signal = f" (signal {-exit_status})" if exit_status is not None and exit_status < 0 else ""
    return EndedEarly(
        FailureKind.LOST,
        f"what worked there ended early{by_signal}" + (f": {said}" if said else ""),
    )


def runs_no_commands(status: int, said: str) -> MachineFailure:
    """Return the failure of a machine that lets somebody in and then runs nothing, with what it said."""
    words = " ".join(said.split())[:SAID_CHARACTERS_MAX]
    return MachineFailure(
        FailureKind.AUTHENTICATION,
        f"the login works, but no command does: exit status {status}"
        + (f": {words}" if words else ""),
        "give the user a login shell there (`sudo chsh -s /bin/bash USER`) with start-up files that let commands"
        " run, or name another user in ansible_user",
    )


def unexpected(error: Exception) -> MachineFailure:
    """Return the failure of a machine at which something happened that nobody thought of."""
    return MachineFailure(
        FailureKind.DEFECT,
        f"unexpected {type(error).__name__}: {error}",
        "this is a defect of COSMoS, please report it",
    )
