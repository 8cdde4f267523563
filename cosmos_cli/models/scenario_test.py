"""Section `test` of a scenario: how a suite runs it, and what is to come of it. A run by itself ignores it."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from annotated_types import Gt, Le, MaxLen
from pydantic import Field

from cosmos_cli.errors import Fault, InputError
from cosmos_cli.models.document import Path
from cosmos_cli.models.overrides import KEY_FORM
from cosmos_cli.models.text_forms import like
from madns_runtime.plain_values import FORBID_EXTRA

DEADLINE_S_MAX = 30 * 86_400.0
TAGS_MAX = 32
SETTINGS_MAX = 200
PATTERNS_MAX = 200
OPERATORS = ("and", "or", "not")
"""Words of an expression that chooses tests: no tag can be called so."""

Tag = Annotated[
    str,
    like(
        rf"(?!(?:{'|'.join(OPERATORS)})$)[a-z0-9][a-z0-9_.-]{{0,63}}",
        "a tag such as quick: lower-case letters, digits, '_', '.' or '-', and not and, or, not",
    ),
]
RelativeFile = Annotated[
    str,
    like(
        r"|(?!/)(?!(?:.*/)?\.\.(?:/|$))[^\0\r\n]*[^\0\r\n/\s]",
        "a file in or below the scenario's folder, such as baselines/ring.yaml",
    ),
]
"""A file that travels with the scenario; empty for none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExpectedOutcome:
    """Outcome of a test that passes; for runs that are meant to fail."""

    __pydantic_config__ = FORBID_EXTRA

    exit_code: Literal[0, 1, 3, 4, 5, 130] = 0
    """Exit code of the run."""
    broken: Annotated[tuple[str, ...], MaxLen(PATTERNS_MAX)] | None = None
    """Names or globs of checks: each matches a broken one, and no other is broken. None: not looked at."""
    verdict: Annotated[str, Field(max_length=1000)] = ""
    """Words that the verdict contains."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioTest:
    """The scenario as a test, for `cosmos test`: how it is shortened, and the outcome with which it passes."""

    __pydantic_config__ = FORBID_EXTRA

    set: dict[str, Any] = field(default_factory=dict)
    """Values that replace the scenario's in a test, by dotted key, as --set does: {time.duration_s: 20}."""
    tags: Annotated[tuple[Tag, ...], MaxLen(TAGS_MAX)] = ()
    """Words by which `cosmos test -k` chooses it, such as quick."""
    deadline_s: Annotated[float, Gt(0), Le(DEADLINE_S_MAX)] | None = None
    """Longest time that the run may take from its start to its verdict, s; none for one that follows from its length."""
    expect: ExpectedOutcome = ExpectedOutcome()
    """The outcome that passes."""
    baseline: RelativeFile = ""
    """File of figures with tolerances, which the run is compared with."""


def override_of(key: str, value: Any) -> str:
    """
    Return KEY=VALUE of --set; JSON is YAML, too.

    Raises:
        InputError: The value is none that a scenario holds.
    """
    try:
        return f"{key}={json.dumps(value, default=_plain)}"
    except (TypeError, ValueError) as error:
        text = "expected a text, a number, true, false, or a list or mapping of them"
        raise InputError(faults=[Fault(text=f"{text}: {error}", override=key)]) from error


def _plain(value: object) -> object:
    """Return a path as its text, and a number or an array of numpy as plain ones."""
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    to_list = getattr(value, "tolist", None)
    if to_list is None:
        raise TypeError(f"got {type(value).__name__}")
    return to_list()


def faults_of_test(test: ScenarioTest) -> Iterator[tuple[Path, str]]:
    """Yield the paths within the section, and what is wrong there, that no single field can know to be."""
    if len(test.set) > SETTINGS_MAX:
        yield ("set",), f"expected at most {SETTINGS_MAX} values, got {len(test.set)}"
    for key in test.set:
        if not KEY_FORM.fullmatch(key):
            yield ("set", key), "expected a dotted path, such as time.duration_s"
        elif key.partition(".")[0].partition("[")[0] == "test":
            yield ("set", key), "expected a key of the scenario outside of test"
    seen: set[str] = set()
    for index, tag in enumerate(test.tags):
        if tag in seen:
            yield ("tags", index), f"expected each tag once, got {tag!r} again"
        seen.add(tag)
    expect = test.expect
    if expect.broken and expect.exit_code == 0:
        text = "expected no broken checks with exit_code 0; say exit_code: 4"
        yield ("expect", "broken"), text
