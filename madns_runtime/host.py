"""
The host process: `madns-host` runs one run, in real time or in lockstep.

Started by `cosmos run`, which writes a HostLaunch to standard input and reads events from standard
output. It ends by itself when that line closes.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import traceback
from pathlib import Path

import orjson

from madns_runtime.config import HostLaunch, from_mapping
from madns_runtime.errors import MadnsError
from madns_runtime.plugin.api import HOST
from madns_runtime.plugin.context import describe_exception
from madns_runtime.processes import register
from madns_runtime.reactor.descriptors import allow_descriptors
from madns_runtime.reactor.operator_link import read_launch
from madns_runtime.reactor.scheduling import die_with_parent
from madns_runtime.reactor.watchdog import tell_stack_on
from madns_runtime.recording.access import apply_access


def main() -> None:
    """Entry point of `madns-host`."""
    out_fd = os.dup(1)
    os.dup2(2, 1)  # what a plug-in prints must not mix with the events
    die_with_parent()  # until the loop runs: loading a plug-in may take for ever
    tell_stack_on(signal.SIGTERM)
    try:
        document, pending = read_launch(0)
        launch = from_mapping(HostLaunch, document)
        apply_access(launch.config.recording.access)
        with register(launch.config.run, "host", HOST, Path(launch.directory).parent):
            code = _run(launch, (0, out_fd), pending)
    except MadnsError as error:
        code = _fail(out_fd, str(error))
    except BaseException as error:  # noqa: BLE001 - the last frame of a process; it is told below
        traceback.print_exc()
        code = _fail(out_fd, describe_exception(error, "madns-host"))
    sys.stderr.flush()
    os._exit(code)  # no executor's or plug-in's thread may hold the process


def _run(launch: HostLaunch, fds: tuple[int, int], pending: bytes) -> int:
    if launch.config.time.is_lockstep:
        # Each mode needs nothing of the other.
        from madns_runtime.lockstep.host import LockstepHost

        return LockstepHost(launch, fds, pending).run()
    # As above.
    from madns_runtime.realtime.host import HostRuntime

    allow_descriptors()  # its half may record a stream of each agent

    return HostRuntime(launch, fds, pending).run()


def _fail(out_fd: int, reason: str) -> int:
    """Tell the operator why there will be no run, or no more of it; returns the exit code."""
    sys.stderr.write(f"madns-host: {reason}\n")
    result = {"status": "failed", "who": HOST, "reason": reason}
    with contextlib.suppress(OSError):  # nobody may be left to hear it
        os.write(out_fd, orjson.dumps({"event": "finished", "result": result}) + b"\n")
    return 1


if __name__ == "__main__":
    main()
