"""Meanings of the errors of the YAML parser in plain words, and where what is meant stands. Pure."""

from __future__ import annotations

import re
from collections.abc import Sequence

import yaml

_FLOW_MARKS = re.compile(r"""\$\{|["'\[\]{},:]""")
"""In a line of a flow mapping or list: what begins or ends a plain text, and a variable."""
_NO_SPACE = re.compile(r"\s*(?:- +)*[\w.-]+:(?=[^\s:/])")
"""A key whose colon has no space behind it, from the begin of a line."""
_ESCAPE = (
    'expected an escape such as \\n after the backslash: within "..." write \\\\ for a backslash itself,'
    " or put the text in '...'"
)
_NO_KEY = "expected a key at the indentation of its neighbours; behind a quoted text stands nothing more on its line"
_NO_END = (
    "more follows a value in quotes or brackets that ended before this: put all of it in quotes"
)
_NO_COLON = "expected `key: value`, got no ':' after the key"
NO_SPACE = "expected a space behind this ':'"
_MEANINGS = (
    ("quoted scalar", "escape", False, _ESCAPE),
    ("quoted scalar", "hexdecimal", False, _ESCAPE),
    ("quoted scalar", "", True, "this quoted text is never closed"),
    ("flow sequence", "", True, "this list is never closed: expected ',' or ']'"),
    ("flow mapping", "", True, "this mapping is never closed: expected ',' or '}}'"),
    (
        "",
        "expected node content",
        False,
        "expected a value, or the bracket that closes what was opened before",
    ),
    (
        "",
        "mapping values are not allowed",
        False,
        "a second ': ' on this line: put the text in quotes, or check the indentation",
    ),
    ("", "could not find expected ':'", True, _NO_COLON),
    ("", "cannot start any token", False, "{} cannot start a value: put it in quotes"),
    ("", "expected <document start>", False, _NO_END),
    ("", "maximum nesting depth", False, "expected at most {depth_max} levels of nesting"),
    ("block mapping", "block end", False, _NO_KEY),
    ("block mapping", "expected key", False, _NO_KEY),
)
"""The parser's terms: within what, which problem, whether the fault is where that began, and what it means."""

Place = tuple[int, int]
"""Line and column, from 1."""


def plain_words(
    lines: Sequence[str], error: yaml.MarkedYAMLError, *, depth_max: int
) -> tuple[Place | None, str]:
    """
    Say in plain words what the parser's terms mean.

    Args:
        lines: Of the text.
        error: The parser's.
        depth_max: How deep it may nest.

    Returns:
        The place to blame, None if it is not known, and the words.
    """
    context, problem = error.context or "", error.problem or "not understood"
    mark = error.problem_mark or error.context_mark
    text = f"not valid YAML: {problem}"
    if mark is None:
        return None, text
    line = lines[mark.line] if mark.line < len(lines) else ""
    if line[mark.column : mark.column + 1] == "\t" or line[: mark.column].strip(" ").startswith(
        "\t"
    ):
        text = "expected spaces, got a tab: YAML is indented with spaces"
    elif "flow" in context and (bare := _bare_variable(line)) is not None:
        text = "a brace within braces or brackets: put ${...} in quotes"
        return (mark.line + 1, bare + 1), text
    elif "mapping values are not allowed" in problem and ": " not in line[: mark.column]:
        return _continued(lines, mark.line, mark.column)
    else:
        for in_context, in_problem, is_at_start, meaning in _MEANINGS:
            if in_context in context and in_problem in problem:
                mark_text = repr(line[mark.column : mark.column + 1])
                text = meaning.format(mark_text, depth_max=depth_max)
                begin = error.context_mark or mark
                if in_context.startswith("flow") and line[mark.column :].strip():  # more follows
                    text, is_at_start = _without_comma(text, begin.line, mark.line)
                mark = begin if is_at_start else mark
                break
        if text == _NO_COLON and (found := _NO_SPACE.match(lines[mark.line])):
            return (mark.line + 1, found.end()), NO_SPACE
    return (mark.line + 1, mark.column + 1), text


def _continued(lines: Sequence[str], line: int, column: int) -> tuple[Place, str]:
    """Say why a line with one key is taken for more of the value above it: that lacks a space, or this is indented too far."""
    for above in range(line - 1, -1, -1):
        if not lines[above].strip():
            continue
        if found := _NO_SPACE.match(lines[above]):
            return (above + 1, found.end()), NO_SPACE
        if ": " in lines[above]:
            text = f"this key is indented further than line {above + 1}, whose value ends there"
            return (line + 1, column + 1), f"{text}: check the indentation"
        break
    return (line + 1, column + 1), "a key within the text above it: check the indentation"


def _without_comma(text: str, begin: int, line: int) -> tuple[str, bool]:
    """Return what a flow list or mapping lacks that *text* calls never closed though more follows, and whether the fault is at its begin."""
    never, _, expected = text.partition(": ")
    if line == begin:
        return f"{expected} before this", False
    return f"{never}, or has no comma before line {line + 1}: {expected}", True


def _bare_variable(line: str) -> int | None:
    """Return where in a line of a flow mapping or list the first ${ is that no quote keeps: there a plain text ends."""
    is_plain = False
    for mark in _FLOW_MARKS.finditer(line):
        if mark[0] == "${" and is_plain:
            return mark.start()
        is_plain = mark[0] in ("${", "[", "{", ",", ":")
    return None
