"""
The operator's side of what works on a machine: sends the sources of `cosmos_cli.fleet.onboard`, then asks.

One connection, one process there, one frame a question. For the pool's threads: every call has a deadline.
"""

from __future__ import annotations

import functools
import importlib.util
import json
import marshal
import re
import shlex
import threading
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.abc import InspectLoader
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from cosmos_cli.fleet.connection import Connection, Stream
from cosmos_cli.fleet.failure import FailureKind, MachineFailure

PARTS = "cosmos_cli.fleet.onboard"
PYTHON_NEEDED = (3, 11)
PYTHONS = ("python3", "python3.13", "python3.12", "python3.11", "/usr/bin/python3")
START_TIMEOUT_S = 20.0
CALL_TIMEOUT_S = 30.0
READ_BYTES = 262_144
FRAME_BYTES_MAX = 1024 * 1024 * 1024

_BOOT = (
    "import marshal,sys,zlib;PACKAGE=sys.stdin.buffer.read(int(sys.argv[1]));"
    "SENT=marshal.loads(zlib.decompress(PACKAGE));exec(SENT['opening'])"
)
_PACKAGE_LOCK = threading.Lock()
COMPRESSION_LEVEL = 1
MARSHAL_VERSION = 4
"""That every Python from 3.4 on reads."""
_VERB = re.compile(r'^@verb\("([^"]+)"\)', re.MULTILINE)

# Must be understood by any Python 3, to say so when it is too old. A module is loaded when one of its verbs
# is first asked for: most commands need a few of those that are sent. What was compiled here saves a Python
# of the same kind the work: a tenth of what a look costs a board's processor.
_OPENING = """
import json, marshal, sys
if sys.version_info[:2] < SENT["needed"]:
    found = ".".join(map(str, sys.version_info[:3]))
    told = {"kind": "python", "text": "%s is Python %s" % (sys.executable, found), "advice": ""}
    print(json.dumps({"ok": False, "error": told, "body": 0}), flush=True)
    sys.exit(3)
is_same = getattr(sys.modules.get("_frozen_importlib_external"), "MAGIC_NUMBER", None) == SENT["magic"]
class Finder:
    modules = SENT["modules"]
    def find_spec(self, name, path=None, target=None):
        if name in self.modules:
            return type(sys.__spec__)(name, self, is_package=self.modules[name] is None)
    def create_module(self, spec):
        return None
    def exec_module(self, module):
        name = module.__name__
        if self.modules[name] is not None:
            source, code = self.modules[name]
            code = marshal.loads(code) if is_same else compile(source, name, "exec")
            exec(code, module.__dict__)
sys.meta_path.insert(0, Finder())
core = __import__(SENT["core"], fromlist=["serve"])
core.WHERE.update(SENT["verbs"])
core.greet()
core.serve([sys.executable, "-I", "-S", "-c", SENT["boot"], str(len(PACKAGE))], PACKAGE)
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """What a machine answered."""

    value: Any
    body: bytes = b""


class Board:
    """
    The process that works on one machine.

    Use it as a context manager; leaving it ends that process.

    Args:
        stream: To the process; it has greeted already.
        greeting: What it said of itself: python, executable, machine, bits, libc, uid, home, node, pid.
    """

    def __init__(self, stream: Stream) -> None:
        self._stream = stream
        self._buffer = bytearray()
        self.greeting: Mapping[str, Any] = {}

    @classmethod
    def start(
        cls,
        connection: Connection,
        parts: Sequence[str] = (),
        *,
        timeout_s: float = START_TIMEOUT_S,
    ) -> Board:
        """
        Start it on a machine.

        Args:
            connection: To the machine.
            parts: Modules of `cosmos_cli.fleet.onboard` whose verbs are wanted, such as "facts"; a full
                module name for one from elsewhere. `core` is always there.
            timeout_s: Until it has greeted.

        Raises:
            MachineFailure: No Python there or one that is too old, or the connection is lost.
        """
        with _PACKAGE_LOCK:  # made once, not by every thread that begins at the same moment
            package = _package(tuple(parts))
        board = cls(connection.open(start_command(connection.target.python, len(package))))
        try:
            board._stream.write_all(package, timeout_s=timeout_s)
            board.greeting = board._read_answer(timeout_s).value
        except MachineFailure as failure:
            explained = board._explain(failure, connection)
            board.close()  # of a channel that is closed nobody learns how it ended; of a process here, sooner
            if explained is failure:
                explained = board._explain(failure, connection)
            raise explained from None
        return board

    def call(
        self,
        verb: str,
        arguments: Mapping[str, Any] | None = None,
        *,
        body: bytes = b"",
        as_root: bool = False,
        timeout_s: float = CALL_TIMEOUT_S,
    ) -> Answer:
        """
        Ask for one thing and wait for the answer.

        Raises:
            MachineFailure: It was refused, or the connection is lost, or *timeout_s* is over.
        """
        self._ask(verb, arguments, body, as_root=as_root, timeout_s=timeout_s)
        return self._read_answer(timeout_s)

    def parts(
        self,
        verb: str,
        arguments: Mapping[str, Any] | None = None,
        *,
        as_root: bool = False,
        timeout_s: float = CALL_TIMEOUT_S,
    ) -> Iterator[Answer]:
        """
        Ask for something that comes in pieces; read all of them before the next question.

        Args:
            verb: What is asked.
            arguments: Plain values.
            as_root: Whether root is asked.
            timeout_s: For each piece.

        Raises:
            MachineFailure: As `call`.
        """
        self._ask(verb, arguments, b"", as_root=as_root, timeout_s=timeout_s)
        while True:
            header, body = self._read_frame(timeout_s)
            if not header.get("part"):
                return
            yield Answer(value=header.get("value"), body=body)

    def close(self) -> None:
        """Let the process there end; harmless when repeated."""
        self._stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _ask(
        self,
        verb: str,
        arguments: Mapping[str, Any] | None,
        body: bytes,
        *,
        as_root: bool,
        timeout_s: float,
    ) -> None:
        header = {"verb": verb, "arguments": arguments or {}, "root": as_root, "body": len(body)}
        line = json.dumps(header, separators=(",", ":")).encode() + b"\n"
        self._stream.write_all(line + body if body else line, timeout_s=timeout_s)

    def _read_answer(self, timeout_s: float) -> Answer:
        header, body = self._read_frame(timeout_s)
        return Answer(value=header.get("value"), body=body)

    def _read_frame(self, timeout_s: float) -> tuple[dict[str, Any], bytes]:
        end = self._buffer.find(b"\n")
        while end < 0:
            searched = len(self._buffer)
            self._more(timeout_s)
            end = self._buffer.find(b"\n", searched)
        header = _header(bytes(self._buffer[:end]))
        size = end + 1 + int(header["body"])
        while len(self._buffer) < size:
            self._more(timeout_s)
        body = bytes(self._buffer[end + 1 : size])
        del self._buffer[:size]
        if not header.get("ok"):
            raise _failure(header.get("error") or {})
        return header, body

    def _more(self, timeout_s: float) -> None:
        data = self._stream.read_some(READ_BYTES, timeout_s=timeout_s)
        if not data:
            said = self._stream.errors().strip()
            raise MachineFailure(
                FailureKind.LOST, "what worked there ended early" + (f": {said}" if said else "")
            )
        self._buffer += data

    def _explain(self, failure: MachineFailure, connection: Connection) -> MachineFailure:
        """Say of a start that failed what it was: most often there is no Python that would do."""
        needed = ".".join(map(str, PYTHON_NEEDED))
        advice = (
            f"install Python {needed} or later there, or name one with ansible_python_interpreter"
        )
        if failure.kind is FailureKind.PYTHON:
            text = f"{failure.text}, expected {needed} or later"
            return MachineFailure(FailureKind.PYTHON, text, advice)
        if self._stream.exit_status() == NO_PYTHON_STATUS:
            wanted = connection.target.python
            text = f"{wanted}: no such interpreter" if wanted else "no Python 3 found"
            return MachineFailure(FailureKind.PYTHON, text, advice)
        return failure


NO_PYTHON_STATUS = 127


def start_command(python: str | None, package_bytes: int) -> str:
    """Return the shell command that starts the loop with the first interpreter that there is."""
    candidates = " ".join(shlex.quote(p) for p in ((python,) if python else PYTHONS))
    return (
        f'for p in {candidates}; do command -v "$p" >/dev/null 2>&1 &&'
        f' exec "$p" -I -S -c {shlex.quote(_BOOT)} {package_bytes}; done; exit {NO_PYTHON_STATUS}'
    )


@functools.lru_cache
def _package(parts: tuple[str, ...]) -> bytes:
    """Return the program that is sent, packed: the wanted modules and what starts them."""
    names = [f"{PARTS}.core", *(p if "." in p else f"{PARTS}.{p}" for p in parts)]
    modules: dict[str, tuple[str, bytes] | None] = {}
    verbs: dict[str, str] = {}
    for name in names:
        steps = name.split(".")
        for depth in range(1, len(steps)):
            modules.setdefault(".".join(steps[:depth]), None)
        modules[name] = module = _module(name)
        verbs |= dict.fromkeys(_VERB.findall(module[0]), name)
    sent = {
        "opening": _OPENING,
        "boot": _BOOT,
        "needed": PYTHON_NEEDED,
        "magic": importlib.util.MAGIC_NUMBER,
        "core": f"{PARTS}.core",
        "modules": modules,
        "verbs": verbs,
    }
    return zlib.compress(marshal.dumps(sent, MARSHAL_VERSION), COMPRESSION_LEVEL)


def _module(name: str) -> tuple[str, bytes]:
    """Return a module's source, and the same compiled for this very version of Python."""
    spec = importlib.util.find_spec(name)
    if spec is None or spec.origin is None or not isinstance(spec.loader, InspectLoader):
        raise ModuleNotFoundError(f"no module {name} to send to a machine")
    source = Path(spec.origin).read_text(encoding="utf-8")
    return source, marshal.dumps(spec.loader.get_code(name))


def _header(line: bytes) -> dict[str, Any]:
    try:
        header = json.loads(line)
        if isinstance(header, dict) and 0 <= int(header["body"]) <= FRAME_BYTES_MAX:
            return header
    except (ValueError, KeyError, TypeError):
        pass
    said = line[:200].decode(errors="replace")
    raise MachineFailure(
        FailureKind.DATA,
        f"expected an answer, got {said!r}",
        "a shell start-up file there (.bashrc, .profile) that prints in sessions that are not"
        " interactive must be silent",
    )


def _failure(error: Mapping[str, Any]) -> MachineFailure:
    try:
        kind = FailureKind(error.get("kind", ""))
    except ValueError:
        kind = FailureKind.STEP
    return MachineFailure(kind, str(error.get("text", "")), str(error.get("advice", "")))
