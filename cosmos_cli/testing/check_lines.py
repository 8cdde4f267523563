"""Broken checks and figures in words. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def broken_checks(document: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the checks of a run.json that do not hold."""
    checks = document.get("checks")
    listed = checks if isinstance(checks, list) else []
    return [c for c in listed if isinstance(c, Mapping) and c.get("passed") is False]


def check_line(check: Mapping[str, Any]) -> str:
    """Return a broken check in words: name, what came, the limit, the worst agent and when."""
    unit = f" {check['unit']}" if check.get("unit") else ""
    value, limit = check.get("got"), check.get("limit")
    is_told_apart = shown(value) != shown(limit) or value == limit
    words = shown(value) if is_told_apart else str(value)  # broken by its later digits
    got = "not measured" if value is None else f"{words}{unit}"
    whose = check.get("agent") or check.get("worst")
    at = f" at {shown(check['t_s'])} s" if check.get("t_s") is not None else ""
    who = f", worst: {whose}{at}" if whose else at
    return f"{check.get('name')}: got {got}, limit {shown(limit)}{unit}{who}"


def shown(value: object) -> str:
    """Return a figure for people."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return f"{value:.10g}"
    return "none" if value is None else str(value)
