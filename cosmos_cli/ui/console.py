"""
The command line's output: stdout is data, stderr is talk.

All that is printed goes through here or through `cosmos_cli.ui.rich_console`, and is cleaned on its way: text of a
board, an exception, a file or a path cannot steer the terminal (`cosmos_cli.ui.foreign_text`); a test holds that no
other module writes to the standard streams. Streams are looked up at each call, so that tests and pipes may
replace them. Rich is imported only for a table on a terminal.
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
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, TextIO

import typer

from cosmos_cli.errors import InputError
from cosmos_cli.system.import_turn import IMPORT_TURN
from cosmos_cli.ui import invocation
from cosmos_cli.ui.foreign_text import clean_line, clean_text

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

WORK_GOES_ON = "the work on machines goes on; the exit code tells"
"""Of commands that do something on machines: as `Console.instead`."""
AGREEMENTS = ("y", "yes")
TALK_CHARACTERS_MAX = 100_000
"""An exception's text or a machine's answer may be of any length; what is meant for eyes is not."""


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a table: its heading, and whether its cells are numbers."""

    heading: str
    is_number: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Console:
    """Output of a command, in the form that was asked for."""

    json: bool = False
    """The result goes to stdout as JSON; lines meant for eyes are left out."""
    quiet: bool = False
    instead: str | None = None
    """
    Of a command that works on when stdout takes no more: where its result can be found; told once on stderr.
    None: it ends there, as `cosmos logs -f | head` must.
    """
    lost: list[OSError] = field(default_factory=list)
    """Why stdout took no more, of a command that worked on: not that its reader had gone, who wanted no more."""

    def data(self, text: str) -> None:
        """Print a line of the result on stdout; left out under --json."""
        if not self.json:
            with self._losing_output():
                _write(sys.stdout, text)

    def say(self, text: str, *, length_max: int | None = TALK_CHARACTERS_MAX) -> None:
        """Print a line of talk on stderr, cut after *length_max* characters; left out under --quiet."""
        if not self.quiet:
            with losing_talk():
                _write(sys.stderr, text, length_max=length_max)

    def warn(self, text: str) -> None:
        """Print a warning on stderr; left out under --quiet."""
        if not self.quiet:
            with losing_talk():
                tell(sys.stderr, text, word="warning", colour="yellow")

    def print_json(self, value: Any) -> None:
        """Print *value* as JSON on stdout if --json was asked for."""
        if self.json:
            with self._losing_output():
                print_json(value)

    def print_json_line(self, value: Any) -> None:
        """Print *value* as one line of JSON on stdout if --json was asked for: of many values, each as it comes."""
        if self.json:
            print_json_line(value)

    def table(self, columns: Sequence[Column], rows: Sequence[Sequence[str]]) -> None:
        """Print a table on stdout: framed on a terminal that is wide enough, aligned plain lines elsewhere."""
        if self.json:
            return
        with self._losing_output():
            _print_table(columns, rows)

    def _losing_output(self) -> contextlib.AbstractContextManager[None]:
        if self.instead is None:
            return contextlib.nullcontext()
        return losing_output(self.instead, self._note_lost)

    def _note_lost(self, error: OSError) -> None:
        if not isinstance(error, BrokenPipeError):
            self.lost.append(error)


def _print_table(columns: Sequence[Column], rows: Sequence[Sequence[str]]) -> None:
    rows = [[clean_line(cell, length_max=None) for cell in row] for row in rows]
    lines = aligned(columns, rows)
    if not is_terminal(sys.stdout):
        _write(sys.stdout, "\n".join(lines))
        return
    width = shutil.get_terminal_size().columns
    frame = len(columns) + 3  # beside the two spaces between columns
    if max(map(len, lines)) + frame <= width:
        with IMPORT_TURN:
            from cosmos_cli.ui.rich_console import print_table  # a tenth of a second to import

        print_table([(column.heading, column.is_number) for column in columns], rows)
    else:
        _write(sys.stdout, "\n".join(stacked(columns, rows, width)))


def print_json(value: Any) -> None:
    """Print *value* as JSON on stdout: the one document of the command."""
    invocation.note_result()
    _write(sys.stdout, json.dumps(value, indent=2, allow_nan=False))


def print_json_line(value: Any) -> None:
    """Print *value* as one line of JSON on stdout."""
    _write(sys.stdout, json.dumps(value, allow_nan=False))


def print_error(text: str, *, bare: bool = False) -> None:
    """Print an error on stderr, whatever was asked for; *bare* without the word "error"."""
    tell(sys.stderr, text, word="" if bare else "error", colour="red")


def tell(stream: TextIO, text: str, *, word: str = "", colour: str = "") -> None:
    """
    Write talk to a stream, for views that keep to one.

    Args:
        stream: Standard error, or what stands for it.
        text: Cleaned, and cut after TALK_CHARACTERS_MAX.
        word: Such as "warning", written before the text.
        colour: Of the word, where the stream is a terminal.
    """
    mark = f"{paint(word, colour, stream)}: " if word else ""
    _write(stream, text, mark=mark, length_max=TALK_CHARACTERS_MAX)


def confirm(question: str, *, is_sure: bool) -> bool:
    """
    Ask on the terminal whether to go on; the answer no is the default.

    Args:
        question: Names what will be done.
        is_sure: Whether --yes was given: nobody is asked.

    Raises:
        InputError: There is no terminal to ask at.
    """
    if is_sure:
        return True
    if not sys.stdin.isatty():
        raise InputError(f"{question} there is no terminal to ask at: give --yes to agree")
    _write(sys.stderr, clean_line(f"{question} [y/N]"), end=" ")
    return sys.stdin.readline().strip().lower() in AGREEMENTS


def wait_for_enter(text: str, *, instead: str) -> None:
    """
    Ask on the terminal for something to be done, and wait until Enter is pressed.

    Args:
        text: What to do.
        instead: What to do without a terminal.

    Raises:
        InputError: There is no terminal to ask at, or it has ended.
    """
    if not sys.stdin.isatty():
        raise InputError(f"{text}: there is no terminal to ask at: {instead}")
    _write(sys.stderr, clean_line(f"{text}, then press Enter"), end=" ")
    if not sys.stdin.readline():
        raise InputError(f"{text}: the terminal has ended: {instead}")


class OutputLost(OSError):
    """Failure to write output: the disk behind a redirection is full, or stdout is closed."""


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
    Give descriptors 0 to 2 back to their purpose where they were closed, and a buffer to output that has none.

    The next file or socket would get their numbers, and what is meant for a person would go there. Under
    PYTHONUNBUFFERED a write that was cut, by a reader that goes or a disk that fills up, is taken for a whole one.
    """
    streams: Any = sys  # typeshed does not know that they may be None
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest free number: this one
    if streams.stdin is None:
        streams.stdin = open(0, encoding="utf-8", closefd=False)  # noqa: SIM115 - as long as the process
    if streams.stdout is None:
        streams.stdout = ClosedOutput()
    if streams.stderr is None:
        streams.stderr = open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115 - as long as the process
    for name in ("stdout", "stderr"):
        stream = getattr(streams, name)
        if isinstance(stream, io.TextIOWrapper) and isinstance(stream.buffer, io.RawIOBase):
            setattr(streams, name, _buffered(stream))
    if isinstance(streams.stdout, io.TextIOWrapper):
        # As Python itself has it for stderr: under a locale that has no word for a letter it is shown as an escape.
        streams.stdout.reconfigure(errors="backslashreplace")


def _buffered(stream: io.TextIOWrapper) -> TextIO:
    """Return a stream to the same file, flushed after each line, in which a write that was cut goes on or fails."""
    return open(  # noqa: SIM115 - as long as the process
        stream.fileno(),
        "w",
        buffering=1,
        encoding=stream.encoding,
        errors=stream.errors,
        closefd=False,
    )


@contextlib.contextmanager
def losing_output(instead: str, note: Callable[[OSError], None] | None = None) -> Iterator[None]:
    """
    Go on when stdout takes no more: the verdict's exit code matters more than its line.

    Args:
        instead: Where what was to be printed can be found; told on stderr.
        note: Told why stdout took no more.
    """
    try:
        yield
    except OSError as error:
        if note is not None:
            note(error)
        tell_lost_output(error, instead)


@contextlib.contextmanager
def losing_talk() -> Iterator[None]:
    """Go on when stderr takes no more, as behind `2>&1 | head`: nobody listens, and the work matters more."""
    try:
        yield
    except OSError:
        let_go_of_output(sys.stderr)


def tell_lost_output(error: OSError, instead: str = "") -> None:
    """Say on stderr, if anybody hears, that stdout takes no more."""
    let_go_of_output(sys.stdout)
    why = error.strerror or str(error)
    with contextlib.suppress(OSError):
        print_error(f"stdout: {why}" + (f"; {instead}" if instead else ""))
    let_go_of_output()


def let_go_of_output(lost: object = None) -> None:
    """
    Send the rest of both streams nowhere: whoever read them is gone, as `head` or a closed terminal.

    What is still buffered would fail again whenever it is flushed, at the latest at the interpreter's end.

    Args:
        lost: One that failed, and under PYTHONUNBUFFERED has kept nothing that would fail again.
    """
    if isinstance(lost, ClosedOutput):
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - as long as the process
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (sys.stdout, sys.stderr):
        is_lost = stream is lost
        try:
            stream.flush()
            if is_lost:
                os.dup2(nowhere, stream.fileno())
        except OSError:
            os.dup2(nowhere, stream.fileno())
            stream.flush()
    os.close(nowhere)


def aligned(columns: Sequence[Column], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return one aligned line per row, headings first; numbers to the right."""
    cells = [[column.heading for column in columns], *[list(row) for row in rows]]
    widths = [max(len(row[index]) for row in cells) for index in range(len(columns))]

    def line(row: Sequence[str]) -> str:
        padded = [
            cell.rjust(width) if column.is_number else cell.ljust(width)
            for cell, width, column in zip(row, widths, columns, strict=True)
        ]
        return "  ".join(padded).rstrip()

    return [line(row) for row in cells]


def stacked(columns: Sequence[Column], rows: Sequence[Sequence[str]], width: int) -> list[str]:
    """
    Return the columns that fit on a line, aligned, and below each row the others, one per line.

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


def _write(
    stream: TextIO, text: str, *, mark: str = "", end: str = "\n", length_max: int | None = None
) -> None:
    """Write *text*, cleaned, behind a *mark* of our own."""
    try:
        stream.write(f"{mark}{clean_text(text, length_max=length_max)}{end}")
        stream.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputLost(error.errno, error.strerror) from error
