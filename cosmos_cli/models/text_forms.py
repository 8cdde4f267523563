"""Texts with a form of their own, such as a package's name: what fits, and how it is told when it does not."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

TEXT_CHARACTERS_MAX = 4096
NAME_PATTERN = "^[a-z0-9][a-z0-9-]*$"
"""Of scenarios. It stands here so that inventories are read without importing what scenarios are made of."""


def like(
    pattern: str, expected: str, *, holds: Callable[[re.Match[str]], bool] = bool
) -> BeforeValidator:
    """
    Return a validator of texts that *pattern* fits as a whole; it sees the value before its type is looked at.

    Args:
        pattern: A regular expression.
        expected: What a person reads after "expected".
        holds: Tells of a text that fits whether it holds what no pattern can ask for.
    """

    def check(text: Any) -> Any:
        if not isinstance(text, str):
            raise ValueError(f"expected {expected}")
        if len(text) > TEXT_CHARACTERS_MAX:
            raise ValueError(f"expected at most {TEXT_CHARACTERS_MAX} characters")
        # Compiled with the first text: few commands meet one of every form, and all of them would take 20 ms.
        found = re.fullmatch(pattern, text)
        if found is None or not holds(found):
            raise ValueError(f"expected {expected}")
        return text

    return BeforeValidator(check)


def compile_expression(text: str) -> re.Pattern[str]:
    """
    Compile a regular expression that a person wrote.

    Raises:
        ValueError: It is none, or too large for Python.
    """
    try:
        return re.compile(text)
    except RecursionError:
        why = "its brackets are nested too deeply"
    except (re.error, OverflowError) as error:
        why = str(error)
    raise ValueError(f"not a regular expression: {why}")


def _has_items(value: Any) -> Any:
    if isinstance(value, list | tuple) and not value:
        raise ValueError("expected at least one item")
    # Strict validation takes no list here.
    return tuple(value) if isinstance(value, list) else value


NOT_EMPTY = BeforeValidator(_has_items)
"""For lists. Pydantic's own bound counts the items that are right, and so tells a second fault beside a wrong one."""

_NAME = r"[A-Za-z0-9](?:[A-Za-z0-9._-]*[A-Za-z0-9])?"
_EXTRAS = rf"(?:[ \t]*\[[ \t]*{_NAME}(?:[ \t]*,[ \t]*{_NAME})*[ \t]*\])?"
_RELEASE = r"v?(?:\d+!)?\d+(?:\.\d+)*"
_PHASE = (
    r"(?:[._-]?(?:alpha|a|beta|b|preview|pre|c|rc)[._-]?\d*)?"
    r"(?:-\d+|[._-]?(?:post|rev|r)[._-]?\d*)?(?:[._-]?dev[._-]?\d*)?"
)
_LOCAL = r"(?:\+[a-z0-9]+(?:[._-][a-z0-9]+)*)?"
_VERSION = (
    rf"(?ai:===[ \t]*[^\s,;)]+|[=!]=[ \t]*{_RELEASE}(?:\.\*|{_PHASE}{_LOCAL})"
    rf"|~=[ \t]*{_RELEASE}\.\d+{_PHASE}|(?:<=|>=|<|>)[ \t]*{_RELEASE}{_PHASE})"
)
"""As `cosmos up` reads it by packaging.specifiers, whose import would take 10 ms here."""
_VERSIONS = rf"(?:[ \t]*{_VERSION}(?:[ \t]*,[ \t]*{_VERSION})*)?"
_URL = r"[ \t]*@[ \t]*\S+"
_OPERAND = (
    r"(?:python_(?:full_)?version|os[._]name|sys[._]platform|extra"
    r"|platform_(?:release|system)|platform[._](?:version|machine|python_implementation)"
    r"|python_implementation|implementation_(?:name|version)"
    r"""|'[^'\r\n]*'|"[^"\r\n]*")"""
)
_COMPARISON = (
    rf"[ \t(]*{_OPERAND}[ \t]*(?:===?|[<>~!]=|[<>]|\bin\b|\bnot[ \t]+in\b)[ \t]*{_OPERAND}[ \t)]*"
)
_MARKER = rf"(?P<marker>[ \t]*;{_COMPARISON}(?:\b(?:and|or)\b{_COMPARISON})*)?"
"""No pattern counts brackets: see `_are_brackets_closed`."""
_QUOTED = re.compile(r"""'[^']*'|"[^"]*\"""")


def _are_brackets_closed(requirement: re.Match[str]) -> bool:
    """Tell whether each bracket of a requirement's marker is closed, and was opened."""
    depth = 0
    for letter in _QUOTED.sub("", requirement["marker"] or ""):
        depth += (letter == "(") - (letter == ")")
        if depth < 0:
            return False
    return depth == 0


Requirement = Annotated[
    str,
    Field(max_length=500),
    like(
        rf"{_NAME}{_EXTRAS}(?:{_URL}|{_VERSIONS}){_MARKER}",
        "a Python requirement such as numpy or pyserial>=3.5,<4",
        holds=_are_brackets_closed,
    ),
]
"""A package of Python, as pip takes it on its command line; never an option or a path."""

_OWN = re.compile(r"\.{1,2}/[^\0\r\n]*[^\0\r\n\s]")


def is_own_requirement(text: str) -> bool:
    """Tell whether a requirement is a path: ./dist/cars-0.1-py3-none-any.whl, ./cars."""
    return _OWN.fullmatch(text) is not None


ScenarioRequirement = Annotated[
    str,
    Field(max_length=500),
    like(
        rf"{_NAME}{_EXTRAS}(?:{_URL}|{_VERSIONS}){_MARKER}|{_OWN.pattern}",
        "a Python requirement such as numpy or pyserial>=3.5,<4, or the path of a wheel or of its"
        " sources such as ./cars",
        holds=_are_brackets_closed,
    ),
]
"""A package of Python, or a distribution of one's own by its path from the scenario's folder."""

SystemPackage = Annotated[
    str,
    like(
        r"[a-z0-9][a-z0-9+.-]*[a-z0-9+.](?::[a-z0-9-]+)?",
        "the name of a Debian package such as i2c-tools",
    ),
]
"""A package of the distribution. A name that ends in '-' would tell apt to remove it."""

MachinePath = Annotated[
    str, like(r"(?:/|~/)[^\0\r\n]*[^\0\r\n/]", "an absolute path or one that starts with ~/")
]
"""A file or folder on a machine; ~ is the home of who logs in."""

FileMode = Annotated[str, like(r"[0-7]{3,4}", 'an octal mode in quotes such as "0644"')]
USER_NUMBER_MAX = 2**32 - 2
"""Of Linux; the next one leaves an owner as it is, and to give a file to those beyond is an error."""


def _is_in_reach(text: Any) -> Any:
    if isinstance(text, str) and text.isdecimal() and int(text) > USER_NUMBER_MAX:
        raise ValueError(
            f"expected the name of a user or group, or a number of at most {USER_NUMBER_MAX}"
        )
    return text


SystemUser = Annotated[
    str,
    BeforeValidator(_is_in_reach),
    like(r"[A-Za-z0-9_][A-Za-z0-9_.-]*\$?", "the name of a user or group"),
]
"""Its number does as well."""
RECORDED_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
"""Of an agent, a machine or a device: a folder of records bears it. No path, and nothing hidden."""
DeviceName = Annotated[str, like(RECORDED_NAME.pattern, "the name of a device such as sense_hat")]
NonBlank = Annotated[str, like(r"(?s).*\S.*", "a text that is not blank")]
