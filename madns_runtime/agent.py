"""
The agent side's process: `madns-agent` starts a machine's agents and watches over them.

Started by `cosmos run`, which writes an AgentLaunch to standard input and reads events from standard
output; by hand with --launch SOCKET, from which the same comes. It ends by itself when that line
closes, and its agents end when it does.
"""

from __future__ import annotations

import os
import socket
import sys
import traceback

import orjson

from madns_runtime.config import AgentLaunch, from_mapping
from madns_runtime.errors import ConfigurationError, MachineError, MadnsError
from madns_runtime.private_socket import SOCKET_PATH_BYTES_MAX, socket_address
from madns_runtime.processes import register
from madns_runtime.reactor.operator_link import read_launch
from madns_runtime.reactor.scheduling import die_with_parent
from madns_runtime.realtime.supervisor import Supervisor
from madns_runtime.recording.access import apply_access

USAGE = "usage: madns-agent [--launch SOCKET]"
NOTHING_GIVEN = (
    "the run gave nothing to start with: this agent has been started already, or the run is over"
)


def main() -> None:
    """Entry point of `madns-agent`."""
    code = 1
    try:
        fds = _open_line(sys.argv[1:])
        if fds[0] == 0:
            die_with_parent()  # until the loop runs: loading a plug-in may take for ever
            document, pending = read_launch(0)
        else:
            document, pending = read_launch(fds[0], if_none=NOTHING_GIVEN)
        launch = from_mapping(AgentLaunch, document)
        apply_access(launch.config.recording.access)
        code = _supervise(launch, fds, pending)
    except MadnsError as error:
        sys.stderr.write(f"madns-agent: {error}\n")
    except KeyboardInterrupt:  # before the loop runs, which hears Ctrl-C itself
        sys.stderr.write("madns-agent: interrupted\n")
    except BaseException:  # noqa: BLE001 - the last frame of a process
        traceback.print_exc()
    sys.stderr.flush()
    os._exit(code)  # no plug-in's thread may hold the process


def _supervise(launch: AgentLaunch, fds: tuple[int, int], pending: bytes) -> int:
    with register(launch.config.run, "supervisor", launch.machine, launch.directory):
        try:
            supervisor = Supervisor(launch, fds, pending)
        except MadnsError as error:
            # Whoever waits for these agents is told why they will never come.
            for agent in launch.agents:
                told = {"event": "exited", "agent": agent, "pid": os.getpid(), "code": 1}
                os.write(fds[1], orjson.dumps({**told, "how": str(error)}) + b"\n")
            raise
        return supervisor.run()


def _open_line(arguments: list[str]) -> tuple[int, int]:
    """Return where commands come from and events go to."""
    if not arguments:
        out_fd = os.dup(1)
        os.dup2(2, 1)  # what a plug-in prints must not mix with the events
        return 0, out_fd
    if len(arguments) != 2 or arguments[0] != "--launch":
        raise ConfigurationError(USAGE)
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        _connect(connection, arguments[1])
    except OSError as error:
        raise MachineError(
            f"cannot reach the run at {arguments[1]}: {error.strerror or error}; is `cosmos run"
            " --manual` still waiting?"
        ) from error
    fd = connection.detach()
    return fd, fd


def _connect(connection: socket.socket, path: str) -> None:
    """Connect to a socket at a path of any length."""
    if len(os.fsencode(path)) <= SOCKET_PATH_BYTES_MAX:
        connection.connect(path)
        return
    directory, name = os.path.split(path)
    with socket_address(directory, name) as address:
        connection.connect(address)


if __name__ == "__main__":
    main()
