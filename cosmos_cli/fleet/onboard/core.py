"""
The loop on a machine: requests come in as frames, answers go out as frames.

A frame is one line of JSON, then as many raw bytes as its "body" says. A request names a verb; other
modules of this package enter theirs in `VERBS`. What needs root goes on to a second such loop behind
`sudo -n`. The loop ends when its standard input does.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import io
import json
import os
import select
import sys
from collections.abc import Callable, Iterator, Mapping

TYPE_CHECKING = False  # to import typing and dataclasses takes longer than most that is done here
if TYPE_CHECKING:
    import subprocess
    from typing import Any, BinaryIO

    Handler = Callable[["Request"], Any]

HEADER_BYTES_MAX = 64 * 1024 * 1024
BODY_BYTES_MAX = 1024 * 1024 * 1024
LAST_WORDS_BYTES = 4000
SUDO_TIMEOUT_S = 20.0
LOCK_PATIENCE_S = 60.0
"""Without a question for so long the machine's lock is given up: the operator is gone."""


class Refusal(Exception):
    """
    A request that could not be carried out; the operator's side makes a MachineFailure of it.

    Args:
        kind: A word of `cosmos_cli.fleet.failure.FailureKind`.
        text: What was expected and what came.
        advice: What to do.
    """

    def __init__(self, kind: str, text: str, advice: str = "") -> None:
        super().__init__(text)
        self.kind = kind
        self.text = text
        self.advice = advice


class Request:
    """What a verb is given."""

    __slots__ = ("arguments", "body")

    def __init__(self, *, arguments: Mapping[str, Any], body: bytes) -> None:
        self.arguments = arguments
        self.body = body


class Part:
    """One of many pieces of an answer; a verb that returns an iterator of these streams them."""

    __slots__ = ("body", "value")

    def __init__(self, *, value: Any = None, body: bytes = b"") -> None:
        self.value = value
        self.body = body


VERBS: dict[str, Handler] = {}
WHERE: dict[str, str] = {}
"""In which module a verb is that may not be loaded yet; filled by who starts the loop."""


def verb(name: str) -> Callable[[Handler], Handler]:
    """Enter a function as the handler of a verb: it returns plain values, a `Part`, or an iterator of parts."""

    def enter(handler: Handler) -> Handler:
        VERBS[name] = handler
        return handler

    return enter


def handler_of(name: str) -> Handler:
    """
    Return the handler of a verb; its module is loaded now, if it is not yet.

    Raises:
        Refusal: There is none.
    """
    if name not in VERBS and name in WHERE:
        __import__(WHERE[name])
    if name not in VERBS:
        raise Refusal("defect", f"no verb {name!r}")
    return VERBS[name]


class PatientInput(io.RawIOBase):
    """
    Standard input that ends when its patience does.

    A connection that was cut is not noticed here for many minutes; who holds the machine's lock must be
    gone long before.

    Args:
        descriptor: To read from.
    """

    patience_s: float | None = None

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    def readable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Wait for bytes; 0, the end, also when none came in time."""
        wait_s = PatientInput.patience_s
        if wait_s is not None and not select.select([self._descriptor], [], [], wait_s)[0]:
            return 0
        return os.readv(self._descriptor, [buffer])


class FrameReader:
    """Reads frames from a binary stream."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream

    def read(self) -> tuple[dict[str, Any], bytes] | None:
        """Return header and body of the next frame; None at the end, also one in the midst of a frame."""
        line = self._stream.readline(HEADER_BYTES_MAX)
        if not line.endswith(b"\n"):
            return None
        header = json.loads(line)
        size = int(header.get("body", 0))
        if not 0 <= size <= BODY_BYTES_MAX:
            return None
        body = self._stream.read(size) if size else b""
        return (header, body) if len(body) == size else None


class FrameWriter:
    """Writes frames to a binary stream."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream

    def write(self, header: Mapping[str, Any], body: bytes = b"") -> None:
        """Write one frame and flush it."""
        line = json.dumps({**header, "body": len(body)}, separators=(",", ":")).encode() + b"\n"
        self._stream.write(line)
        if body:
            self._stream.write(body)
        self._stream.flush()


class Rooted:
    """A second loop as root, started when first needed."""

    def __init__(self, boot: list[str], package: bytes) -> None:
        self._boot = boot
        self._package = package
        self._process: subprocess.Popen[bytes] | None = None

    def relay(self, header: dict[str, Any], body: bytes, out: FrameWriter) -> None:
        """Have root do it, and pass its answer on."""
        process = self._process or self._start()
        assert process.stdin is not None and process.stdout is not None
        with contextlib.suppress(BrokenPipeError):  # nor will there be an answer
            FrameWriter(process.stdin).write(header, body)  # type: ignore[arg-type]
        reader = FrameReader(process.stdout)  # type: ignore[arg-type]
        while (frame := reader.read()) is not None:
            out.write(*frame)
            if not frame[0].get("part"):
                return
        raise Refusal("lost", "what runs there as root ended without an answer")

    def close(self) -> None:
        """Let it end."""
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
            self._process.wait()

    def _start(self) -> subprocess.Popen[bytes]:
        import subprocess

        try:
            asked = subprocess.Popen(
                ["sudo", "-n", "true"], stdin=subprocess.DEVNULL, stderr=subprocess.PIPE
            )
            _, said = asked.communicate(timeout=SUDO_TIMEOUT_S)
        except (FileNotFoundError, subprocess.TimeoutExpired) as error:
            raise no_sudo(
                f"sudo: {error}"
            ) from None  # what runs as root cannot be killed from here
        if asked.returncode:
            raise no_sudo(said.decode(errors="replace").strip() or "sudo refused")
        process = subprocess.Popen(
            ["sudo", "-n", *self._boot],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(self._package)
            process.stdin.flush()
        assert process.stdout is not None
        if FrameReader(process.stdout).read() is None:  # type: ignore[arg-type]
            raise Refusal("lost", "what runs there as root ended before it began")
        self._process = process
        return process


def no_sudo(said: str) -> Refusal:
    """Return the refusal of a machine that lets nobody become root."""
    return Refusal(
        "no_sudo",
        f"cannot become root without a password: {said}",
        "let the user run sudo without one (a file in /etc/sudoers.d), or take what needs root out"
        " of the inventory",
    )


def greet() -> None:
    """Say who works here, as the first frame."""
    told = {
        "python": ".".join(map(str, sys.version_info[:3])),
        "executable": sys.executable,
        "machine": os.uname().machine,
        "bits": 64 if sys.maxsize > 2**32 else 32,
        "libc": _libc(),
        "uid": os.geteuid(),
        "home": os.path.expanduser("~"),
        "node": os.uname().nodename,
        "pid": os.getpid(),
    }
    FrameWriter(sys.stdout.buffer).write({"ok": True, "value": told})


def _libc() -> str:
    try:
        return os.confstr("CS_GNU_LIBC_VERSION") or ""
    except (OSError, ValueError):
        return ""


def serve(boot: list[str], package: bytes) -> None:
    """
    Answer requests until standard input ends.

    Args:
        boot: Command line that starts this loop again.
        package: What that one must be given first.
    """
    out = FrameWriter(os.fdopen(os.dup(1), "wb"))
    os.dup2(2, 1)  # what a command prints must not mix with the frames
    reader = FrameReader(io.BufferedReader(PatientInput(0)))  # nobody asks before the greeting
    os.set_inheritable(0, False)
    rooted = Rooted(boot, package)
    try:
        while (frame := reader.read()) is not None:
            header, body = frame
            if header.get("root") and os.geteuid() != 0:
                _guarded(out, lambda: rooted.relay(header, body, out))  # noqa: B023 - called at once
            else:
                _guarded(out, lambda: _answer(header, body, out))  # noqa: B023 - called at once
    except BrokenPipeError:
        pass  # the operator is gone; what was done is done
    finally:
        rooted.close()


def _answer(header: dict[str, Any], body: bytes, out: FrameWriter) -> None:
    handler = handler_of(str(header.get("verb")))
    value = handler(Request(arguments=header.get("arguments") or {}, body=body))
    if isinstance(value, Iterator):
        for part in value:
            out.write({"ok": True, "part": True, "value": part.value}, part.body)
        value = None
    if isinstance(value, Part):
        out.write({"ok": True, "value": value.value}, value.body)
    else:
        out.write({"ok": True, "value": value})


def _guarded(out: FrameWriter, act: Callable[[], None]) -> None:
    try:
        act()
    except BrokenPipeError:
        raise
    except Refusal as refusal:
        _refuse(out, refusal)
    except OSError as error:
        _refuse(out, refusal_of(error))
    except Exception as error:  # noqa: BLE001 - the operator is told; the loop serves on
        _refuse(out, Refusal("defect", f"unexpected {type(error).__name__}: {error}"))


def _refuse(out: FrameWriter, refusal: Refusal) -> None:
    told = {"kind": refusal.kind, "text": refusal.text, "advice": refusal.advice}
    out.write({"ok": False, "error": told})


def refusal_of(error: OSError) -> Refusal:
    """Return an error of the file system in words."""
    where = f"{error.filename}: " if error.filename else ""
    text = f"{where}{error.strerror or error}"
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return Refusal("disk_full", text, "make room there, then repeat the command")
    if error.errno == errno.EROFS:
        return Refusal(
            "read_only", text, "check the card or disk there (a worn SD card turns read-only)"
        )
    return Refusal("step", text)


def last_words(output: bytes) -> str:
    """Return the end of what a command said, at most ten lines."""
    lines = output[-LAST_WORDS_BYTES:].decode(errors="replace").strip().splitlines()
    return "\n".join(lines[-10:])


@verb("lock")
def lock(request: Request) -> None:
    """
    Take the machine's lock until this loop ends, so that two commands do not work there at once.

    The loop ends, and with it the lock, when nothing was asked for "patience_s", by default LOCK_PATIENCE_S.
    """
    path = os.path.expanduser(request.arguments["path"])
    os.makedirs(os.path.dirname(path), exist_ok=True)
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.read(descriptor, 200).decode(errors="replace").strip()
        os.close(descriptor)
        by = f" ({holder})" if holder else ""
        raise Refusal(
            "busy", f"another command works there{by}", "wait for its end, then repeat"
        ) from None
    os.ftruncate(descriptor, 0)
    os.write(descriptor, str(request.arguments.get("holder", "")).encode()[:200])
    PatientInput.patience_s = float(request.arguments.get("patience_s", LOCK_PATIENCE_S))
