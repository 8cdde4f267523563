"""
The operator's side of what works on a machine: sends the sources of `cosmos_cli.onboard`, then asks.

One connection, one process there, one frame per question. For the pool's threads: every call has a deadline.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib.util
import json
import marshal
import re
import shlex
import threading
import time
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.abc import InspectLoader
from pathlib import Path
from typing import Any, Self

from cosmos_cli.fleet.answers.parts import greeting
from cosmos_cli.fleet.answers.reader import READ_BYTES, AnswerReader, ExpectedAnswer
from cosmos_cli.fleet.answers.verbs import BODY_BYTES_MAX, answer_shape, failure_of
from cosmos_cli.fleet.connection import EXIT_STATUS_TIMEOUT_S, Connection, Stream
from cosmos_cli.fleet.failure import EndedEarly, FailureKind, MachineFailure, runs_no_commands
from cosmos_cli.fleet.liveness import BlockingStream, SilenceWatch, SilentMachine
from cosmos_cli.fleet.shell import NO_PYTHON_HOME, SYSTEM_PATH, for_login_shell
from cosmos_cli.fleet.transfer_limits import Patience, duration_words
from cosmos_cli.onboard.request_loop import SUDO_TIMEOUT_S
from cosmos_cli.ui.step_times import timed

PARTS = "cosmos_cli.onboard"
PYTHON_NEEDED = (3, 11)
PYTHONS = ("python3", "python3.13", "python3.12", "python3.11", "/usr/bin/python3")
START_TIMEOUT_S = 20.0
CALL_TIMEOUT_S = 30.0
ROOT_START_S = 2 * SUDO_TIMEOUT_S + 5.0
"""The machine asks sudo twice, and tells itself when that takes too long."""
WHOLE_TIMEOUT_S = 3600.0
"""Time for an answer in pieces, beside what its bytes are worth."""

LAST_WORDS_S = 5.0
LAST_WORDS_BYTES_MAX = 4 * 1024 * 1024
"""Time and bytes for what comes of a start that has failed."""

_BOOT = (
    "import marshal,sys,zlib;PACKAGE=sys.stdin.buffer.read(int(sys.argv[1]));"
    "SENT=marshal.loads(zlib.decompress(PACKAGE));exec(SENT['opening'])"
)
_PACKAGE_LOCK = threading.Lock()
COMPRESSION_LEVEL = 1
MARSHAL_VERSION = 4
"""Version that every Python from 3.4 on reads."""
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
    """Answer of a machine."""

    value: Any
    body: bytes = b""


class Helper:
    """
    The process that works on one machine.

    Use it as a context manager; leaving it ends that process.

    Args:
        stream: To the process.
        watch: Looks into the machine's silence; None leaves all to the deadlines.
    """

    def __init__(self, stream: Stream, watch: SilenceWatch | None = None) -> None:
        self._stream = stream
        self._link = BlockingStream(stream, watch)
        self._answers = AnswerReader(self._link)
        self._is_out_of_step = False
        self._is_root_asked = False
        self.machine = ""
        """Name of the machine; empty for a helper that was not started by `start`."""
        self.greeting: Mapping[str, Any] = {}
        """Account of the process of itself: python, executable, machine, bits, libc, uid, home, node, pid; empty before."""

    @classmethod
    def start(
        cls,
        connection: Connection,
        parts: Sequence[str] = (),
        *,
        timeout_s: float = START_TIMEOUT_S,
        watch: SilenceWatch | None = None,
    ) -> Helper:
        """
        Start it on a machine.

        Args:
            connection: To the machine.
            parts: Modules of `cosmos_cli.onboard` whose verbs are wanted, such as "facts"; a full
                module name for one from elsewhere. `core` is always there.
            timeout_s: Until it has greeted.
            watch: Looks into the machine's silence; None leaves all to the deadlines.

        Raises:
            MachineFailure: No Python there or one that is too old, or the connection is lost.
        """
        with timed(connection.target.name, "start the helper there"):
            with _PACKAGE_LOCK:  # made once, not by every thread that begins at the same moment
                package = _package(tuple(parts))
            python = connection.target.python
            helper = cls(connection.open(start_command(python, len(package))), watch)
            helper.machine = connection.target.name
            try:
                helper._greet(package, timeout_s)
            except MachineFailure as failure:
                if failure.kind is FailureKind.DATA:
                    helper._read_to_its_end()
                explained = helper._explain(failure, python)
                helper.close()  # of a channel that is closed nobody learns how it ended; of a process here, sooner
                if explained is failure:
                    explained = helper._explain(failure, python)
                raise explained from None
            return helper

    def _greet(self, package: bytes, timeout_s: float) -> None:
        expected = ExpectedAnswer(shape=greeting, what="its start")
        try:
            self._link.write_all(package, timeout_s=timeout_s)
        except MachineFailure as failure:
            if failure.kind is FailureKind.LOST and not isinstance(failure, SilentMachine):
                raise self._last_words(expected) or failure from None
            raise
        self.greeting = self._read_answer(expected, timeout_s=timeout_s)[0]["value"]

    def _last_words(self, expected: ExpectedAnswer) -> MachineFailure | None:
        """Return what a process that has ended said instead of a greeting: it tells more than the end; None for nothing."""
        try:
            self._read_answer(expected, timeout_s=LAST_WORDS_S)
        except MachineFailure as failure:
            return failure if failure.kind in (FailureKind.DATA, FailureKind.PYTHON) else None
        return None

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
        with timed(self.machine, f"ask: {verb}", level=2):
            start_s = self._root_start_s(as_root=as_root)
            self._ask(verb, arguments, body, as_root=as_root, timeout_s=timeout_s)
            expected = _expected(verb, arguments)
            header, body = self._read_answer(expected, timeout_s=timeout_s + start_s)
        return Answer(value=header["value"], body=body)

    def pieces(
        self,
        verb: str,
        arguments: Mapping[str, Any] | None = None,
        *,
        as_root: bool = False,
        timeout_s: float = CALL_TIMEOUT_S,
        whole_s: float = WHOLE_TIMEOUT_S,
    ) -> Iterator[Answer]:
        """
        Ask for something that comes in pieces; read all of them before the next question.

        Args:
            verb: What is asked.
            arguments: Plain values.
            as_root: Whether root is asked.
            timeout_s: For each piece.
            whole_s: For all of them, and for what they bring as much more as `Patience` grants.

        Raises:
            MachineFailure: As `call`.
        """
        with timed(self.machine, f"ask: {verb}", level=2):
            start_s = self._root_start_s(as_root=as_root)
            self._ask(verb, arguments, b"", as_root=as_root, timeout_s=timeout_s)
            expected = dataclasses.replace(_expected(verb, arguments), is_streamed=True)
            patience = Patience(whole_s)
            while True:
                header, body = self._read_answer(expected, timeout_s=timeout_s + start_s)
                start_s = 0.0
                if not header.get("piece"):
                    return
                patience.moved(len(body))
                if patience.left_s <= 0:
                    raise MachineFailure(
                        FailureKind.TIMEOUT, f"not done in {duration_words(patience.spent_s)}"
                    )
                yield Answer(value=header["value"], body=body)

    def close(self) -> None:
        """Let the process there end; harmless when repeated."""
        self._stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _root_start_s(self, *, as_root: bool) -> float:
        """Return how much longer the first answer of root may take: sudo, which may be slow, comes before it."""
        if not as_root or self._is_root_asked or self.greeting.get("uid") == 0:
            return 0.0
        self._is_root_asked = True
        return ROOT_START_S

    def _ask(
        self,
        verb: str,
        arguments: Mapping[str, Any] | None,
        body: bytes,
        *,
        as_root: bool,
        timeout_s: float,
    ) -> None:
        if self._answers.has_rest or self._is_out_of_step:
            raise MachineFailure(
                FailureKind.LOST,
                "an earlier answer of it did not come as it should: what comes now belongs to no question",
                "repeat the command",
            )
        header = {"verb": verb, "arguments": arguments or {}, "root": as_root, "body": len(body)}
        line = json.dumps(header, separators=(",", ":")).encode() + b"\n"
        self._link.write_all(line + body if body else line, timeout_s=timeout_s)

    def _read_answer(
        self, expected: ExpectedAnswer, *, timeout_s: float
    ) -> tuple[dict[str, Any], bytes]:
        """Read one frame; after one that is late or malformed nothing more can be asked."""
        self._is_out_of_step = True
        header, body = self._answers.read(expected, timeout_s=timeout_s)
        self._is_out_of_step = header.get("piece") is True  # the others are still to come
        if not header["ok"]:
            raise failure_of(header["error"])
        return header, body

    def _explain(self, failure: MachineFailure, python: str | None) -> MachineFailure:
        """Say of a start that failed what it was: most often there is no Python that would do."""
        needed = ".".join(map(str, PYTHON_NEEDED))
        advice = (
            f"install Python {needed} or later there, or name one with ansible_python_interpreter"
        )
        if failure.kind is FailureKind.PYTHON:
            return MachineFailure(
                FailureKind.PYTHON, f"{failure.text}, expected {needed} or later", advice
            )
        status = self._stream.ending(timeout_s=EXIT_STATUS_TIMEOUT_S).exit_status
        if status == NO_PYTHON_STATUS:
            return MachineFailure(
                FailureKind.PYTHON,
                f"{python}: no such interpreter" if python else "no Python 3 found",
                advice,
            )
        if failure.kind is FailureKind.DATA and status is not None and status > 0:
            return runs_no_commands(status, failure.text)
        if isinstance(failure, EndedEarly) and status is not None and status >= 0:
            return _ended_at_once(failure, status)
        return failure

    def _read_to_its_end(self) -> None:
        """Let it end and read what else comes, which is of no use, so that the exit status is known if there is one by then."""
        until_s, left_bytes = time.monotonic() + LAST_WORDS_S, LAST_WORDS_BYTES_MAX
        self._stream.close_writing()
        with contextlib.suppress(MachineFailure):
            while left_bytes > 0 and (left_s := until_s - time.monotonic()) > 0:
                data = self._link.read_some(READ_BYTES, timeout_s=left_s)
                if not data:
                    return
                left_bytes -= len(data)


NO_PYTHON_STATUS = 127
TOOL_PATH = "PATH=$PATH:/usr/local/sbin:/usr/sbin:/sbin; "
"""For what is asked there, such as conditions of commands: sysctl and i2cdetect are on nobody's path but root's."""


def _ended_at_once(failure: MachineFailure, status: int) -> MachineFailure:
    """Say of one that ended by itself before it had begun what may be amiss there."""
    return MachineFailure(
        FailureKind.LOST,
        f"{failure.text} (exit status {status})",
        "is it a Python that ansible_python_interpreter names, and does that user's login shell run commands?",
    )


def start_command(python: str | None, package_bytes: int) -> str:
    """Return the shell command that starts the loop with the first interpreter that there is."""
    candidates = " ".join(shlex.quote(p) for p in ((python,) if python else PYTHONS))
    return for_login_shell(
        f'{SYSTEM_PATH}{TOOL_PATH}{NO_PYTHON_HOME}for p in {candidates}; do command -v "$p" >/dev/null 2>&1 &&'
        f' exec "$p" -I -S -c {shlex.quote(_BOOT)} {package_bytes}; done; exit {NO_PYTHON_STATUS}'
    )


def _expected(verb: str, arguments: Mapping[str, Any] | None) -> ExpectedAnswer:
    return ExpectedAnswer(
        shape=answer_shape(verb, arguments or {}),
        what=f"`{verb}`",
        body_bytes_max=BODY_BYTES_MAX.get(verb, 0),
    )


@functools.lru_cache
def _package(parts: tuple[str, ...]) -> bytes:
    """Return the program that is sent, packed: the wanted modules and what starts them."""
    names = [f"{PARTS}.request_loop", *(p if "." in p else f"{PARTS}.{p}" for p in parts)]
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
        "core": f"{PARTS}.request_loop",
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
