"""
Real sshd processes of the tests' own user, on addresses of loopback; nothing of the machine's own is touched.

Each server has a keeper: this module, run as a program. Whatever comes of a server's sessions becomes the
keeper's child when its parent ends, and none of it outlives the test process, however that ends.
"""

from __future__ import annotations

import base64
import contextlib
import ctypes
import getpass
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

SSHD = shutil.which("sshd", path=os.environ.get("PATH", "") + ":/usr/sbin:/sbin")
START_TIMEOUT_S = 60.0
END_TIMEOUT_S = 30.0
PR_SET_CHILD_SUBREAPER = 36
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
        from harness.ports import free_port  # the keeper, which is this module too, finds none

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
        self.pid = 0
        self._keeper: subprocess.Popen[bytes] | None = None
        self.log = directory / "sshd.log"

    @property
    def name(self) -> str:
        """What stands for it in known_hosts."""
        return f"[{self.address}]:{self.port}"

    @property
    def variables(self) -> dict[str, Any]:
        """What an inventory says of a machine behind it."""
        return {
            "ansible_host": self.address,
            "ansible_port": self.port,
            "ansible_user": self.user,
            "ansible_ssh_private_key_file": str(self.user_key),
        }

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
            self._keeper = subprocess.Popen(
                [sys.executable, "-S", "-E", __file__, SSHD, str(self._configuration)],
                stdin=subprocess.PIPE,  # its end is the keeper's, and so the server's
                stdout=subprocess.PIPE,
                stderr=log,
                start_new_session=True,
            )
        assert self._keeper.stdout is not None
        self.pid = int(self._keeper.stdout.readline())
        until_s = time.monotonic() + START_TIMEOUT_S
        while not self._listens():
            if self._keeper.poll() is not None or time.monotonic() > until_s:
                self._end()
                raise RuntimeError(f"sshd did not start: {self.log.read_text(encoding='utf-8')}")
            time.sleep(0.02)
        return self

    def __exit__(self, *exc: object) -> None:
        self._end()

    def _end(self) -> None:
        assert self._keeper is not None
        self._keeper.communicate(timeout=2 * END_TIMEOUT_S)

    def sessions(self) -> list[int]:
        """Pids of the server's children, and theirs: one tree a connection."""
        return descendants(self.pid)

    def cut(self) -> None:
        """Kill what serves the open connections; the server itself goes on."""
        # Who is stopped starts nobody that would be missed.
        for pid in self._signal(signal.SIGSTOP):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def break_connections(self) -> int:
        """Kill the server's own processes of all open connections, not what runs in them; return how many those were."""
        broken = 0
        for pid in self.sessions():
            with contextlib.suppress(OSError):
                if Path(f"/proc/{pid}/comm").read_text().startswith("sshd"):
                    os.kill(pid, signal.SIGKILL)
                    broken += 1
        return broken

    def freeze_logins(self) -> None:
        """Let nobody else in: the server is stopped, open connections go on."""
        os.kill(self.pid, signal.SIGSTOP)

    def thaw_logins(self) -> None:
        """Let in who waits."""
        os.kill(self.pid, signal.SIGCONT)

    def left(self, words: str) -> list[int]:
        """Return what lives with *words* in its arguments of all that was ever started through this server."""
        assert self._keeper is not None
        found = []
        for pid in descendants(self._keeper.pid):
            with contextlib.suppress(OSError):
                if words in Path(f"/proc/{pid}/cmdline").read_text():
                    found.append(pid)
        return found

    def freeze(self) -> None:
        """Stop the server and its sessions, as a hung machine would be."""
        os.kill(self.pid, signal.SIGSTOP)
        self._signal(signal.SIGSTOP)

    def thaw(self) -> None:
        """Let them go on."""
        self._signal(signal.SIGCONT)
        os.kill(self.pid, signal.SIGCONT)

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


@contextlib.contextmanager
def silent_server(address: str = "127.0.0.1") -> Iterator[int]:
    """A machine whose kernel answers and whose sshd does not: connections open, and nothing is said."""
    with socket.socket() as sock:
        sock.bind((address, 0))
        sock.listen(8)
        yield int(sock.getsockname()[1])


def keep(server: str, configuration: str) -> None:
    """Run a server until standard input or the server ends; then kill all that is left of it."""
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    pid = os.posix_spawn(
        server,
        [server, "-D", "-e", "-f", configuration],
        os.environ,
        file_actions=[(os.POSIX_SPAWN_OPEN, n, os.devnull, os.O_RDWR, 0) for n in (0, 1)],
    )

    def reap(*_: object) -> None:
        with contextlib.suppress(ChildProcessError):
            while (ended := os.waitpid(-1, os.WNOHANG)[0]) != 0:
                if ended == pid:
                    raise SystemExit

    signal.signal(signal.SIGCHLD, reap)
    try:
        reap()  # it may have ended before
        os.write(1, b"%d\n" % pid)
        os.read(0, 1)
    finally:
        signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the kernel reaps
        until_s = time.monotonic() + END_TIMEOUT_S
        while (left := descendants(os.getpid())) and time.monotonic() < until_s:
            for each in left:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(each, signal.SIGKILL)
            time.sleep(0.01)


if __name__ == "__main__":
    keep(*sys.argv[1:])
