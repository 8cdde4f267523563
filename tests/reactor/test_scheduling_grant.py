import gc
import json
import os
import signal
import sys

import pytest

from madns_runtime.config import Scheduling
from madns_runtime.reactor import libc, scheduling
from madns_runtime.reactor.scheduling import apply, die_with_parent, freeze_garbage

pytestmark = pytest.mark.process

REFUSED = PermissionError(1, "Operation not permitted")


@pytest.fixture
def kernel(monkeypatch):
    """Stand in for the kernel: grants everything and takes note, until a test makes it refuse."""

    class Kernel:
        calls = []
        slack_ns = 50_000
        affinity = {0, 1}

    kernel = Kernel()
    kernel.calls = []

    def prctl(option, value=0):
        kernel.calls.append(("prctl", option, value))
        return value or 1

    monkeypatch.setattr(libc, "IS_LINUX", True)
    monkeypatch.setattr(libc, "prctl", prctl)
    monkeypatch.setattr(libc, "mlockall", lambda flags: kernel.calls.append(("mlockall", flags)))
    monkeypatch.setattr(
        os,
        "sched_setscheduler",
        lambda pid, policy, param: kernel.calls.append(
            ("policy", pid, policy, param.sched_priority)
        ),
    )
    monkeypatch.setattr(
        os, "sched_setaffinity", lambda pid, cpus: kernel.calls.append(("affinity", pid, cpus))
    )
    monkeypatch.setattr(scheduling, "_memory_lock_limit_bytes", lambda: None)
    return kernel


def refuse(*_):
    raise REFUSED


def in_child(function):
    """Run *function* in a forked child and return what it returned, through JSON."""
    read_fd, write_fd = os.pipe()
    child = os.fork()
    if child == 0:
        code = 1
        try:
            os.write(write_fd, json.dumps(function()).encode())
            code = 0
        finally:
            os._exit(code)
    os.close(write_fd)
    with os.fdopen(read_fd) as answer:
        text = answer.read()
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == 0
    return json.loads(text)


def test_agent_gets_fifo_with_reset_on_fork_and_its_processors(kernel):
    grant = apply(Scheduling(priority=10, cpu_affinity=(1,)), is_host=False)

    assert ("policy", 0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, 10) in kernel.calls
    assert ("affinity", 0, (1,)) in kernel.calls
    assert not [call for call in kernel.calls if call[0] == "mlockall"]
    assert (grant.policy, grant.priority, grant.policy_refusal) == ("fifo", 10, None)
    assert not grant.memory_locked
    assert grant.memory_lock_refusal is None
    assert grant.warning is None
    assert grant.notes == ()


def test_host_runs_one_priority_above_on_all_processors_with_its_memory_locked(kernel):
    grant = apply(Scheduling(priority=10, cpu_affinity=(1,)), is_host=True)

    assert grant.priority == 11
    assert grant.memory_locked
    assert ("mlockall", libc.MCL_CURRENT | libc.MCL_FUTURE | libc.MCL_ONFAULT) in kernel.calls
    assert not [call for call in kernel.calls if call[0] == "affinity"]


def test_normal_policy_asks_for_no_other(kernel):
    grant = apply(Scheduling(policy="normal", timer_slack_ns=7), is_host=False)

    assert not [call for call in kernel.calls if call[0] == "policy"]
    assert ("prctl", libc.PR_SET_TIMERSLACK, 7) in kernel.calls
    assert (grant.policy, grant.priority) == ("normal", 0)
    assert grant.warnings == grant.notes == ()


def test_refused_fifo_is_a_warning_when_asked_by_name(kernel, monkeypatch):
    monkeypatch.setattr(os, "sched_setscheduler", refuse)

    grant = apply(Scheduling(policy="fifo"), is_host=False)

    assert (grant.policy, grant.priority) == ("normal", 0)
    assert "SCHED_FIFO priority 10 refused" in grant.warning
    assert "rtprio 10" in grant.warning
    assert grant.notes == ()


def test_refused_fifo_is_a_note_when_left_to_the_machine(kernel, monkeypatch):
    monkeypatch.setattr(os, "sched_setscheduler", refuse)

    grant = apply(Scheduling(policy="auto"), is_host=False)

    assert grant.policy == "normal"
    assert grant.warning is None
    assert len(grant.notes) == 1
    assert "limits.conf" in grant.notes[0]


def test_processor_that_does_not_exist_is_a_warning(kernel, monkeypatch):
    monkeypatch.setattr(os, "sched_setaffinity", refuse)

    grant = apply(Scheduling(cpu_affinity=(4000,)), is_host=False)

    assert "processors [4000] refused" in grant.warning
    assert "this process may use" in grant.warning


def test_processors_of_which_only_some_exist_are_a_warning_that_names_the_others(kernel):
    grant = apply(Scheduling(cpu_affinity=(1, 4000)), is_host=False)

    assert "processors [4000] are not there; this process may use [0, 1]" in grant.warning


def test_refused_timer_slack_and_memory_are_notes(kernel, monkeypatch):
    monkeypatch.setattr(libc, "prctl", refuse)
    monkeypatch.setattr(libc, "mlockall", refuse)

    grant = apply(Scheduling(), is_host=True)

    assert grant.timer_slack_ns is None
    assert not grant.memory_locked
    assert grant.warning is None
    assert [note.split(":")[0] for note in grant.notes] == [
        "timer slack",
        "memory may be paged out",
    ]


@pytest.mark.parametrize(
    ("status", "is_locked"),
    [
        ("Name:\tx\nCapEff:\t000001ffffffffff\n", True),
        ("CapEff:\t0000000000004000\n", True),
        ("CapEff:\t0000000000000000\n", False),
        ("Name:\tx\n", False),
        (None, False),
    ],
)
def test_memory_is_locked_under_a_limit_only_with_the_capability(
    kernel, monkeypatch, tmp_path, status, is_locked
):
    path = tmp_path / "status"
    if status is not None:
        path.write_text(status)
    monkeypatch.setattr(scheduling, "STATUS_FILE", path)
    monkeypatch.setattr(scheduling, "_memory_lock_limit_bytes", lambda: 65_536)

    grant = apply(Scheduling(), is_host=True)

    assert grant.memory_locked is is_locked
    assert grant.memory_lock_bytes_max == 65_536
    assert bool([call for call in kernel.calls if call[0] == "mlockall"]) is is_locked
    if not is_locked:
        assert "65536 bytes" in grant.memory_lock_refusal


def test_other_systems_refuse_everything_with_a_reason(monkeypatch):
    monkeypatch.setattr(libc, "IS_LINUX", False)

    grant = apply(Scheduling(policy="fifo", cpu_affinity=(0,)), is_host=False)
    host_grant = apply(Scheduling(), is_host=True)

    assert (grant.policy, grant.cpu_affinity, grant.timer_slack_ns) == ("normal", (), None)
    assert grant.warning.count("not Linux") == 2
    assert host_grant.memory_lock_bytes_max is None
    assert len(host_grant.notes) == 3


def test_grant_travels_as_a_plain_mapping(kernel):
    mapping = apply(Scheduling(), is_host=False).to_mapping()

    assert json.loads(json.dumps(mapping)) == mapping
    assert mapping["policy"] == "fifo"
    assert mapping["warning"] is None
    assert mapping["notes"] == []


@pytest.mark.skipif(not libc.IS_LINUX, reason="asks a Linux kernel")
def test_grant_says_what_the_real_kernel_says():
    def ask():
        grant = apply(Scheduling(timer_slack_ns=1000), is_host=False)
        is_fifo = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
        return {
            "policy": (grant.policy, "fifo" if is_fifo else "normal"),
            "priority": (grant.priority, os.sched_getparam(0).sched_priority),
            "cpu_affinity": (list(grant.cpu_affinity), sorted(os.sched_getaffinity(0))),
            "slack": (grant.timer_slack_ns, 0 if is_fifo else 1000),
        }

    for told, found in in_child(ask).values():
        assert told == found


@pytest.mark.skipif(not libc.IS_LINUX, reason="asks a Linux kernel")
def test_real_kernel_refuses_a_processor_that_does_not_exist():
    def ask():
        return apply(Scheduling(policy="normal", cpu_affinity=(100_000,)), is_host=False).warning

    assert "processors [100000] refused" in in_child(ask)


@pytest.mark.skipif(not libc.IS_LINUX, reason="asks a Linux kernel")
def test_children_of_a_raised_loop_run_with_the_normal_policy():
    def ask():
        apply(Scheduling(), is_host=False)
        return in_child(lambda: os.sched_getscheduler(0))

    assert in_child(ask) == os.SCHED_OTHER


def test_kernels_refusal_of_a_call_is_an_error():
    with pytest.raises(OSError, match="prctl"):
        libc.prctl(999_999)
    with pytest.raises(OSError, match="mlockall"):
        libc.mlockall(1 << 20)


def test_memory_limit_is_read(monkeypatch):
    import resource

    monkeypatch.setattr(resource, "getrlimit", lambda _: (65_536, 131_072))
    assert scheduling._memory_lock_limit_bytes() == 65_536
    monkeypatch.setattr(resource, "getrlimit", lambda _: (resource.RLIM_INFINITY,) * 2)
    assert scheduling._memory_lock_limit_bytes() is None


def test_frozen_garbage_is_not_looked_at_again():
    before = gc.get_freeze_count()
    keep = [[k] for k in range(1000)]

    count = freeze_garbage()

    assert count >= before + len(keep)
    gc.unfreeze()


@pytest.mark.skipif(not libc.IS_LINUX, reason="the signal is Linux's")
def test_child_dies_with_its_parent():
    read_fd, write_fd = os.pipe()
    parent = os.fork()
    if parent == 0:
        parent_pid = os.getpid()
        ready_read_fd, ready_write_fd = os.pipe()
        if os.fork() == 0:
            die_with_parent(parent_pid)
            os.write(ready_write_fd, b"x")
            signal.pause()
            os._exit(0)
        os.read(ready_read_fd, 1)
        os.kill(os.getpid(), signal.SIGKILL)
    os.close(write_fd)

    # Ends only when nobody holds the other end: parent and child are both gone.
    assert os.read(read_fd, 1) == b""
    os.close(read_fd)
    os.waitpid(parent, 0)


def test_child_whose_parent_is_gone_already_ends_at_once():
    child = os.fork()
    if child == 0:
        die_with_parent(parent_pid=2**22 + 1)
        os._exit(0)

    _, status = os.waitpid(child, 0)

    assert os.waitstatus_to_exitcode(status) == -signal.SIGKILL


def test_parent_that_lives_lets_its_child_live():
    def ask():
        return die_with_parent()

    assert in_child(ask) is libc.IS_LINUX


def test_system_without_the_signal_says_so(monkeypatch):
    monkeypatch.setattr(libc, "IS_LINUX", False)

    assert die_with_parent(os.getppid()) is False


def test_platform_is_what_python_says():
    assert sys.platform.startswith("linux") == libc.IS_LINUX
