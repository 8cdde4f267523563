"""
The operator's ssh configuration: OpenSSH's ssh_config files, of which a part is understood.

That part is Host, Match (all, final, host, originalhost, user, localuser, exec), Include, and the keywords
in KEYWORDS with their tokens. Read here and not through paramiko, whose import takes longer than opening the
connections, and which knows no Include; and not by `ssh -G`, which answers for one host: one process per
machine, all of them at once, made `exec` on 24 boards 1.20 times as long (median of 20 interleaved pairs).
"""

from __future__ import annotations

import functools
import getpass
import glob
import os
import re
import shlex
import socket
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from cosmos_cli.errors import InputError
from madns_runtime.bounded_files import FileRefused, read_regular_file

INCLUDE_DEPTH_MAX = 16
CONFIG_BYTES_MAX = 16 * 1024 * 1024
MATCH_EXEC_TIMEOUT_S = 10.0
SYSTEM_FOLDER = "/etc/ssh"
KEYWORDS = (
    "connecttimeout",
    "globalknownhostsfile",
    "hashknownhosts",
    "hostkeyalias",
    "hostname",
    "identitiesonly",
    "identityagent",
    "identityfile",
    "port",
    "proxycommand",
    "proxyjump",
    "stricthostkeychecking",
    "user",
    "userknownhostsfile",
)
REPEATED = ("identityfile",)
"""These add up; of all others the first value wins."""
WHOLE_LINES = ("proxycommand",)
"""Their value is the rest of the line, for a shell."""
LISTS = ("globalknownhostsfile", "userknownhostsfile")
WITH_TOKENS = (
    "identityagent",
    "identityfile",
    "proxycommand",
    "proxyjump",
    "userknownhostsfile",
)

_LINE = re.compile(r"\s*([A-Za-z0-9]+)(?:\s*=\s*|\s+)(.*?)\s*")
_PIECE = re.compile(r"""\"(?:\\[\\"']|[^"])*+\"|'(?:\\[\\"']|[^'])*+'|\\[\\"' ]|[^"' \t]""")
_WORD = re.compile(rf"(?:{_PIECE.pattern})++(?=[ \t]|$)")
_TOKEN = re.compile(r"%(.)")
_VARIABLE = re.compile(r"\$\{(\w+)\}")

Values = Mapping[str, tuple[str, ...]]
"""Values by keyword in small letters."""


@dataclass(frozen=True, slots=True)
class Line:
    """One line of a file, and the sections that it stands in, itself included files' outer ones."""

    keyword: str
    value: str
    place: str
    sections: tuple[Line, ...] = ()


@dataclass(slots=True)
class _Query:
    """Query of the configuration, and the values found so far."""

    host: str
    found: dict[str, list[str]]
    is_final: bool = False
    wants_final: bool = False
    verdicts: dict[int, bool] = field(default_factory=dict)
    """Whether a section applies, by the identity of its line; decided when it is reached."""

    def first(self, keyword: str) -> str | None:
        values = self.found.get(keyword)
        return values[0] if values else None


class SshConfig:
    """
    A parsed configuration.

    Args:
        lines: Of all files, in the order in which they count.
    """

    def __init__(self, lines: Sequence[Line]) -> None:
        self._lines = tuple(lines)

    def lookup(self, host: str, given: Mapping[str, str] | None = None) -> Values:
        """
        Return what is configured for a host.

        Args:
            host: As it is called, perhaps an alias.
            given: Values that win, as those of ssh's command line do.

        Raises:
            InputError: A token or a criterion is not understood.
        """
        query = _Query(
            host=host, found={keyword: [value] for keyword, value in (given or {}).items()}
        )
        self._pass(query)
        if query.wants_final:
            # As in ssh: where the host is, is settled by now, and is what Host means from here on.
            query.found.setdefault("hostname", [host])
            query.is_final = True
            self._pass(query)
        tokens = _tokens(query)
        return {
            keyword: tuple(
                _expanded(value, tokens) if keyword in WITH_TOKENS else value for value in values
            )
            for keyword, values in query.found.items()
        }

    def _pass(self, query: _Query) -> None:
        for line in self._lines:
            if line.keyword in ("host", "match"):
                is_reached = all(query.verdicts[id(section)] for section in line.sections)
                query.verdicts[id(line)] = is_reached and _applies(line, query)
            elif all(query.verdicts[id(section)] for section in line.sections):
                _take(line, query)


def _take(line: Line, query: _Query) -> None:
    words = [line.value] if line.keyword in WHOLE_LINES else _split(line)
    value = shlex.join(words) if line.keyword in LISTS else " ".join(words)
    if line.keyword == "connecttimeout" and value.lower() == "none":
        return  # as in ssh, where it says nothing, and what stands below counts
    values = query.found.setdefault(line.keyword, [])
    if line.keyword == "hostname":
        value = _expanded(value, {"h": query.host})
    if not values or (line.keyword in REPEATED and value not in values):
        values.append(value)


def _applies(line: Line, query: _Query) -> bool:
    words = _split(line)
    if line.keyword == "host":
        name = (query.first("hostname") or query.host).lower() if query.is_final else query.host
        return matches_exactly(words, name)
    is_match = True
    while words:
        criterion = words.pop(0).lower()
        is_wanted = not criterion.startswith("!")
        criterion = criterion.lstrip("!")
        if criterion == "all":
            holds = True
        elif criterion in ("final", "canonical"):
            query.wants_final |= criterion == "final"
            holds = query.is_final
        elif criterion in _CRITERIA and words:
            argument = words.pop(0)
            # As in ssh: a command is not run when the line cannot match any more.
            holds = is_match and _CRITERIA[criterion](argument, query)
        else:
            known = ", ".join(("all", "final", *_CRITERIA))
            raise InputError(
                f"{line.place}: criterion of Match is not understood: expected {known}, got {criterion};"
                " a file without it can be named in COSMOS_SSH_CONFIG"
            )
        is_match = is_match and holds == is_wanted
    return is_match


def _match_exec(command: str, query: _Query) -> bool:
    try:
        subprocess.run(
            ["/bin/sh", "-c", _expanded(command, _tokens(query))],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            timeout=MATCH_EXEC_TIMEOUT_S,
            check=True,
        )
        return True
    except (subprocess.TimeoutExpired, subprocess.CalledProcessError):
        return False


_CRITERIA: dict[str, Callable[[str, _Query], bool]] = {
    "host": lambda text, query: matches(text.split(","), query.first("hostname") or query.host),
    "originalhost": lambda text, query: matches(text.split(","), query.host),
    "user": lambda text, query: matches_exactly(
        text.split(","), query.first("user") or local_user()
    ),
    "localuser": lambda text, query: matches_exactly(text.split(","), local_user()),
    "exec": _match_exec,
}


def matches(patterns: Sequence[str], name: str) -> bool:
    """Tell whether a host's name, which has no case, fits a list of patterns as `matches_exactly`."""
    return matches_exactly([pattern.lower() for pattern in patterns], name.lower())


def matches_exactly(patterns: Sequence[str], name: str) -> bool:
    """Tell whether a name fits a list of OpenSSH's patterns: * and ?, and ! for what must not fit."""
    if any(_fits(pattern[1:], name) for pattern in patterns if pattern.startswith("!")):
        return False
    return any(_fits(pattern, name) for pattern in patterns if pattern[:1] != "!")


def _fits(pattern: str, name: str) -> bool:
    if "*" in pattern or "?" in pattern:
        return glob_of(pattern).fullmatch(name) is not None
    return pattern == name  # most are plain names, one per machine


@functools.lru_cache(maxsize=4096)
def glob_of(pattern: str) -> re.Pattern[str]:
    """Return OpenSSH's pattern, in which only * and ? are special: brackets belong to [host]:port."""
    return re.compile(re.escape(pattern).replace(r"\*", ".*").replace(r"\?", "."))


def local_user() -> str:
    """Return who runs this process: by number where no name goes with it, as in a container that is given any user."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # KeyError before Python 3.13
        return str(os.getuid())


def _tokens(query: _Query) -> dict[str, str]:
    local = socket.gethostname()
    return {
        "h": query.first("hostname") or query.host,
        "n": query.host,
        "p": query.first("port") or "22",
        "r": query.first("user") or local_user(),
        "k": query.first("hostkeyalias") or query.host,
        "u": local_user(),
        "i": str(os.getuid()),
        "d": os.path.expanduser("~"),
        "l": local,
        "L": local.split(".")[0],
    }


def _expanded(value: str, tokens: Mapping[str, str]) -> str:
    def replace(match: re.Match[str]) -> str:
        token = match.group(1)
        if token == "%":
            return "%"
        if token not in tokens:
            raise InputError(f"ssh configuration: token %{token} of {value!r} is not understood")
        return tokens[token]

    value = _TOKEN.sub(replace, value)
    return _VARIABLE.sub(lambda match: os.environ.get(match.group(1), ""), value)


def _split(line: Line) -> list[str]:
    try:
        return list(_words(line.value))
    except ValueError as error:
        raise InputError(f"{line.place}: {error}, got {line.value!r}") from error


@functools.lru_cache(maxsize=1024)
def _words(text: str) -> tuple[str, ...]:
    """Return a line's words as OpenSSH's argv_split makes them; each machine of a fleet asks for the same lines."""
    words, rest = [], text.strip(" \t")
    while rest and not rest.startswith("#"):  # within a word it begins no comment
        word = _WORD.match(rest)
        if word is None:
            raise ValueError("No closing quotation")
        words.append(_PIECE.sub(_unquoted, word[0]))
        rest = rest[word.end() :].lstrip(" \t")
    return tuple(words)


def _unquoted(piece: re.Match[str]) -> str:
    text = piece[0]
    quote = text[0] if len(text) > 1 and text[0] in "\"'" else ""
    escaped = "\\\"'" if quote else "\\\"' "
    inner = text[1:-1] if quote else text
    return re.sub(rf"\\([{re.escape(escaped)}])", r"\1", inner)


def read_config(files: Sequence[Path]) -> SshConfig:
    """
    Read configurations; those that are not there are left out.

    Raises:
        InputError: One cannot be read, or a line of it is not understood.
    """
    return SshConfig([line for file in files for line in _lines(file, (), 0)])


def _text(file: Path) -> str:
    if str(file) == os.devnull:  # how one tells ssh to read none
        return ""
    return read_regular_file(file, bytes_max=CONFIG_BYTES_MAX).decode()


def _lines(file: Path, outer: tuple[Line, ...], depth: int) -> Iterator[Line]:
    try:
        text = _text(file)
    except FileNotFoundError:
        return
    except FileRefused as error:
        raise InputError(f"{error}; it is read as an ssh configuration") from error
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: cannot be read as an ssh configuration: {error}") from error
    sections = outer
    for number, row in enumerate(text.splitlines(), start=1):
        if not row.strip() or row.lstrip().startswith("#"):
            continue
        place = f"{file}:{number}"
        match = _LINE.fullmatch(row)
        if match is None:
            raise InputError(f"{place}: expected a keyword and a value, got {row.strip()!r}")
        keyword = match.group(1).lower()
        if keyword in ("host", "match"):
            section = Line(keyword, match.group(2), place, outer)
            sections = (*outer, section)
            yield section
        elif keyword == "include":
            for name in _included(Line(keyword, match.group(2), place), file):
                if depth >= INCLUDE_DEPTH_MAX:
                    raise InputError(f"{place}: more than {INCLUDE_DEPTH_MAX} files in one another")
                yield from _lines(name, sections, depth + 1)
        elif keyword in KEYWORDS:
            yield Line(keyword, match.group(2), place, sections)


def _included(line: Line, file: Path) -> list[Path]:
    folder = SYSTEM_FOLDER if str(file).startswith(SYSTEM_FOLDER) else "~/.ssh"
    patterns = [
        os.path.join(os.path.expanduser(folder), os.path.expanduser(word)) for word in _split(line)
    ]
    return [Path(name) for pattern in patterns for name in sorted(glob.glob(pattern))]
