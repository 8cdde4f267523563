"""Tells functions of which a call does nothing yet: coroutines and generators, whose body runs when they are awaited or asked. Pure."""

from __future__ import annotations

import inspect
from typing import Any


def deferral_fault(function: Any) -> str:
    """Return why a call of a plug-in's method would not run its body, for after its name; an empty text if it does."""
    if inspect.iscoroutinefunction(function):
        return "must be a plain def: nobody awaits it, so that its body would never run"
    if inspect.isgeneratorfunction(function) or inspect.isasyncgenfunction(function):
        return "must not yield: nobody asks it for values, so that its body would never run"
    return ""
