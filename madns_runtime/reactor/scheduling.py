"""
Requests of a loop to the kernel: scheduling class, processors, timer slack, resident memory.

Nothing here raises for a refusal. What was granted and why the rest was not is recorded, because the
tail of the lateness depends on it more than on anything else.
"""

from __future__ import annotations

import contextlib
import gc
import os
import resource
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from madns_runtime.config import Scheduling, to_mapping
from madns_runtime.reactor import libc

NOT_LINUX = "this system is not Linux"
CAP_IPC_LOCK = 14
STATUS_FILE = Path("/proc/self/status")
PREEMPT_RT_FILE = Path("/sys/kernel/realtime")
"""Holds 1, and is there on such a kernel alone; newer ones tell it in their version only."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SchedulingGrant:
    """The kernel's grants to the calling thread; a refusal is None where there was none."""

    policy_asked: Literal["auto", "fifo", "normal"]
    policy: Literal["fifo", "normal"]
    policy_refusal: str | None
    priority: int
    """SCHED_FIFO priority; 0 with the normal policy."""
    cpu_affinity: tuple[int, ...]
    """Processors that the thread may use; empty where the system does not tell."""
    cpu_affinity_refusal: str | None
    timer_slack_ns: int | None
    """Value read back; None where the system has none. Without meaning, and read as 0, under SCHED_FIFO."""
    timer_slack_refusal: str | None
    memory_locked: bool
    """The host's memory stays resident; agents never ask for it."""
    memory_lock_refusal: str | None
    memory_lock_bytes_max: int | None
    """RLIMIT_MEMLOCK; None for no limit or where the system has none."""
    preempt_rt: bool | None = None
    """Whether the kernel is PREEMPT_RT; None where the system does not tell."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Requests that the scenario made by name and that were not granted."""
        return _refused(
            ("scheduling.policy fifo", self.policy_asked == "fifo" and self.policy_refusal),
            ("scheduling.cpu_affinity", self.cpu_affinity_refusal),
        )

    @property
    def warning(self) -> str | None:
        """All warnings as one sentence; None without any."""
        return "; ".join(self.warnings) or None

    @property
    def notes(self) -> tuple[str, ...]:
        """Settings that would be better but were not asked for by name."""
        return _refused(
            ("normal scheduling", self.policy_asked == "auto" and self.policy_refusal),
            ("timer slack", self.timer_slack_refusal),
            ("memory may be paged out", self.memory_lock_refusal),
        )

    def to_mapping(self) -> dict[str, Any]:
        """Return the grant for records, with its warning (a text or None) and notes."""
        return {**to_mapping(self), "warning": self.warning, "notes": list(self.notes)}


def _refused(*refusals: tuple[str, str | Literal[False] | None]) -> tuple[str, ...]:
    """Return what was refused, each with its reason."""
    return tuple(f"{what}: {reason}" for what, reason in refusals if reason)


def apply(scheduling: Scheduling, *, is_host: bool) -> SchedulingGrant:
    """
    Ask the kernel for what *scheduling* says, for the calling thread alone.

    Threads and processes started later fall back to the normal policy (SCHED_RESET_ON_FORK), so that
    neither a recorder's disk nor a worker's computing competes with a loop (see `WriterThread.follow` for the
    least that a recorder needs). They do inherit the processors, so start them before where that matters.

    Args:
        scheduling: What is asked for.
        is_host: The host runs one priority above the agents, on all processors, with its memory
            locked: it answers many, and there is only one.
    """
    priority = scheduling.priority + (1 if is_host else 0)
    refusal = None if libc.IS_LINUX else NOT_LINUX
    wants_fifo, processors = scheduling.policy != "normal", scheduling.cpu_affinity
    policy_refusal = (refusal or _set_fifo(priority)) if wants_fifo else None
    is_fifo = wants_fifo and policy_refusal is None
    slack_ns, slack_refusal = (
        (None, refusal) if refusal else _set_timer_slack(scheduling.timer_slack_ns)
    )
    binds = bool(processors) and not is_host
    affinity_refusal = (refusal or _set_affinity(processors)) if binds else None
    limit_bytes = None if refusal else _memory_lock_limit_bytes()
    lock_refusal = (refusal or _lock_memory(limit_bytes)) if is_host else None
    return SchedulingGrant(
        policy_asked=scheduling.policy,
        policy="fifo" if is_fifo else "normal",
        policy_refusal=policy_refusal,
        priority=priority if is_fifo else 0,
        cpu_affinity=_affinity(),
        cpu_affinity_refusal=affinity_refusal,
        timer_slack_ns=slack_ns,
        timer_slack_refusal=slack_refusal,
        memory_locked=is_host and lock_refusal is None,
        memory_lock_refusal=lock_refusal,
        memory_lock_bytes_max=limit_bytes,
        preempt_rt=is_preempt_rt(),
    )


def is_preempt_rt() -> bool | None:
    """Tell whether this kernel is PREEMPT_RT; None where the system is not Linux."""
    if not libc.IS_LINUX:
        return None
    with contextlib.suppress(OSError):
        if PREEMPT_RT_FILE.read_text().strip() == "1":
            return True
    version = os.uname().version
    return "PREEMPT_RT" in version or "PREEMPT RT" in version


def freeze_garbage() -> int:
    """
    Collect garbage once more and never look at what is left again; returns how many objects that is.

    Called after set-up: a full collection during the run would otherwise walk all of it.
    """
    gc.collect()
    gc.freeze()
    return gc.get_freeze_count()


def die_with_parent(parent_pid: int | None = None) -> bool:
    """
    Let the kernel kill this process when the thread that forked it ends; False where it cannot.

    Called first thing in a forked process. The signal follows the parent's *thread*: fork from one
    that lives as long as the process.

    Args:
        parent_pid: The parent's process id as it knew it itself: a parent that died before this
            call sends no signal, so if another one has taken its place this process ends at once.
            None leaves that gap as narrow as this call.
    """
    expected_pid = os.getppid() if parent_pid is None else parent_pid
    is_armed = False
    if libc.IS_LINUX:
        with contextlib.suppress(OSError):
            libc.prctl(libc.PR_SET_PDEATHSIG, signal.SIGKILL)
            is_armed = True
    if os.getppid() != expected_pid:
        os.kill(os.getpid(), signal.SIGKILL)
    return is_armed


def outlive_parent() -> None:
    """Undo `die_with_parent`: from now on this process notices by itself, and ends in good order."""
    if libc.IS_LINUX:
        with contextlib.suppress(OSError):
            libc.prctl(libc.PR_SET_PDEATHSIG, 0)


def _set_fifo(priority: int) -> str | None:
    """Return why SCHED_FIFO was refused, or None."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except OSError as error:
        return (
            f"SCHED_FIFO priority {priority} refused ({error.strerror}); allow it with a line"
            f" `USER - rtprio {priority}` in /etc/security/limits.conf, or CAP_SYS_NICE"
        )
    return None


def _set_affinity(processors: tuple[int, ...]) -> str | None:
    try:
        os.sched_setaffinity(0, processors)
    except (OSError, ValueError, OverflowError) as error:
        return (
            f"processors {list(processors)} refused ({error});"
            f" this process may use {list(_affinity())}"
        )
    # The kernel takes a list of which it has only a part, and says nothing of the rest.
    granted = _affinity()
    lacking = sorted(set(processors) - set(granted))
    return (
        f"processors {lacking} are not there; this process may use {list(granted)}"
        if lacking
        else None
    )


def _affinity() -> tuple[int, ...]:
    return tuple(sorted(os.sched_getaffinity(0))) if libc.IS_LINUX else ()


def _set_timer_slack(slack_ns: int) -> tuple[int | None, str | None]:
    """Return the slack as read back and why it could not be set, if so."""
    try:
        libc.prctl(libc.PR_SET_TIMERSLACK, slack_ns)
        return libc.prctl(libc.PR_GET_TIMERSLACK), None
    except OSError as error:
        return None, str(error)


def _lock_memory(limit_bytes: int | None) -> str | None:
    """Return why memory cannot be locked, or None when it is."""
    if limit_bytes is not None and not _may_exceed_lock_limit():
        # Locked with a limit, the first allocation beyond it would fail in the middle of the run.
        return (
            f"at most {limit_bytes} bytes may be locked; allow more with a line"
            " `USER - memlock unlimited` in /etc/security/limits.conf, or CAP_IPC_LOCK"
        )
    try:
        # On fault: pages stay once they are used; address space that never is costs nothing.
        libc.mlockall(libc.MCL_CURRENT | libc.MCL_FUTURE | libc.MCL_ONFAULT)
    except OSError as error:
        return str(error)
    return None


def _memory_lock_limit_bytes() -> int | None:
    soft_bytes, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    return None if soft_bytes == resource.RLIM_INFINITY else soft_bytes


def _may_exceed_lock_limit() -> bool:
    """Tell whether this process has the capability that lifts RLIMIT_MEMLOCK."""
    with contextlib.suppress(OSError):
        for line in STATUS_FILE.read_text().splitlines():
            if line.startswith("CapEff:"):
                return bool(int(line.split()[1], 16) >> CAP_IPC_LOCK & 1)
    return False
