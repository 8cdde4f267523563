"""
`test.set` of a scenario as it holds where variables have been replaced: what its variables change, value by value. Pure.

What results of a scenario has no `vars`, so that `test.set: {vars.limit: 3}` would name nothing there.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from cosmos_cli.errors import InputError
from cosmos_cli.models.document import Document, Path, dotted
from cosmos_cli.models.extending import OF_THE_FILE
from cosmos_cli.models.overrides import KEY_FORM, apply_overrides, override_steps
from cosmos_cli.models.scenario_test import SETTINGS_MAX, override_of
from cosmos_cli.models.variables import SECTION as VARIABLES
from cosmos_cli.models.variables import substitute_variables

SECTION = "test"
OTHERS = (VARIABLES, SECTION, *OF_THE_FILE)
"""Sections that no test changes."""


def test_overrides(document: Document, settings: Mapping[str, Any]) -> list[str]:
    """
    Return `test.set` as KEY=VALUE of --set.

    Args:
        document: The scenario's.
        settings: `test.set` as it is written, variables and all.

    Raises:
        InputError: A value is none that a scenario holds.
    """
    return [_override(document, key, value) for key, value in settings.items()]


def giving_way(own: Sequence[str], given: Sequence[str]) -> list[str]:
    """Return those of the test's own KEY=VALUE that set nothing at or below a key of --set."""
    taken = [override_steps(override) for override in given]
    return [
        override
        for override in own
        if not any(override_steps(override)[: len(steps)] == steps for steps in taken)
    ]


def settings_without_variables(document: Document, given: Sequence[str]) -> dict[str, Any] | None:
    """
    Return `test.set` with all values that change with its variables in their place.

    Args:
        document: What the files say, before anything is replaced; it stays as it is.
        given: KEY=VALUE of --set.

    Returns:
        None where it gives no variable, or is wrong.
    """
    written = document.value.get(SECTION)
    settings = written.get("set") if isinstance(written, dict) else None
    if not isinstance(settings, dict) or not any(
        _key_steps(key)[0] == VARIABLES for key in settings
    ):
        return None
    try:
        own = giving_way(test_overrides(document, settings), given)
    except InputError:
        return None
    others = [override for override in own if not _is_of_variable(override)]
    before, after = (_values(document, [*some, *given]) for some in (others, own))
    if before is None or after is None:
        return None
    kept = {
        key: value
        for key, value in after[SECTION]["set"].items()
        if _key_steps(key)[0] != VARIABLES
    }
    paths = [_key_steps(key) for key in kept]
    changed = {
        dotted(path): value
        for section in after
        if section not in OTHERS
        for path, value in _differences(before.get(section), after[section], (section,))
        if not any(tuple(map(str, path))[: len(steps)] == steps for steps in paths)
    }
    if len(changed) + len(kept) > SETTINGS_MAX:
        sections = dict.fromkeys(key.partition(".")[0].partition("[")[0] for key in changed)
        changed = {section: after[section] for section in sections}
    return {**changed, **kept}  # the larger first, which --set would else find replaced


def _override(document: Document, key: str, value: Any) -> str:
    written = document.texts.get((SECTION, "set", key))
    if written and isinstance(value, int | float):  # 007, for whoever has it in a longer text
        return f"{key}={written}"
    return override_of(key, value)


def _is_of_variable(override: str) -> bool:
    return override_steps(override)[:1] == (VARIABLES,)


def _key_steps(key: str) -> tuple[str, ...]:
    return override_steps(f"{key}=0")


def _has_dotted_path(key: object) -> bool:
    return isinstance(key, str) and KEY_FORM.fullmatch(key) is not None and "." not in key


def _values(document: Document, overrides: Sequence[str]) -> dict[str, Any] | None:
    copied = copy.deepcopy(document)
    faults = apply_overrides(copied, overrides)
    substitute_variables(copied)
    return None if faults or copied.faults else copied.value


def _differences(before: Any, after: Any, path: Path) -> Iterator[tuple[Path, Any]]:
    """Yield the least values that differ and have a dotted path."""
    if isinstance(before, dict) and isinstance(after, dict) and before.keys() == after.keys():
        inner = {key: [*_differences(before[key], after[key], (*path, key))] for key in after}
        if all(_has_dotted_path(key) for key, found in inner.items() if found):
            yield from (each for found in inner.values() for each in found)
            return
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for index, items in enumerate(zip(before, after, strict=True)):
            yield from _differences(*items, (*path, index))
        return
    if type(before) is not type(after) or before != after:
        yield path, after
