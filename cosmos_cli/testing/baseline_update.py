"""Writes expected values into a baseline's file and leaves all else of it as a person wrote it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

from cosmos_cli.errors import InputError
from cosmos_cli.models.baseline import Baseline, read_baseline
from cosmos_cli.models.document import Document
from cosmos_cli.testing.figures import ComparedFigure, FigureValue
from madns_runtime.partial_file import write_whole

Edit = tuple[int, int, int, str]
"""Line from 0, column from 0, characters that go, and the text that comes."""


def update_baseline(baseline: Baseline, compared: Sequence[ComparedFigure]) -> int:
    """
    Write what came as what is expected, where they are not the same within the tolerance.

    Returns:
        How many figures changed.

    Raises:
        InputError: A figure has no value, or the file cannot be written.
    """
    missing = [
        baseline.fault(figure.name, figure.why_none) for figure in compared if figure.got is None
    ]
    if missing:
        raise InputError(faults=missing)
    changed = {figure.name: figure.got for figure in compared if not figure.passed}
    if not changed:
        return 0
    text = edited(baseline.document, changed)
    try:
        write_whole(baseline.path, text.encode())
    except OSError as error:
        raise InputError(f"{baseline.path}: cannot be written: {error.strerror}") from error
    read_baseline(baseline.path)
    return len(changed)


def edited(document: Document, values: Mapping[str, FigureValue]) -> str:
    """Return the text of a baseline with new expected values, its comments and its order as they are."""
    lines = document.source.text.splitlines(keepends=True)
    edits = [_edit(document, lines, name, _scalar(value)) for name, value in values.items()]
    for row, column, length, new in sorted(edits, reverse=True):
        line = lines[row]
        lines[row] = f"{line[:column]}{new}{line[column + length :]}"
    return "".join(lines)


def _scalar(value: FigureValue) -> str:
    if not isinstance(value, float):
        return json.dumps(value)
    mantissa, mark, power = f"{value:.10g}".partition("e")
    # Readers of YAML 1.1 take 1e-07 for a text.
    return f"{mantissa}{'' if '.' in mantissa or not mark else '.0'}{mark}{power}"


def _edit(document: Document, lines: Sequence[str], name: str, text: str) -> Edit:
    where = ("figures", name)
    expected = (*where, "expected")
    if expected in document.key_places:
        place = document.value_places[expected]
        row, column = place.line - 1, place.column - 1
        return row, column, _length(document, expected, lines[row][column:]), text
    first = min(
        (document.key_places[path] for path in document.key_places if path[:-1] == where),
        key=lambda place: (place.line, place.column),
    )
    row, column = first.line - 1, first.column - 1
    is_flow = lines[row][:column].strip() != ""
    between = ", " if is_flow else "\n" + lines[row][:column]
    return row, column, 0, f"expected: {text}{between}"


def _length(document: Document, path: tuple[str | int, ...], rest: str) -> int:
    """Return the characters of a scalar: a plain one as it is written, a quoted one to its closing mark."""
    if path in document.texts:
        return len(document.texts[path])
    mark = rest[:1]
    index = 1
    while index < len(rest) and rest[index] != mark:
        index += 2 if mark == '"' and rest[index] == "\\" else 1
    return index + 1
