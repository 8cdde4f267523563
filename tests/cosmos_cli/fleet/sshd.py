"""Real sshd processes of the tests' own user, on addresses of loopback; nothing of the machine's own is touched."""

from __future__ import annotations

import base64
import contextlib
import getpass
import os
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

SSHD = shutil.which("sshd", path=os.environ.get("PATH", "") + ":/usr/sbin:/sbin")
START_TIMEOUT_S = 10.0
KINDS = ("ed25519", "ecdsa", "rsa")

CONFIGURATION = """
{extra}
Port {port}
ListenAddress {address}
{host_keys}
PidFile none
AuthorizedKeysFile {authorized_keys}
StrictModes no
UsePAM no
PasswordAuthentication {password}
KbdInteractiveAuthentication no
PrintMotd no
LogLevel VERBOSE
MaxStartups 100
SetEnv HOME={home} {environment}
"""


class Sshd:
    """One server: `with` starts and ends it."""

    def __init__(
        self,
        directory: Path,
        *,
        address: str = "127.0.0.1",
        kinds: Sequence[str] = ("ed25519",),
        extra: str = "",
        has_passwords: bool = False,
        environment: str = "",
        port: int | None = None,
    ) -> None:
        self.directory = directory
        self.address = address
        self.port = port or free_port(address)
        self.user = getpass.getuser()
        directory.mkdir(parents=True, exist_ok=True)
        self.user_key = make_key(directory / "user_key", "ed25519")
        self.host_keys = {kind: make_key(directory / f"host_{kind}", kind) for kind in kinds}
        self.authorized_keys = directory / "authorized_keys"
        self.authorized_keys.write_text(public(self.user_key), encoding="utf-8")
        self._configuration = directory / "sshd_config"
        self._configuration.write_text(
            CONFIGURATION.format(
                port=self.port,
                address=address,
                host_keys="\n".join(f"HostKey {file}" for file in self.host_keys.values()),
                authorized_keys=self.authorized_keys,
                extra=extra,
                password="yes" if has_passwords else "no",
                home=directory,
                environment=environment,
            ),
            encoding="utf-8",
        )
        self.process: subprocess.Popen[bytes] | None = None
        self.log = directory / "sshd.log"

    @property
    def name(self) -> str:
        """What stands for it in known_hosts."""
        return f"[{self.address}]:{self.port}"

    def known_hosts_line(self, kind: str = "ed25519") -> str:
        """The line that makes its key known."""
        return f"{self.name} {' '.join(public(self.host_keys[kind]).split()[:2])}\n"

    def blob(self, kind: str = "ed25519") -> bytes:
        """Its public key."""
        return base64.b64decode(public(self.host_keys[kind]).split()[1])

    def __enter__(self) -> Sshd:
        assert SSHD is not None
        if os.geteuid() == 0:  # root's sshd insists on its empty directory
            Path("/run/sshd").mkdir(mode=0o755, exist_ok=True)
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [SSHD, "-D", "-e", "-f", str(self._configuration)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=log,
                start_new_session=True,
            )
        until_s = time.monotonic() + START_TIMEOUT_S
        while not self._listens():
            if self.process.poll() is not None or time.monotonic() > until_s:
                raise RuntimeError(f"sshd did not start: {self.log.read_text(encoding='utf-8')}")
            time.sleep(0.02)
        return self

    def __exit__(self, *exc: object) -> None:
        assert self.process is not None
        os.kill(self.process.pid, signal.SIGSTOP)
        self.cut()
        self.process.kill()
        self.process.wait()

    def sessions(self) -> list[int]:
        """Pids of the server's children, and theirs: one tree a connection."""
        assert self.process is not None
        return descendants(self.process.pid)

    def cut(self) -> None:
        """Kill what serves the open connections; the server itself goes on."""
        for pid in self._signal(
            signal.SIGSTOP
        ):  # who is stopped starts nobody that would be missed
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def freeze(self) -> None:
        """Stop the server and its sessions, as a hung machine would be."""
        assert self.process is not None
        os.kill(self.process.pid, signal.SIGSTOP)
        self._signal(signal.SIGSTOP)

    def thaw(self) -> None:
        """Let them go on."""
        assert self.process is not None
        self._signal(signal.SIGCONT)
        os.kill(self.process.pid, signal.SIGCONT)

    def _signal(self, number: int) -> set[int]:
        """Send a signal to all sessions, also to a process that one of them is just starting."""
        told: set[int] = set()
        while new := set(self.sessions()) - told:
            for pid in new:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, number)
            told |= new
        return told

    def _listens(self) -> bool:
        return "Server listening" in self.log.read_text(encoding="utf-8")


def descendants(pid: int) -> list[int]:
    """Return all processes below one."""
    parents: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
                parents.setdefault(int(fields[1]), []).append(int(entry.name))
    found: list[int] = []
    waiting = [pid]
    while waiting:
        children = parents.get(waiting.pop(), [])
        found += children
        waiting += children
    return found


def make_key(file: Path, kind: str, *, passphrase: str = "") -> Path:
    """Make a key pair unless it is there."""
    if not file.exists():
        command = [
            "ssh-keygen",
            "-q",
            "-t",
            kind,
            "-N",
            passphrase,
            "-C",
            file.name,
            "-f",
            str(file),
        ]
        subprocess.run([*command, *(["-b", "2048"] if kind == "rsa" else [])], check=True)
    return file


def public(file: Path) -> str:
    """Return the public half's line."""
    return Path(f"{file}.pub").read_text(encoding="utf-8")


def free_port(address: str) -> int:
    """Return a port that nobody listens on."""
    with socket.socket() as sock:
        sock.bind((address, 0))
        return int(sock.getsockname()[1])


@contextlib.contextmanager
def silent_server(address: str = "127.0.0.1") -> Iterator[int]:
    """A machine whose kernel answers and whose sshd does not: connections open, and nothing is said."""
    with socket.socket() as sock:
        sock.bind((address, 0))
        sock.listen(8)
        yield int(sock.getsockname()[1])
