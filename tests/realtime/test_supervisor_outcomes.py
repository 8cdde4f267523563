"""Words of a supervisor's children about their ends."""

from __future__ import annotations

import os
import signal

from madns_runtime.realtime.supervisor import Supervisor, make_reason_pipe


def test_a_reader_that_finds_nothing_after_reaping_does_not_wait():
    supervisor = Supervisor.__new__(Supervisor)
    supervisor._children = {}
    supervisor._reason_read_fd, write_fd = make_reason_pipe()
    told = (
        b'{"pid": 1, "agent": "agent-01", "as_ordered": true, "reason": "", "may_restart": false}\n'
    )
    os.write(write_fd, told)
    signal.alarm(20)  # ends a test that waits
    try:
        supervisor._read_outcomes()  # as reaping does
        supervisor._read_outcomes()  # as the loop does, which had found it readable before
    finally:
        signal.alarm(0)
        os.close(supervisor._reason_read_fd)
        os.close(write_fd)
