"""Load of a machine's processors, and its causes: counters of the kernel, read twice."""

from __future__ import annotations

import contextlib
import os
import time
from dataclasses import dataclass

from cosmos_cli.onboard.files import user_name
from cosmos_cli.onboard.links import read_text
from cosmos_cli.onboard.request_loop import PlainValue

TOP_COUNT = 3
TICKS_A_SECOND = os.sysconf("SC_CLK_TCK")
TIME_SERVICES = frozenset(
    ("chronyd", "ntpd", "ntpsec", "openntpd", "systemd-timesyn", "timesyncd", "phc2sys", "ptp4l")
)
"""Names as the kernel keeps them, 15 characters at most."""
CPU_FIELDS = ("user", "nice", "system", "idle", "iowait", "irq", "softirq", "steal")


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One process at one instant."""

    name: str
    parent: int
    start: int
    ticks: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """The kernel's counters at one instant."""

    at_s: float
    tasks: dict[int, Task]
    cpu_ticks: dict[str, int]
    swapped_pages: int


def look(proc: str = "/proc") -> Moment:
    """Read the counters."""
    return Moment(
        at_s=time.monotonic(),
        tasks=_tasks(proc),
        cpu_ticks=_cpu_ticks(proc),
        swapped_pages=_swapped_pages(proc),
    )


def compare(before: Moment, after: Moment) -> dict[str, PlainValue]:
    """Tell what happened between two looks; this process, those above it and its own are left out."""
    span_s = max(1e-3, after.at_s - before.at_s)
    own = _relatives(after.tasks)
    used = {
        pid: (task.ticks - earlier.ticks) / TICKS_A_SECOND / span_s
        for pid, task in after.tasks.items()
        if pid not in own
        and (earlier := before.tasks.get(pid)) is not None
        and earlier.start == task.start
    }
    top = sorted(used, key=lambda pid: -used[pid])[:TOP_COUNT]
    spent = {key: after.cpu_ticks[key] - before.cpu_ticks.get(key, 0) for key in after.cpu_ticks}
    all_ticks = max(1, sum(spent.values()))
    return {
        "span_s": round(span_s, 2),
        "processors": sum(used.values()),
        "top": [
            {
                "name": after.tasks[pid].name,
                "pid": pid,
                "user": _user(pid),
                "processors": round(used[pid], 3),
            }
            for pid in top
            if used[pid] > 0
        ],
        "steal_share": spent.get("steal", 0) / all_ticks,
        "iowait_share": spent.get("iowait", 0) / all_ticks,
        "swapped_pages": after.swapped_pages - before.swapped_pages,
        "load": list(os.getloadavg()),
        "time_service": next(
            (t.name for t in after.tasks.values() if t.name in TIME_SERVICES), None
        ),
    }


def _tasks(proc: str) -> dict[int, Task]:
    tasks = {}
    for name in os.listdir(proc):
        if not name.isdecimal():
            continue
        with contextlib.suppress(OSError, IndexError, ValueError):
            with open(f"{proc}/{name}/stat", "rb") as file:
                text = file.read().decode(errors="replace")
            # The name, in parentheses, may hold spaces and parentheses itself.
            begin, end = text.index("("), text.rindex(")")
            values = text[end + 2 :].split()
            tasks[int(name)] = Task(
                name=text[begin + 1 : end],
                parent=int(values[1]),
                start=int(values[19]),
                ticks=int(values[11]) + int(values[12]),
            )
    return tasks


def _relatives(tasks: dict[int, Task]) -> set[int]:
    """Return this process, those that it descends from, and those that descend from it."""
    own: set[int] = set()
    pid = os.getpid()
    while pid in tasks and pid not in own:
        own.add(pid)
        pid = tasks[pid].parent
    below = {os.getpid()}
    while below:
        below = {pid for pid, task in tasks.items() if task.parent in below and pid not in own}
        own |= below
    return own


def _cpu_ticks(proc: str) -> dict[str, int]:
    values = (read_text(f"{proc}/stat") or "").partition("\n")[0].split()[1:]
    return dict(zip(CPU_FIELDS, map(int, values), strict=False))


def _swapped_pages(proc: str) -> int:
    lines = (read_text(f"{proc}/vmstat") or "").splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith(("pswpin ", "pswpout ")))


def _user(pid: int) -> str:
    with contextlib.suppress(OSError):
        return user_name(os.stat(f"/proc/{pid}").st_uid)
    return ""
