"""Writes expected values into a baseline's file and leaves all else of it as a person wrote it."""

from __future__ import annotations

import codecs
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from cosmos_cli.errors import Fault, InputError
from cosmos_cli.models.baseline import Baseline, parse_baseline
from cosmos_cli.models.document import Document, Path, SourcePlace
from cosmos_cli.models.yaml_source import YamlSource, read_source
from cosmos_cli.testing.figures import ComparedFigure, FigureValue
from madns_runtime.partial_file import write_whole

_LINE_START = re.compile(r"(?<=\n)|(?<=\r)(?!\n)")
"""As lines are counted in places: `str.splitlines` knows further ends."""
_LINE_END = re.compile(r"\r\n|\r|\n")
_HALVES = re.compile(r"\\ud[89ab][0-9a-f]{2}\\ud[c-f][0-9a-f]{2}")
_QUOTED = re.compile(r"'(?:[^']|'')*'" r'|"(?:[^"\\]|\\.)*"')
Edit = tuple[int, int, int, str]
"""Line from 0, column from 0, characters that go, and the text that comes."""


def update_baseline(baseline: Baseline, compared: Sequence[ComparedFigure]) -> int:
    """
    Write what came as what is expected, where they are not the same within the tolerance.

    Returns:
        How many figures changed.

    Raises:
        InputError: A figure has no value, cannot be written where it stands, or the file is another than was read;
            then nothing is.
    """
    missing = [
        baseline.fault(figure.name, figure.why_none) for figure in compared if figure.got is None
    ]
    if missing:
        raise InputError(faults=missing)
    changed = {
        figure.name: _written(figure, baseline.figures[figure.name].relative)
        for figure in compared
        if not figure.passed
    }
    if not changed:
        return 0
    text = edited(baseline.document, changed)
    if not _means(baseline, text, changed):
        raise InputError(faults=list(_unwritable(baseline, changed)))
    if read_source(baseline.path).text != baseline.document.source.text:
        raise InputError(
            f"{baseline.path}: was changed while the tests ran; nothing is written: run them again"
        )
    # A link to a baseline that is shared stays one.
    file = baseline.path.resolve()
    try:
        with open(file, "rb") as before:
            is_marked = before.read(len(codecs.BOM_UTF8)) == codecs.BOM_UTF8
        write_whole(file, text.encode("utf-8-sig" if is_marked else "utf-8"))
    except OSError as error:
        raise InputError(f"{baseline.path}: cannot be written: {error.strerror}") from error
    return len(changed)


def edited(document: Document, values: Mapping[str, FigureValue]) -> str:
    """Return the text of a baseline with new expected values, its comments and its order as they are."""
    lines = _LINE_START.split(document.source.text)
    edits = [
        edit
        for name, value in values.items()
        if (edit := _edit(document, lines, name, _scalar(value))) is not None
    ]
    for row, column, length, new in sorted(edits, reverse=True):
        line = lines[row]
        lines[row] = f"{line[:column]}{new}{line[column + length :]}"
    return "".join(lines)


def _means(baseline: Baseline, text: str, changed: Mapping[str, FigureValue]) -> bool:
    """Tell whether a text is the baseline with these expected values and no other difference."""
    try:
        found = parse_baseline(baseline.path, YamlSource.of(str(baseline.path), text)).figures
    except InputError:
        return False
    wanted = {
        name: replace(figure, expected=_as_read(changed[name])) if name in changed else figure
        for name, figure in baseline.figures.items()
    }
    return found == wanted


def _unwritable(baseline: Baseline, changed: Mapping[str, FigureValue]) -> Iterator[Fault]:
    """Yield a fault for each figure that cannot be written by itself; for all if none can with the others."""
    alone = [
        name
        for name, value in changed.items()
        if not _means(baseline, edited(baseline.document, {name: value}), {name: value})
    ]
    for name in alone or changed:
        text = (
            f"write `expected: {_scalar(changed[name])}` by hand, in a line or a figure of its own"
        )
        yield baseline.fault(name, f"no value can be put into what stands here: {text}")


def _written(figure: ComparedFigure, relative: float) -> FigureValue:
    """Return what is written of a value: in few digits where that is within its tolerance of what came, else in all."""
    got = figure.got
    if not isinstance(got, float):
        return got
    short = float(f"{got:.10g}")
    return short if abs(short - got) <= max(figure.allowed, relative * abs(short)) else got


def _as_read(value: FigureValue) -> FigureValue:
    """Return a value as a baseline has it that is read again: numbers are floats there."""
    is_whole = isinstance(value, int) and not isinstance(value, bool)
    return float(_scalar(value)) if is_whole or isinstance(value, float) else value


def _scalar(value: FigureValue) -> str:
    if not isinstance(value, float):
        return _HALVES.sub(_joined, json.dumps(value))
    text = f"{value:.10g}"
    mantissa, mark, power = (text if float(text) == value else repr(value)).partition("e")
    # Readers of YAML 1.1 take 1e-07 for a text.
    return f"{mantissa}{'' if '.' in mantissa or not mark else '.0'}{mark}{power}"


def _joined(halves: re.Match[str]) -> str:
    """Return a letter beyond U+FFFF, of which JSON writes two halves, as one escape: YAML does not join them."""
    letter = json.loads(f'"{halves[0]}"')
    return f"\\U{ord(letter):08x}"


def _edit(document: Document, lines: Sequence[str], name: str, text: str) -> Edit | None:
    """Return the edit of a figure; None for one without a key of its own, which an alias stands for."""
    expected = ("figures", name, "expected")
    own = _own_keys(document, name)
    if expected in own:
        place = document.value_places[expected]
        row, column = place.line - 1, place.column - 1
        before = lines[row][:column]
        if not document.texts.get(expected, "-"):  # `expected:` alone
            text = f"{'' if before.endswith(' ') else ' ' if before.endswith(':') else ': '}{text}"
        return row, column, _length(document, expected, lines[row][column:]), text
    if not own:
        return None
    first = min(own.values(), key=lambda place: (place.line, place.column))
    row, column = first.line - 1, first.column - 1
    is_flow = lines[row][:column].strip() != ""
    between = ", " if is_flow else _line_end(lines, row) + lines[row][:column]
    return row, column, 0, f"expected: {text}{between}"


def _line_end(lines: Sequence[str], row: int) -> str:
    """Return what ends a line; the last one may have no end, and takes that of the first."""
    found = _LINE_END.search(lines[row]) or _LINE_END.search(lines[0])
    return "\n" if found is None else found[0]


def _own_keys(document: Document, name: str) -> dict[Path, SourcePlace]:
    """Return the keys of a figure that stand there, without those that `<<` takes from a figure above."""
    owners: dict[tuple[int, int], str | int] = {}
    own: dict[Path, SourcePlace] = {}
    for path, place in document.key_places.items():
        if len(path) == 3 and path[0] == "figures":
            owner = owners.setdefault((place.line, place.column), path[1])
            if owner == path[1] == name:
                own[path] = place
    return own


def _length(document: Document, path: Path, rest: str) -> int:
    """Return the characters of a scalar: a plain one as it is written, a quoted one to its closing mark."""
    if path in document.texts:
        return len(document.texts[path])
    quoted = _QUOTED.match(rest)
    return len(rest) if quoted is None else quoted.end()
