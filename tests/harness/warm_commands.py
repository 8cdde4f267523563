"""
Commands forked from a process that has imported `cosmos` already, for tests that start hundreds of them.

Imports are two thirds of what a short command computes. Each command is a process of its own all the same, with its own
environment, folder, standard streams and exit code, and goes the whole way through `cosmos_cli.start`. Tests of faults start
theirs from nothing, and so do those that change how Python itself starts, or look at a command's environment from outside.

No library that is imported has a thread but pyarrow, whose allocator (jemalloc) makes its own anew in a forked process.
"""

import array
import atexit
import contextlib
import functools
import gc
import importlib
import json
import os
import pkgutil
import runpy
import select
import socket
import subprocess
import sys
import time

FOUND = dict(os.environ)
"""The environment before any test has changed it."""
STARTED_S = 60.0
REQUEST_BYTES = 1 << 20
READ_BYTES = 1 << 16
OWN = ("COSMOS_", "HOME", "PATH", "TMPDIR", "XDG_", "PYTEST_")
"""What commands may have otherwise than the process that they are forked from: nothing of it is read while one is imported."""


class WarmCommands:
    """
    The process that commands are forked from.

    Args:
        environment: Of that process, and of its commands but for `OWN`.
    """

    def __init__(self, environment):
        self._environment = dict(environment)
        self._channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", __file__, str(theirs.fileno())],
                env=self._environment,
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
            )

    def fits(self, environment):
        """Whether a command with this environment would be the same one if it started from nothing."""
        names = {*environment, *self._environment}
        return all(
            environment.get(name) == self._environment.get(name) or name.startswith(OWN)
            for name in names
        )

    def start(self, arguments, folder, environment):
        """Start a command; return it."""
        told, theirs = socket.socketpair()
        out, out_end = os.pipe()
        err, err_end = os.pipe()
        wanted = json.dumps([arguments, str(folder), environment]).encode()
        numbers = array.array("i", [out_end, err_end, theirs.fileno()])
        try:
            self._channel.sendmsg([wanted], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, numbers)])
        finally:
            theirs.close()
            os.close(out_end)
            os.close(err_end)
        told.settimeout(STARTED_S)
        pid = int.from_bytes(told.recv(8), "little")
        assert pid, "the process that commands are forked from is gone"
        told.settimeout(None)
        return WarmCommand(arguments, pid, told, out, err)

    def close(self):
        """End the process; commands that still run go on."""
        self._channel.close()
        self._process.wait(STARTED_S)


class WarmCommand:
    """A command that was started, with what tests use of `subprocess.Popen` where it speaks text."""

    def __init__(self, arguments, pid, told, out, err):
        self.args = arguments
        self.pid = pid
        self.returncode = None
        self._told = told
        self.stdout = os.fdopen(out, encoding="utf-8")
        self.stderr = os.fdopen(err, encoding="utf-8")

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.stdout.close()
        self.stderr.close()
        self.wait()

    def poll(self):
        """Return the exit code, None as long as the command runs."""
        return self._look(0.0)

    def wait(self, timeout=None):
        """Return the exit code as soon as the command has ended."""
        if self._look(timeout) is None:
            raise subprocess.TimeoutExpired(self.args, timeout)
        return self.returncode

    def communicate(self, timeout=None):
        """Return all that the command says, until both of its streams and itself have ended."""
        limit = None if timeout is None else time.monotonic() + timeout
        said = {pipe: bytearray() for pipe in (self.stdout, self.stderr)}
        open_pipes = set(said)
        while open_pipes:
            left = None if limit is None else max(0.0, limit - time.monotonic())
            ready = select.select(list(open_pipes), (), (), left)[0]
            if not ready:
                raise subprocess.TimeoutExpired(self.args, timeout)
            for pipe in ready:
                read = os.read(pipe.fileno(), READ_BYTES)
                said[pipe] += read
                if not read:
                    open_pipes.remove(pipe)
        self.wait(None if limit is None else max(0.0, limit - time.monotonic()))
        return tuple(bytes(part).decode("utf-8") for part in said.values())

    def send_signal(self, number):
        """Send a signal, unless the command has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self):
        """Ask the command to end."""
        self.send_signal(15)

    def kill(self):
        """End the command."""
        self.send_signal(9)

    def _look(self, wait_s):
        if self.returncode is None and select.select([self._told], (), (), wait_s)[0]:
            told = self._told.recv(8)
            assert told, "the process that commands are forked from is gone"
            self.returncode = os.waitstatus_to_exitcode(int.from_bytes(told, "little"))
            self._told.close()
        return self.returncode


@functools.cache
def warm_commands():
    """Return what this process forks its commands from."""
    warm = WarmCommands({**FOUND, "NO_COLOR": "1"})
    atexit.register(warm.close)
    return warm


def serve(channel):
    """Fork a command for each request until nobody asks any more; tell each one's process and how it ended."""
    poll = select.poll()
    poll.register(channel, select.POLLIN)
    running = {}
    while True:
        for number, _ in poll.poll():
            if number != channel.fileno():
                pid, told = running.pop(number)
                poll.unregister(number)
                os.close(number)
                _tell(told, os.waitpid(pid, 0)[1])
                told.close()
                continue
            wanted, fds, _, _ = socket.recv_fds(channel, REQUEST_BYTES, 3)
            if not wanted:
                return
            pid = os.fork()
            if pid == 0:
                for other in (channel, *(told for _, told in running.values())):
                    other.detach()  # its number is the command's from now on
                become(*json.loads(wanted), fds)
                return
            os.close(fds[0])
            os.close(fds[1])
            told = socket.socket(fileno=fds[2])
            _tell(told, pid)
            ended = os.pidfd_open(pid)
            running[ended] = pid, told
            poll.register(ended, select.POLLIN)


def become(arguments, folder, environment, fds):
    """Make this process the command: as Python would have started it."""
    os.dup2(fds[0], 1)
    os.dup2(fds[1], 2)
    os.closerange(3, max(os.sysconf("SC_OPEN_MAX"), 3))
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.stdin = os.fdopen(0, encoding=sys.stdin.encoding, errors=sys.stdin.errors)
    sys.stdout = os.fdopen(1, "w", encoding=sys.stdout.encoding, errors=sys.stdout.errors)
    sys.stderr = os.fdopen(
        2, "w", encoding=sys.stderr.encoding, errors="backslashreplace", buffering=1
    )
    sys.argv = ["cosmos", *arguments]
    gc.unfreeze()
    runpy.run_module("cosmos_cli.start", run_name="__main__", alter_sys=True)


def warm_up():
    """Import what commands import, but `cosmos_cli.start`, which imports the rest with Ctrl-C heard."""
    gc.disable()
    for package in ("cosmos_cli.commands", "cosmos_cli.models", "cosmos_cli.launch"):
        for module in pkgutil.iter_modules(
            importlib.import_module(package).__path__, f"{package}."
        ):
            importlib.import_module(module.name)
    importlib.import_module("cosmos_cli.app")
    gc.enable()
    gc.collect()
    gc.freeze()


def _tell(told, number):
    with contextlib.suppress(BrokenPipeError):  # the test has not waited for it
        told.send(number.to_bytes(8, "little"))


if __name__ == "__main__":
    with socket.socket(fileno=int(sys.argv[1])) as requests:
        warm_up()
        serve(requests)
