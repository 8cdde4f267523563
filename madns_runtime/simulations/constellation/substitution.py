"""Names in braces, as ${satellite}, in what a scenario says of each vehicle's flight software. Pure."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Final

NAMES: Final = ("name", "index", "satellite")
"""The agent's, its place among the agents from 0, its satellite's."""
PATTERN: Final = re.compile(r"\$(\$?)\{([^{}]*)\}?")


def substitute(text: str, values: Mapping[str, str]) -> str:
    """Return a text with each ${name} replaced; $${ stands for ${ itself, and an unknown name stays."""

    def replaced(match: re.Match[str]) -> str:
        if match[1]:
            return match[0][1:]
        return values.get(match[2], match[0]) if match[0].endswith("}") else match[0]

    return PATTERN.sub(replaced, text)


def unknown_names(text: str, known: tuple[str, ...]) -> list[str]:
    """Return each ${...} of a text that stands for nothing."""
    return [
        match[0]
        for match in PATTERN.finditer(text)
        if not match[1] and not (match[0].endswith("}") and match[2] in known)
    ]


def substitution_faults(field: str, text: str, known: tuple[str, ...]) -> Iterator[str]:
    """Yield a fault for each ${...} of a field's text that stands for nothing."""
    expected = ", ".join(f"${{{name}}}" for name in known)
    for found in unknown_names(text, known):
        yield f"{field}: expected one of {expected}, got {found}; $${{ stands for ${{ itself"
