"""
YAML text to nodes that know their place, by the core rules of YAML 1.2.

So `no` is a string, 1e3 a number, 12:30 a string and 010 is ten, unlike in PyYAML's own reading
(YAML 1.1). The parser's events are composed here and not by PyYAML, whose C composer recurses
without a bound: a file of 200,000 brackets would end the process.
"""

from __future__ import annotations

import codecs
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from cosmos_cli.errors import Fault, InputError, check_path_is_text
from cosmos_cli.models.yaml_syntax import plain_words
from madns_runtime.bounded_files import FileRefused, read_regular_file
from madns_runtime.similar_words import most_similar

UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
"""Beginnings of files that some editors of Windows and its shell write."""
FILE_BYTES_MAX = 4 * 1024 * 1024
DEPTH_MAX = 64
DIGITS_MAX = 300
DIGITS_SHOWN_MAX = 40
WHOLE_MIN, WHOLE_MAX = -(2**63), 2**63 - 1
"""Bounds of a configuration's whole numbers, as they are sent and written: JSON and messages have 64 bits."""

_PARSER: Any = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
_TAG = "tag:yaml.org,2002:"
_WHOLE = (
    (10, re.compile(r"[-+]?[0-9]+")),
    (8, re.compile(r"0o[0-7]+")),
    (16, re.compile(r"0x[0-9a-fA-F]+")),
)
"""Whole numbers by their base."""
_FLOAT = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")
_POWER = re.compile(r"[-+]?[0-9]+[eE]\+?[0-9]+")
_NOT_FINITE = re.compile(r"[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)")
_WORDS: dict[str, bool | None] = {
    "": None,
    "~": None,
    "null": None,
    "Null": None,
    "NULL": None,
    "true": True,
    "True": True,
    "TRUE": True,
    "false": False,
    "False": False,
    "FALSE": False,
}
_SEPARATORS = "\x85\u2028\u2029"
"""Ends of lines to the parser (YAML 1.1), and letters to YAML 1.2, to editors and to whoever counts lines."""
_PRIVATE = (*range(0xE000, 0xF900), *range(0xF0000, 0xFFFFE))
"""Characters without a meaning, which stand for them while the parser reads."""
_UNPRINTABLE = re.compile("[^\t\n\r\x20-\x7e\x85\xa0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")

Scalar = str | int | float | bool | None


@dataclass(slots=True, eq=False)
class Node:
    """A scalar, a list of nodes, or a list of pairs of nodes, and where it starts (counted from 1)."""

    value: Scalar | list[Node] | list[tuple[Node, Node]]
    line: int
    column: int
    is_mapping: bool = False
    text: str = ""
    """A scalar as it is written."""
    fault: str = ""
    """Fault of a scalar that has no value; the rest of the file can be read all the same."""
    is_plain: bool = False


@dataclass(frozen=True, slots=True)
class YamlSource:
    """The text of a file, and the name it is shown by."""

    label: str
    text: str
    lines: tuple[str, ...]

    @classmethod
    def of(cls, label: str, text: str) -> YamlSource:
        """Make a source; the lines are what carets stand under."""
        return cls(label, text, _lines(text))

    def fault(self, text: str, *, line: int, column: int, path: str = "") -> Fault:
        """Return a fault at a place of this source."""
        source = self.lines[line - 1] if 0 < line <= len(self.lines) else ""
        return Fault(text=text, path=path, file=self.label, line=line, column=column, source=source)


def _lines(text: str) -> tuple[str, ...]:
    return tuple(re.split(r"\r\n|\r|\n", text))


def read_source(path: Path) -> YamlSource:
    """
    Read a file that a person wrote.

    Raises:
        InputError: It is missing, unreadable, no regular file, too large, no UTF-8 text, or its path is none.
    """
    label = str(path)
    try:
        raw = read_regular_file(path, bytes_max=FILE_BYTES_MAX)
    except FileNotFoundError:
        raise _whole(label, f"no such file{_similar(path)}") from None
    except FileRefused as error:
        raise _whole(label, str(error.strerror)) from None
    except OSError as error:
        raise _whole(label, f"cannot be read: {error.strerror}") from error
    check_path_is_text(path)
    if raw.startswith(UTF_16):
        raise _whole(label, "expected UTF-8 text, got UTF-16: save it as UTF-8 in your editor")
    if b"\0" in raw:
        raise _whole(label, "expected UTF-8 text, got binary data")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise _whole(
            label, f"expected UTF-8 text, got byte 0x{raw[error.start]:02x} in line {line}"
        ) from None
    return YamlSource.of(label, text)


def _whole(label: str, text: str) -> InputError:
    return InputError(faults=[Fault(text=text, file=label)])


def _similar(path: Path) -> str:
    try:
        names = [entry.name for entry in path.parent.iterdir()]
    except OSError:
        return ""
    close = most_similar(path.name, names)
    return "" if close is None else f", did you mean {path.parent / close}?"


def compose(source: YamlSource, *, has_64_bits: bool = True) -> Node | None:
    """
    Return the root node of the one document in *source*; None if there is none.

    Args:
        source: YAML.
        has_64_bits: Whether whole numbers must fit into what messages and JSON hold.

    Raises:
        InputError: It is not valid YAML, has a second document, or nests deeper than DEPTH_MAX.
    """
    bad = _UNPRINTABLE.search(source.text)
    if bad:
        before = _lines(source.text[: bad.start()])
        line, column = len(before), len(before[-1]) + 1
        text = f"expected text, got the control character U+{ord(bad.group()):04X}"
        raise InputError(faults=[source.fault(text, line=line, column=column)])
    try:
        return _Composer(source, has_64_bits).document()
    except yaml.MarkedYAMLError as error:
        raise InputError(faults=[_syntax_fault(source, error)]) from None
    except yaml.YAMLError as error:
        raise _whole(source.label, f"not valid YAML: {error}") from None


class _Composer:
    def __init__(self, source: YamlSource, has_64_bits: bool) -> None:
        self.source = source
        self.has_64_bits = has_64_bits
        self.anchors: dict[str, Node] = {}
        used = set(source.text)
        free = (code for code in _PRIVATE if chr(code) not in used)
        stand_ins = {ord(each): next(free, 0xFFFD) for each in _SEPARATORS if each in used}
        self.restored = {code: each for each, code in stand_ins.items()}
        text = source.text.translate(stand_ins) if stand_ins else source.text
        self.events: Iterator[Any] = yaml.parse(text, Loader=_PARSER)

    def document(self) -> Node | None:
        next(self.events)  # the start of the stream
        if isinstance(next(self.events), yaml.StreamEndEvent):
            return None
        root = self.node(next(self.events), 0)
        next(self.events)  # the end of the document
        event = next(self.events)
        if not isinstance(event, yaml.StreamEndEvent):
            raise self.error("expected one document, a second one starts here", event)
        return root

    def node(self, event: Any, depth: int) -> Node:
        if depth > DEPTH_MAX:
            raise self.error(f"expected at most {DEPTH_MAX} levels of nesting", event)
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in self.anchors:
                raise self.error(f"no anchor &{event.anchor} stands above", event)
            return self.anchors[event.anchor]
        node = Node([], event.start_mark.line + 1, event.start_mark.column + 1)
        if isinstance(event, yaml.ScalarEvent):
            self.scalar(node, event)
        elif isinstance(event, yaml.SequenceStartEvent):
            self.expect_tag(event, "seq")
            node.value = [self.node(item, depth + 1) for item in self.until(yaml.SequenceEndEvent)]
        else:
            self.expect_tag(event, "map")
            node.is_mapping = True
            node.value = [
                (self.node(key, depth + 1), self.node(next(self.events), depth + 1))
                for key in self.until(yaml.MappingEndEvent)
            ]
        if event.anchor:  # set last: a node that holds itself finds no anchor
            self.anchors[event.anchor] = node
        return node

    def until(self, end: type) -> Iterator[Any]:
        for event in self.events:
            if isinstance(event, end):
                return
            yield event

    def expect_tag(self, event: Any, tag: str) -> None:
        if event.tag not in (None, "!", _TAG + tag):
            raise self.error(_tag_text(event.tag), event)

    def scalar(self, node: Node, event: Any) -> None:
        node.text = event.value.translate(self.restored) if self.restored else event.value
        node.is_plain = event.style in (None, "")
        if event.tag in ("!", _TAG + "str") or (event.tag is None and not event.implicit[0]):
            node.value = node.text
            return
        try:
            node.value = resolve_scalar(node.text, has_64_bits=self.has_64_bits)
        except ValueError as error:
            node.value, node.fault = None, str(error)
            return
        if event.tag is None:
            return
        names = {bool: "bool", int: "int", float: "float", type(None): "null"}
        if event.tag == _TAG + "float" and isinstance(node.value, int):
            node.value = float(node.value)
        if event.tag != _TAG + names.get(type(node.value), "str"):
            raise self.error(_tag_text(event.tag), event)

    def error(self, text: str, event: Any) -> InputError:
        mark, text = event.start_mark, text.translate(self.restored)
        return InputError(
            faults=[self.source.fault(text, line=mark.line + 1, column=mark.column + 1)]
        )


def _tag_text(tag: str) -> str:
    return f"expected a plain value, got the tag {tag.replace(_TAG, '!!')}"


def resolve_scalar(text: str, *, has_64_bits: bool = True) -> Scalar:
    """
    Return what an unquoted scalar means.

    A power of ten without a fraction, such as 4e6, is a whole number.

    Raises:
        ValueError: It is a number, but not a finite one of reasonable length, or a whole one beyond 64 bits
            where *has_64_bits*.
    """
    if text in _WORDS:
        return _WORDS[text]
    for base, pattern in _WHOLE:
        if pattern.fullmatch(text):
            return _whole_number(text, base, has_64_bits)
    if _NOT_FINITE.fullmatch(text) or (_FLOAT.fullmatch(text) and math.isinf(float(text))):
        raise ValueError(f"expected a finite number, got {text}")
    if _FLOAT.fullmatch(text):
        number = float(text)
        return int(number) if _POWER.fullmatch(text) and abs(number) < 2**53 else number
    return text


def _whole_number(digits: str, base: int, has_64_bits: bool) -> int:
    if len(digits) > DIGITS_MAX:
        raise ValueError(f"expected a number of at most {DIGITS_MAX} digits, got {len(digits)}")
    number = int(digits, base)
    if has_64_bits and not WHOLE_MIN <= number <= WHOLE_MAX:
        shown = digits if len(digits) <= DIGITS_SHOWN_MAX else f"one of {len(digits)} digits"
        raise ValueError(
            f"expected a whole number from -2^63 to 2^63 - 1, got {shown}: write one that need not be"
            " whole such as 1e20, and a text in quotes"
        )
    return number


def is_text_without_quotes(text: str) -> bool:
    """Tell whether a plain scalar is a text here: 2024 and 1e3 are numbers, and null is nothing."""
    try:
        return isinstance(resolve_scalar(text), str)
    except ValueError:  # a number too large
        return False


def yaml_text(value: Any) -> str:
    """Return plain values as YAML that means the same here: PyYAML's own takes 1e5 for a text and leaves it unquoted."""
    text: str = yaml.dump(value, Dumper=_Dumper, sort_keys=False, allow_unicode=True)
    return text


class _Dumper(yaml.SafeDumper):
    def represent_text(self, text: str) -> Any:
        """Return the node of a text, in quotes where it would be something else without them."""
        style = None if is_text_without_quotes(text) else "'"
        if any(each in text for each in _SEPARATORS):
            style = '"'  # which escapes them
        return self.represent_scalar(f"{_TAG}str", text, style=style)


_Dumper.add_representer(str, _Dumper.represent_text)


def _syntax_fault(source: YamlSource, error: yaml.MarkedYAMLError) -> Fault:
    place, text = plain_words(source.lines, error, depth_max=DEPTH_MAX)
    if place is None:
        return Fault(text=text, file=source.label)
    end = (len(source.lines), len(source.lines[-1]) + 1)
    line, column = min(
        place, end
    )  # the parser's end of a text without a last newline is a line more
    return source.fault(text, line=line, column=column)
