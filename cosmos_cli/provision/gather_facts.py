"""Asks a machine for all facts in one question; root is asked again only about what the user is not shown."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from cosmos_cli.fleet.answers.verbs import failure_of
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.target import ROOT_FORBIDDEN
from cosmos_cli.models.machine_facts import MachineFacts, files_of
from cosmos_cli.provision.desired import DesiredState, questions
from cosmos_cli.provision.steps import installed_question

LOOK_TIMEOUT_S = 150.0
"""For one question: all facts, conditions of commands included, or a first start of the runtime."""

_REALTIME_PRIORITY = re.compile(
    r"^Max realtime priority[ \t]+\S+[ \t]+([0-9]{1,9})(?!\S)", re.MULTILINE
)
"""Line of /proc/<pid>/limits, with the hard limit."""

Call = Mapping[str, Any]
"""One of several requests in a frame: "verb" and "arguments"."""
Answer = Mapping[str, Any]
"""Of one of several requests: "ok" and "value", or "error"."""


def fact_calls(
    desired: DesiredState,
    *,
    has_texts: bool,
    is_sudo_asked: bool,
    touch: bool,
) -> list[Call]:
    """
    Return the requests of which `gather_facts` makes facts.

    Args:
        desired: The plan for it decides what must be known.
        has_texts: Whether contents of files are wanted, for --diff.
        is_sudo_asked: Whether anybody becomes root is wanted, too. Such a look follows another one, whose `conditions` hold
            still: they may take a minute each.
        touch: Whether what is wanted and there is remembered as wanted now, so that no other operator prunes it.
    """
    sudo = is_sudo_asked and desired.variables.may_become_root
    asked = {**questions(desired, has_texts=has_texts), "sudo": sudo}
    if is_sudo_asked:
        asked["conditions"] = {}
    return [
        {"verb": "facts", "arguments": asked},
        {"verb": "installed", "arguments": installed_question(desired, touch=touch)},
    ]


def gather_facts(
    helper: Helper, calls: Sequence[Call], *, may_become_root: bool
) -> tuple[MachineFacts, list[Answer]]:
    """
    Ask for all facts at once.

    Args:
        helper: Started with `cosmos_cli.provision.HELPER_PARTS`.
        calls: Those of `fact_calls`, and others for the same frame.
        may_become_root: Whether root is asked about what the user is not shown.

    Returns:
        The facts, and the answers to the other calls, which may be refusals.

    Raises:
        MachineFailure: The connection is lost, or a condition of a command did not end in time.
    """
    asked_utc_s = _utc_s()
    told, installed, *others = several(helper, calls)
    raise_first([told, installed])
    facts = MachineFacts.from_mapping(
        told["value"], asked_utc_s=asked_utc_s, answered_utc_s=_utc_s()
    )
    facts = _with_installed(facts, installed["value"])
    if not may_become_root:
        is_root = facts.uid == 0  # needs no sudo
        refusal = "" if is_root else ROOT_FORBIDDEN
        return dataclasses.replace(facts, can_become_root=is_root, sudo_refusal=refusal), others
    return _with_root(helper, facts, calls[0]["arguments"]), others


def several(helper: Helper, calls: Sequence[Call]) -> list[Answer]:
    """Ask several things in one frame; nothing is asked where there is nothing to ask."""
    if not calls:
        return []
    timeout_s = LOOK_TIMEOUT_S * len(calls)
    return list(helper.call("several", {"calls": list(calls)}, timeout_s=timeout_s).value)


def raise_first(answers: Sequence[Answer]) -> None:
    """
    Raise the first refusal.

    Raises:
        MachineFailure: There is one.
    """
    for answer in answers:
        if not answer["ok"]:
            raise failure_of(answer["error"])


def realtime_priority_of(limits: str) -> int | None:
    """Return the highest real-time priority that a process's limits grant; None for no limit."""
    found = _REALTIME_PRIORITY.search(limits)
    return int(found[1]) if found else None


def _with_installed(facts: MachineFacts, told: Mapping[str, Any]) -> MachineFacts:
    prunable = told.get("prunable") or {}
    return dataclasses.replace(
        facts,
        trees=frozenset(name for name, is_whole in told["trees"].items() if is_whole),
        environments=frozenset(key for key, is_whole in told["environments"].items() if is_whole),
        prunable=tuple(f"{kind}/{name}" for kind, names in prunable.items() for name in names),
        prunable_bytes=told.get("prunable_bytes", 0),
        wheels=frozenset(told.get("wheels") or ()),
        blobs=frozenset(told.get("blobs") or ()),
    )


def _with_root(helper: Helper, facts: MachineFacts, asked: Mapping[str, Any]) -> MachineFacts:
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
        told = helper.call(
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
