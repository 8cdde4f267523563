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
import stat
import sys
from collections.abc import Callable, Iterator, Mapping

TYPE_CHECKING = False  # to import typing and dataclasses takes longer than most that is done here
if TYPE_CHECKING:
    import subprocess
    from typing import IO, Any, BinaryIO, TypeAlias

    Handler = Callable[["VerbRequest"], Any]

PlainValue: TypeAlias = "Any"
"""A value that JSON can hold; for the modules that are sent, which import no typing either."""

BOOT_ID_FILE = "/proc/sys/kernel/random/boot_id"
HEADER_BYTES_MAX = 64 * 1024 * 1024
BODY_BYTES_MAX = 1024 * 1024 * 1024
LAST_WORDS_BYTES = 4000
SUDO_TIMEOUT_S = 20.0
LOCK_PATIENCE_S = 60.0
"""Without a question for so long the machine's lock is given up: the operator is gone."""


class HelperRefusal(Exception):
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

    def to_mapping(self) -> dict[str, str]:
        """Return plain values, as the operator's side reads them."""
        return {"kind": self.kind, "text": self.text, "advice": self.advice}


class VerbRequest:
    """Input of a verb."""

    __slots__ = ("arguments", "body")

    def __init__(self, *, arguments: Mapping[str, Any], body: bytes = b"") -> None:
        self.arguments = arguments
        self.body = body


class AnswerPiece:
    """One of many pieces of an answer; a verb that returns an iterator of these streams them."""

    __slots__ = ("body", "value")

    def __init__(self, *, value: Any = None, body: bytes = b"") -> None:
        self.value = value
        self.body = body


VERBS: dict[str, Handler] = {}
WHERE: dict[str, str] = {}
"""In which module a verb is that may not be loaded yet; filled by who starts the loop."""


def verb(name: str) -> Callable[[Handler], Handler]:
    """Enter a function as the handler of a verb: it returns plain values, or an iterator of `AnswerPiece`."""

    def enter(handler: Handler) -> Handler:
        VERBS[name] = handler
        return handler

    return enter


def handler_of(name: str) -> Handler:
    """Return the handler of a verb, whose module is loaded now if it is not yet; one that is not known is refused."""
    if name not in VERBS and name in WHERE:
        __import__(WHERE[name])
    if name not in VERBS:
        raise HelperRefusal("defect", f"no verb {name!r}")
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
            sys.stderr.write(f"nothing was asked for {wait_s:g} s\n")
            return 0
        return os.readv(self._descriptor, [buffer])


def read_frame(stream: IO[bytes]) -> tuple[dict[str, Any], bytes] | None:
    """Return header and body of the next frame; None at the end, also one in the midst of a frame."""
    line = stream.readline(HEADER_BYTES_MAX)
    if not line.endswith(b"\n"):
        return None
    header = json.loads(line)
    size = int(header.get("body", 0))
    if not 0 <= size <= BODY_BYTES_MAX:
        return None
    body = stream.read(size) if size else b""
    return (header, body) if len(body) == size else None


def write_frame(stream: IO[bytes], header: Mapping[str, Any], body: bytes = b"") -> None:
    """Write one frame and flush it."""
    line = json.dumps({**header, "body": len(body)}, separators=(",", ":")).encode() + b"\n"
    stream.write(line)
    if body:
        stream.write(body)
    stream.flush()


class Rooted:
    """A second loop as root, started when first needed."""

    def __init__(self, boot: list[str], package: bytes) -> None:
        self._boot = boot
        self._package = package
        self._process: subprocess.Popen[bytes] | None = None

    def relay(self, header: dict[str, Any], body: bytes, out: BinaryIO) -> None:
        """Have root do it, and pass its answer on."""
        process = self._process or self._start()
        assert process.stdin is not None and process.stdout is not None
        with contextlib.suppress(BrokenPipeError):  # nor will there be an answer
            write_frame(process.stdin, header, body)
        while (frame := read_frame(process.stdout)) is not None:
            write_frame(out, *frame)
            if not frame[0].get("piece"):
                return
        raise HelperRefusal("lost", "what runs there as root ended without an answer")

    def close(self) -> None:
        """Let it end."""
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
            self._process.wait()

    def _start(self) -> subprocess.Popen[bytes]:
        import subprocess  # only for what root is asked

        try:
            asked = subprocess.Popen(
                ["sudo", "-n", "true"], stdin=subprocess.DEVNULL, stderr=subprocess.PIPE
            )
            _, said = asked.communicate(timeout=SUDO_TIMEOUT_S)
        except FileNotFoundError:
            raise no_sudo("there is no sudo") from None
        except subprocess.TimeoutExpired:  # what runs as root cannot be killed from here
            raise slow_sudo("sudo -n true has not ended") from None
        if asked.returncode:
            raise no_sudo(said.decode(errors="replace").strip() or "sudo refused")
        process = subprocess.Popen(
            ["sudo", "-n", *self._boot],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        assert process.stdin is not None and process.stdout is not None
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(self._package)
            process.stdin.flush()
        if not select.select([process.stdout], [], [], SUDO_TIMEOUT_S)[0]:
            process.stdin.close()
            raise slow_sudo("sudo -n has started nothing")
        if read_frame(process.stdout) is None:
            raise HelperRefusal("lost", "what runs there as root ended before it began")
        self._process = process
        return process


def slow_sudo(what: str) -> HelperRefusal:
    """Return the refusal of a machine whose sudo takes too long."""
    advice = "does it wait for a name server? /etc/hosts there should have the machine's own name"
    return HelperRefusal("timeout", f"{what} in {SUDO_TIMEOUT_S:g} s", advice)


def no_sudo(said: str) -> HelperRefusal:
    """Return the refusal of a machine that lets nobody become root."""
    return HelperRefusal(
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
        "libc": libc_version(),
        "uid": os.geteuid(),
        "home": os.path.expanduser("~"),
        "node": os.uname().nodename,
        "pid": os.getpid(),
        "boot_id": read_boot_id(),
    }
    write_frame(sys.stdout.buffer, {"ok": True, "value": told})


def read_boot_id() -> str:
    """Return what names this boot; empty where the kernel does not say."""
    with contextlib.suppress(OSError), open(BOOT_ID_FILE, encoding="ascii") as file:
        return file.read().strip()
    return ""


def libc_version() -> str:
    """Return what the C library calls itself, such as "glibc 2.36"; empty where it does not say."""
    with contextlib.suppress(OSError, ValueError):
        return os.confstr("CS_GNU_LIBC_VERSION") or ""
    return ""


def serve(boot: list[str], package: bytes) -> None:
    """
    Answer requests until standard input ends.

    Args:
        boot: Command line that starts this loop again.
        package: What that one must be given first.
    """
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a command prints must not mix with the frames
    requests = io.BufferedReader(PatientInput(0))  # nobody asks before the greeting
    os.set_inheritable(0, False)
    rooted = Rooted(boot, package)
    try:
        while (frame := read_frame(requests)) is not None:
            _handle(*frame, rooted, out)
    except BrokenPipeError:
        pass  # the operator is gone; what was done is done
    finally:
        rooted.close()


def _handle(header: dict[str, Any], body: bytes, rooted: Rooted, out: BinaryIO) -> None:
    try:
        if header.get("root") and os.geteuid() != 0:
            rooted.relay(header, body, out)
        else:
            _answer(header, body, out)
    except BrokenPipeError:
        raise
    except Exception as error:  # noqa: BLE001 - the operator is told; the loop serves on
        write_frame(out, {"ok": False, "error": refusal_of(error).to_mapping()})


def _answer(header: dict[str, Any], body: bytes, out: BinaryIO) -> None:
    handler = handler_of(str(header.get("verb")))
    value = handler(VerbRequest(arguments=header.get("arguments") or {}, body=body))
    if isinstance(value, Iterator):
        for piece in value:
            write_frame(out, {"ok": True, "piece": True, "value": piece.value}, piece.body)
        value = None
    write_frame(out, {"ok": True, "value": value})


_FULL = ("disk_full", "make room there, then repeat the command")
_DENIED = ("step", "see who owns it (`ls -ld` there), or name another path in the inventory")
CURES = {
    errno.ENOSPC: _FULL,
    errno.EDQUOT: _FULL,
    errno.EROFS: ("read_only", "check the card or disk there (a worn SD card turns read-only)"),
    errno.EACCES: _DENIED,
    errno.EPERM: _DENIED,
    errno.ENOTDIR: ("step", "remove what is no folder there, or name another path"),
    errno.EIO: ("step", "the card or disk there fails: look at `dmesg` there, and replace it"),
}


def refusal_of(error: Exception) -> HelperRefusal:
    """Return an error as a refusal: one of the file system in words, one that nobody expected as a defect."""
    if isinstance(error, HelperRefusal):
        return error
    if not isinstance(error, OSError):
        return HelperRefusal("defect", f"unexpected {type(error).__name__}: {error}")
    where = f"{error.filename}: " if error.filename else ""
    kind, advice = CURES.get(error.errno or 0, ("step", ""))
    return HelperRefusal(kind, f"{where}{error.strerror or error}", advice)


def no_links(path: str, flags: int) -> int:
    """Be the opener of files that others could lay links or pipes for: neither is followed or waited for."""
    return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o644)


def sha256(content: io.FileIO | io.BufferedReader | bytes) -> str:
    """Return the SHA-256 of bytes, or of what is left of a file."""
    import hashlib  # 3 ms, which a look without a trace need not wait for

    if isinstance(content, bytes):
        return hashlib.sha256(content).hexdigest()
    return hashlib.file_digest(content, "sha256").hexdigest()


def sync_folder(folder: str) -> None:
    """Wait until the names in a folder are on the disk."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # a file system that cannot: nothing more can be done
            raise
    finally:
        os.close(descriptor)


def last_words(output: bytes) -> str:
    """Return the end of what a command said, at most ten lines."""
    lines = output[-LAST_WORDS_BYTES:].decode(errors="replace").strip().splitlines()
    return "\n".join(lines[-10:])


@verb("lock")
def lock(request: VerbRequest) -> None:
    """
    Take the machine's lock until this loop ends, so that two commands do not work there at once.

    The loop ends, and with it the lock, when nothing was asked for "patience_s", by default LOCK_PATIENCE_S.
    """
    path = os.path.expanduser(request.arguments["path"])
    os.makedirs(os.path.dirname(path), exist_ok=True)
    descriptor = _open_lock(path)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.read(descriptor, 200).decode(errors="replace").strip()
        os.close(descriptor)
        text = "another command works there" + (f" ({holder})" if holder else "")
        raise HelperRefusal("busy", text, "wait for its end, then repeat") from None
    os.ftruncate(descriptor, 0)
    os.write(descriptor, str(request.arguments.get("holder", "")).encode()[:200])
    PatientInput.patience_s = float(request.arguments.get("patience_s", LOCK_PATIENCE_S))


def _open_lock(path: str) -> int:
    """Open the file of the lock, which is emptied afterwards: never one that a link leads to."""
    descriptor = None
    try:
        descriptor = no_links(path, os.O_RDWR | os.O_CREAT)
        if stat.S_ISREG(os.fstat(descriptor).st_mode):
            return descriptor
    except OSError as error:
        if error.errno not in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
            raise
    if descriptor is not None:
        os.close(descriptor)
    text = f"{path}: expected a file, got a link or something else"
    raise HelperRefusal("step", text, "delete it there")
