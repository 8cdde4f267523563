"""Checks that the halves of a simulation return in their summaries: what is one, and the worst of each name. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from cosmos_cli.evidence.verdict import CheckResult, is_number
from cosmos_cli.ui.foreign_text import clean_line
from madns_runtime.plain_values import LINE_CHARACTERS_MAX, is_line


def plugin_checks(summaries: Mapping[str, Mapping[str, Any]]) -> list[CheckResult]:
    """
    Return the plug-in's own checks over the host's or all agents' summaries, the worst of each name.

    Worst is a check that did not pass, then the one with the largest excess over its limit; it bears the
    name of whose it is, unless it holds and is the same for all. A value that is not finite was not
    measured. What is no list, or in it no proper `Check` mapping, is a broken check named WHO.checks: a
    verdict must not depend on a typing slip.

    Args:
        summaries: By who made them.
    """
    worst: dict[str, CheckResult] = {}
    is_alike: dict[str, bool] = {}
    for who, summary in summaries.items():
        for item in listed_checks(summary):
            check = _parse_check(item, who)
            known = worst.get(check.name)
            if known is not None:
                same = known.passed and check.passed and known.got == check.got
                is_alike[check.name] = is_alike.get(check.name, True) and same
            if known is None or _badness(check) > _badness(known):
                worst[check.name] = check
    return [
        replace(check, worst=None) if is_alike.get(name) else check for name, check in worst.items()
    ]


def _parse_check(item: Any, who: str) -> CheckResult:
    if check_fault(item):
        return CheckResult(name=f"{who}.checks", limit=0, got=None, passed=False, worst=who)
    got, told = item.get("got"), item.get("worst")
    return CheckResult(
        name=item["name"],
        limit=item["limit"],
        got=got if is_number(got) else None,
        passed=is_number(got) and item["passed"],
        worst=told if told and is_line(told) else who,
    )


def listed_checks(summary: Mapping[str, Any]) -> Sequence[Any]:
    """Return the checks in a half's summary; what is no list is taken for one malformed check."""
    listed = summary.get("checks", ())
    return listed if isinstance(listed, list | tuple) else (f"{listed!r:.80}",)


def check_fault(item: Any) -> str:
    """Return why an entry of a summary's checks is none; empty if it is one."""
    if not isinstance(item, Mapping):
        text = clean_line(item if isinstance(item, str) else repr(item), length_max=80)
        return f"expected a list of mappings, got {text}"
    name, limit, got, passed = (item.get(key) for key in ("name", "limit", "got", "passed"))
    for key, is_fit, wanted in (
        (
            "name",
            name and is_line(name),
            f"a name of at most {LINE_CHARACTERS_MAX} printable characters",
        ),
        ("limit", is_number(limit), "a finite number"),
        ("got", is_number(got) or got is None or isinstance(got, float), "a number"),
        ("passed", isinstance(passed, bool), "true or false"),
    ):
        if not is_fit:
            return f"{key} of {name!r:.80}: expected {wanted}, got {item.get(key)!r:.80}"
    return ""


def _badness(check: CheckResult) -> tuple[bool, float]:
    excess = float("inf") if check.got is None else abs(check.got - check.limit)
    return (not check.passed, excess if not check.passed else -excess)
