"""A share of a processor that the kernel holds a process, and all that it starts, down to."""

import contextlib
import os
import time
from pathlib import Path

CPU = Path("/sys/fs/cgroup/cpu")
UNIFIED = Path("/sys/fs/cgroup")
PERIOD_US = 100_000


def make_quota(share):
    """Return the folder of a new control group that may use *share* of one processor; None where nobody may make one."""
    name = f"cosmos-test-{os.getpid()}-{time.monotonic_ns()}"
    with contextlib.suppress(OSError):
        group = (CPU if (CPU / "cgroup.procs").exists() else UNIFIED) / name
        group.mkdir()
        try:
            set_share(group, share)
        except OSError:
            group.rmdir()
            raise
        return group
    return None


def set_share(group, share):
    """Give a control group another share."""
    quota_us = int(share * PERIOD_US)
    if group.parent == CPU:
        (group / "cpu.cfs_period_us").write_text(str(PERIOD_US))
        (group / "cpu.cfs_quota_us").write_text(str(quota_us))
    else:
        (group / "cpu.max").write_text(f"{quota_us} {PERIOD_US}")


def throttled_count(group):
    """Return how often the kernel has held the group up."""
    lines = (group / "cpu.stat").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("nr_throttled"))


def remove_quota(group):
    """Remove a control group whose processes have ended."""
    for _ in range(200):
        with contextlib.suppress(OSError):
            group.rmdir()
            return
        time.sleep(0.05)
