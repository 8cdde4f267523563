"""Asks a machine for all facts in one question; root is asked again only about what the user is not shown."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from cosmos_cli.fleet.board import Board
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.provision.facts import Facts, files_of
from cosmos_cli.provision.settings import setting_files
from cosmos_cli.provision.steps import installed_question
from cosmos_cli.provision.wanted import Wanted, questions

LOOK_TIMEOUT_S = 150.0
"""For one question: all facts, conditions of commands included, or a first start of the runtime."""

Answer = Mapping[str, Any]
"""Of one of several requests: "ok" and "value", or "error"."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Question:
    """What a machine is asked."""

    wanted: Wanted
    """The plan for it decides what must be known."""
    has_texts: bool = False
    """Contents of files are wanted, for --diff."""
    is_sudo_asked: bool = False
    """Whether anybody becomes root is wanted, too."""
    touch: bool = False
    """What is wanted and there is remembered as wanted now, so that no other operator prunes it."""


def look(
    board: Board, question: Question, also: Sequence[Mapping[str, Any]] = ()
) -> tuple[Facts, list[Answer]]:
    """
    Ask for all facts at once.

    Args:
        board: Started with `cosmos_cli.provision.parts.HELPER_PARTS`.
        question: What is asked.
        also: Further requests for the same frame: "verb" and "arguments".

    Returns:
        The facts, and the answers to *also*, which may be refusals.

    Raises:
        MachineFailure: The connection is lost, or a condition of a command did not end in time.
    """
    wanted = question.wanted
    asked = questions(
        wanted,
        setting_files=setting_files(wanted.paths),
        has_texts=question.has_texts,
    )
    is_sudo_asked = question.is_sudo_asked and wanted.may_become_root
    calls = [
        {"verb": "facts", "arguments": {**asked, "sudo": is_sudo_asked}},
        {"verb": "installed", "arguments": installed_question(wanted, touch=question.touch)},
        *also,
    ]
    asked_utc_s = _utc_s()
    told, installed, *others = several(board, calls)
    raise_first([told, installed])
    facts = Facts.from_mapping(told["value"], asked_utc_s=asked_utc_s, answered_utc_s=_utc_s())
    facts = _with_installed(facts, installed["value"])
    if not wanted.may_become_root:
        return dataclasses.replace(facts, can_become_root=False), others
    return _with_root(board, facts, asked), others


def several(board: Board, calls: Sequence[Mapping[str, Any]]) -> list[Answer]:
    """Ask several things in one frame; nothing is asked where there is nothing to ask."""
    if not calls:
        return []
    timeout_s = LOOK_TIMEOUT_S * len(calls)
    answers: list[Answer] = board.call("several", {"calls": list(calls)}, timeout_s=timeout_s).value
    return answers


def raise_first(answers: Sequence[Answer]) -> None:
    """
    Raise the first refusal.

    Raises:
        MachineFailure: There is one.
    """
    for answer in answers:
        if not answer["ok"]:
            error = answer["error"]
            raise MachineFailure(FailureKind(error["kind"]), error["text"], error["advice"])


def realtime_priority_of(limits: str) -> int | None:
    """Return the highest real-time priority that a process's limits grant; None for no limit."""
    for line in limits.splitlines():
        if line.startswith("Max realtime priority"):
            hard = line.split()[4]
            return int(hard) if hard.isdecimal() else None
    return None


def _with_installed(facts: Facts, told: Mapping[str, Any]) -> Facts:
    prunable = told.get("prunable") or {}
    return dataclasses.replace(
        facts,
        trees=frozenset(name for name, is_whole in told["trees"].items() if is_whole),
        environments=frozenset(key for key, is_whole in told["environments"].items() if is_whole),
        prunable=tuple(f"{kind}/{name}" for kind, names in prunable.items() for name in names),
    )


def _with_root(board: Board, facts: Facts, asked: Mapping[str, Any]) -> Facts:
    """Ask root about what the user is not shown; where nobody becomes root it stays unknown."""
    files = {
        path: asked["files"][path] for path, fact in facts.files.items() if fact.kind == "denied"
    }
    conditions = {
        key: asked["conditions"][key]
        for key, is_done in facts.conditions.items()
        if is_done is None
    }
    if not files and not conditions:
        return facts
    try:
        told = board.call(
            "look",
            {"files": files, "conditions": conditions},
            as_root=True,
            timeout_s=LOOK_TIMEOUT_S,
        ).value
    except MachineFailure as failure:
        if failure.kind is not FailureKind.NO_SUDO:
            raise
        return facts
    return dataclasses.replace(
        facts,
        files={**facts.files, **files_of(told)},
        conditions={**facts.conditions, **told["conditions"]},
    )


def _utc_s() -> float:
    return datetime.now(UTC).timestamp()
