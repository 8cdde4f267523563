"""
How the command line speaks: stdout is data, stderr is talk.

Streams are looked up at each call, so that tests and pipes may replace them. Rich is imported only
for a table on a terminal.
"""

from __future__ import annotations

import contextlib
import errno
import io
import json
import os
import shutil
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TextIO

import typer

JsonOption = Annotated[
    bool, typer.Option("--json", help="Print the result as JSON on stdout, nothing else.")
]
QuietOption = Annotated[
    bool, typer.Option("--quiet", "-q", help="Say nothing on stderr but errors.")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Replace a value of the scenario, such as agents.count=5. Repeatable.",
    ),
]


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a table: its heading, and whether its cells are numbers."""

    heading: str
    is_number: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Console:
    """What a command was asked to print, and how."""

    json: bool = False
    """The result goes to stdout as JSON; lines meant for eyes are left out."""
    quiet: bool = False

    def data(self, text: str) -> None:
        """Print a line of the result on stdout; left out under --json."""
        if not self.json:
            _write(sys.stdout, text)

    def say(self, text: str) -> None:
        """Print a line of talk on stderr; left out under --quiet."""
        if not self.quiet:
            _write(sys.stderr, text)

    def warn(self, text: str) -> None:
        """Print a warning on stderr; left out under --quiet."""
        if not self.quiet:
            _write(sys.stderr, f"{paint('warning', 'yellow', sys.stderr)}: {text}")

    def print_json(self, value: Any) -> None:
        """Print *value* as JSON on stdout if --json was asked for."""
        if self.json:
            print_json(value)

    def table(self, columns: Sequence[Column], rows: Sequence[Sequence[str]]) -> None:
        """Print a table on stdout: framed on a terminal that is wide enough, aligned plain lines elsewhere."""
        if self.json:
            return
        lines = aligned(columns, rows)
        if not is_terminal(sys.stdout):
            _write(sys.stdout, "\n".join(lines))
            return
        width = shutil.get_terminal_size().columns
        frame = len(columns) + 3  # beside the two spaces between columns
        if max(map(len, lines)) + frame <= width:
            _rich_table(columns, rows)
        else:
            _write(sys.stdout, "\n".join(stacked(columns, rows, width)))


def print_json(value: Any) -> None:
    """Print *value* as JSON on stdout."""
    _write(sys.stdout, json.dumps(value, indent=2, allow_nan=False))


def print_error(text: str, *, bare: bool = False) -> None:
    """Print an error on stderr, whatever was asked for; *bare* without the word "error"."""
    _write(sys.stderr, text if bare else f"{paint('error', 'red', sys.stderr)}: {text}")


class OutputLost(OSError):
    """What a command had to say cannot be written: the disk behind a redirection is full, or stdout is closed."""


class ClosedOutput(io.TextIOBase):
    """Stands for a standard output that was closed before the program started, as `>&-` does."""

    def write(self, text: str) -> int:
        """Refuse, as a write to the closed descriptor would."""
        raise OSError(errno.EBADF, "it is closed")

    def fileno(self) -> int:
        """Return the descriptor of stdout."""
        return 1


def open_standard_streams() -> None:
    """
    Give descriptors 0 to 2 back to their purpose where they were closed.

    The next file or socket would get their numbers, and what is meant for a person would go there.
    """
    streams: Any = sys  # typeshed does not know that they may be None
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest free number: this one
    if streams.stdout is None:
        streams.stdout = ClosedOutput()
    if streams.stderr is None:
        streams.stderr = open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115


@contextlib.contextmanager
def losing_output(instead: str) -> Iterator[None]:
    """
    Go on when stdout takes no more: the verdict's exit code matters more than its line.

    Args:
        instead: Where what was to be printed can be found; told on stderr.
    """
    try:
        yield
    except OSError as error:
        tell_lost_output(error, instead)


def tell_lost_output(error: OSError, instead: str = "") -> None:
    """Say on stderr, if anybody hears, that stdout takes no more."""
    let_go_of_output()
    why = error.strerror or str(error)
    with contextlib.suppress(OSError):
        print_error(f"stdout: {why}" + (f"; {instead}" if instead else ""))
    let_go_of_output()


def let_go_of_output() -> None:
    """
    Send the rest of both streams nowhere: whoever read them is gone, as `head` or a closed terminal.

    What is still buffered would fail again whenever it is flushed, at the latest at the interpreter's end.
    """
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            os.dup2(nowhere, stream.fileno())
            stream.flush()
    os.close(nowhere)


def aligned(columns: Sequence[Column], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return one aligned line a row, headings first; numbers to the right."""
    cells = [[column.heading for column in columns], *[list(row) for row in rows]]
    widths = [max(len(row[index]) for row in cells) for index in range(len(columns))]
    lines = []
    for row in cells:
        padded = [
            cell.rjust(width) if column.is_number else cell.ljust(width)
            for cell, width, column in zip(row, widths, columns, strict=True)
        ]
        lines.append("  ".join(padded).rstrip())
    return lines


def stacked(columns: Sequence[Column], rows: Sequence[Sequence[str]], width: int) -> list[str]:
    """
    Return the columns that fit on a line, aligned, and below each row the others, one a line.

    No word is cut: what stands there may be a command that is to be copied.
    """
    count = len(columns)
    while count > 1 and max(map(len, aligned(columns[:count], [r[:count] for r in rows]))) > width:
        count -= 1
    head, *lines = aligned(columns[:count], [row[:count] for row in rows])
    told = [head]
    for line, row in zip(lines, rows, strict=True):
        told.append(line)
        for column, cell in zip(columns[count:], row[count:], strict=True):
            text = f"{column.heading}: {cell}" if column.heading else cell
            told += _wrapped(text, width) if cell else []
    return told


def _wrapped(text: str, width: int) -> list[str]:
    return textwrap.wrap(
        text,
        width,
        initial_indent="  ",
        subsequent_indent="    ",
        break_long_words=False,
        break_on_hyphens=False,
    )


def is_terminal(stream: TextIO) -> bool:
    """Tell whether a person looks at *stream* through a terminal that can do more than plain lines."""
    return stream.isatty() and os.environ.get("TERM") != "dumb"


def paint(text: str, colour: str, stream: TextIO) -> str:
    """Return *text* in red, yellow or green, if *stream* is a terminal and NO_COLOR is not set."""
    codes: Mapping[str, str] = {"red": "31", "green": "32", "yellow": "33"}
    if os.environ.get("NO_COLOR") or not is_terminal(stream):
        return text
    return f"\x1b[{codes[colour]}m{text}\x1b[0m"


def _write(stream: TextIO, text: str) -> None:
    try:
        stream.write(text + "\n")
        stream.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputLost(error.errno, error.strerror) from error


def _rich_table(columns: Sequence[Column], rows: Sequence[Sequence[str]]) -> None:
    from rich.console import Console as RichConsole
    from rich.table import Table
    from rich.text import Text

    table = Table()
    for column in columns:
        table.add_column(column.heading, justify="right" if column.is_number else "left")
    for row in rows:
        table.add_row(*[Text(cell) for cell in row])
    RichConsole().print(table)
