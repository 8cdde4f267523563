"""The stream to a program on another machine: one that starts it, one that reaches it again, and how it ended."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import orjson

from cosmos_cli.fleet.connection import Stream
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.liveness import BlockingStream
from cosmos_cli.launch.channel import READ_BYTES
from cosmos_cli.launch.machines import RemoteMachine
from madns_runtime.config import RELAY_CONNECTED, RELAY_NOBODY

STATUS_TRIES = 10
STATUS_TIMEOUT_S = 1.0
STATUS_PAUSE_S = 0.1
"""A program's exit status comes a moment after the end of its output."""
LAUNCH_TIMEOUT_S = 20.0
RELAY_TIMEOUT_S = 5.0
RELAY_TALK_BYTES_MAX = 65_536
"""A start-up file there may talk before the relay does."""
STARTED_ANEW = "it has started anew"


def start_program(machine: RemoteMachine, command: str, launch: Mapping[str, Any]) -> Stream:
    """Start a program there and hand over its launch line, which may be long."""
    stream = machine.connection.open(command)
    try:
        BlockingStream(stream).write_all(orjson.dumps(launch) + b"\n", timeout_s=LAUNCH_TIMEOUT_S)
    except MachineFailure as failure:
        if failure.kind is not FailureKind.LOST:  # of one that has ended, its output tells why
            stream.close()
            raise
    return stream


def reach_again(machine: RemoteMachine, command: str, attach: bytes) -> tuple[Stream, bytes] | None:
    """Return a new line to a program and what came over it; None if no program waits there."""
    machine.connect_again()
    stream = machine.connection.open(command)
    link = BlockingStream(stream)
    try:
        said = b""
        while RELAY_CONNECTED not in said:
            data = link.read_some(READ_BYTES, timeout_s=RELAY_TIMEOUT_S)
            if not data or len(said) > RELAY_TALK_BYTES_MAX:
                if fate_of(stream, machine)[0] == RELAY_NOBODY:
                    stream.close()
                    if machine.has_started_anew():
                        raise MachineFailure(FailureKind.LOST, STARTED_ANEW)
                    return None
                raise MachineFailure(FailureKind.LOST, f"no relay: {link.ending().errors}")
            said += data
        link.write_all(attach, timeout_s=RELAY_TIMEOUT_S)
    except BaseException:
        stream.close()
        raise
    return stream, said.partition(RELAY_CONNECTED)[2]


def fate_of(stream: Stream, machine: RemoteMachine) -> tuple[int | None, bool]:
    """Return the exit status of a program whose output has ended, and whether its machine answers."""
    for _ in range(STATUS_TRIES):
        status = stream.ending(timeout_s=STATUS_TIMEOUT_S).exit_status
        if status is not None:
            return status, True
        if not machine.is_alive():
            return None, False
        time.sleep(STATUS_PAUSE_S)
    return None, True
