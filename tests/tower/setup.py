"""What happens inside a board's namespaces before its PID 1 starts. Runs in forked processes only."""

from __future__ import annotations

import contextlib
import os
import resource
import shutil
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING

from . import kernel

if TYPE_CHECKING:
    from .board import Surroundings

INIT = "/usr/lib/tower/init"
ENVIRONMENT = {
    "PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin",
    "HOME": "/",
    "LANG": "C.UTF-8",
}
DEVICES = ("null", "zero", "full", "random", "urandom", "tty")
DEVICE_LINKS = {
    "fd": "/proc/self/fd",
    "stdin": "fd/0",
    "stdout": "fd/1",
    "stderr": "fd/2",
    "ptmx": "pts/ptmx",
}
CAPABILITIES_DROPPED = {
    "DAC_READ_SEARCH": 2,  # opens files of other file systems by handle
    "SYS_MODULE": 16,
    "SYS_RAWIO": 17,
    "SYS_PACCT": 20,
    "SYS_ADMIN": 21,  # mounts: every fake and every read-only mount of a board rests on this
    "SYS_BOOT": 22,
    "SYS_TIME": 25,
    "MKNOD": 27,  # the disks of the real machine
    "AUDIT_CONTROL": 30,
    "MAC_OVERRIDE": 32,
    "MAC_ADMIN": 33,
    "SYSLOG": 34,
    "WAKE_ALARM": 35,
    "BLOCK_SUSPEND": 36,
    "PERFMON": 38,
    "BPF": 39,
    "CHECKPOINT_RESTORE": 40,
}
LIMITS = {
    resource.RLIMIT_CORE: (0, resource.RLIM_INFINITY),
    resource.RLIMIT_NOFILE: (1024, 524_288),
    resource.RLIMIT_MEMLOCK: (8 << 20, 8 << 20),
    resource.RLIMIT_RTPRIO: (0, 0),
    resource.RLIMIT_NICE: (0, 0),
}
"""As on a freshly installed Debian; what `up` sets in /etc/security must show."""
NANOSECONDS = 1_000_000_000
TEMPORARY_BYTES = "size=256m"


def keep_only_descriptors(log: Path, *kept: int) -> None:
    """Close everything that belongs to the supervisor, and write to the board's log."""
    null = os.open("/dev/null", os.O_RDONLY)
    out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    os.dup2(null, 0)
    os.dup2(out, 1)
    os.dup2(out, 2)
    for name in os.listdir("/proc/self/fd"):
        if int(name) > 2 and int(name) not in kept:
            with contextlib.suppress(OSError):  # the descriptor of this very listing
                os.close(int(name))


def renew_clocks() -> None:
    """Let time since boot begin now for the processes to come; a kernel without time namespaces keeps it."""
    with contextlib.suppress(OSError):
        kernel.unshare(kernel.CLONE_NEWTIME)
        offsets = []
        for name, clock in (("monotonic", time.CLOCK_MONOTONIC), ("boottime", time.CLOCK_BOOTTIME)):
            seconds, nanoseconds = divmod(-time.clock_gettime_ns(clock), NANOSECONDS)
            offsets.append(f"{name} {seconds} {nanoseconds}\n")
        Path("/proc/self/timens_offsets").write_text("".join(offsets))


def build_root(surroundings: Surroundings, disk: Path, boot_id: str) -> None:
    """Mount the board's root file system with all that belongs into it, and make it the root."""
    kernel.make_mounts_private()
    scratch = disk.parent / f"{disk.name}-boot"
    scratch.mkdir(exist_ok=True)
    kernel.mount("boot", scratch, "tmpfs", 0, "mode=700")
    root = scratch / "root"
    root.mkdir()
    lowers = ":".join(str(path) for path in surroundings.lowers)
    kernel.mount(
        "overlay",
        root,
        "overlay",
        kernel.MS_NOATIME,
        f"lowerdir={lowers},upperdir={disk}/upper,workdir={disk}/work",
    )
    _mount_processes(root, scratch, surroundings, boot_id)
    _mount_system(root, scratch, surroundings)
    _mount_devices(root)
    kernel.mount(
        "run", root / "run", "tmpfs", kernel.MS_NOSUID | kernel.MS_NODEV, "mode=755,size=64m"
    )
    for name, mode in (("sshd", 0o755), ("lock", 0o1777), ("tower", 0o755)):
        (root / "run" / name).mkdir()
        (root / "run" / name).chmod(mode)
    _empty(root / "tmp")
    kernel.change_root(root)


def execute_init() -> None:
    """Become the board's PID 1, with nothing left of the process that this was."""
    os.umask(0o022)
    for limit, (soft, hard) in LIMITS.items():
        with contextlib.suppress(ValueError):  # without CAP_SYS_RESOURCE: keep what is lower
            resource.setrlimit(limit, (soft, hard))
    for number in signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP}:
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    kernel.drop_capabilities(CAPABILITIES_DROPPED.values())
    os.execve(INIT, ["init"], ENVIRONMENT)


def _mount_processes(root: Path, scratch: Path, surroundings: Surroundings, boot_id: str) -> None:
    """Mount /proc, with a copy in place of the settings that the machine's kernel obeys."""
    processes = root / "proc"
    kernel.mount("proc", processes, "proc", kernel.MS_NOSUID | kernel.MS_NODEV | kernel.MS_NOEXEC)
    settings = processes / "sys"
    _mount_over(surroundings.settings_layer, None, settings, scratch / "settings")
    (settings / "kernel/random/boot_id").write_text(boot_id + "\n")
    random = "kernel/random/uuid"
    kernel.mount(f"/proc/sys/{random}", settings / random, flags=kernel.MS_BIND)
    if (processes / "sysrq-trigger").exists():
        kernel.mount("/dev/null", processes / "sysrq-trigger", flags=kernel.MS_BIND)
    for name in ("irq", "bus", "fs", "acpi", "scsi"):
        if (processes / name).is_dir():
            kernel.mount(processes / name, processes / name, flags=kernel.MS_BIND)
            flags = kernel.MS_REMOUNT | kernel.MS_BIND | kernel.MS_RDONLY
            kernel.mount(None, processes / name, flags=flags)


def _mount_system(root: Path, scratch: Path, surroundings: Surroundings) -> None:
    """Mount /sys: the real one, unwritable, with a Pi's entries over it."""
    real = scratch / "sysfs"
    real.mkdir()
    kernel.mount("sysfs", real, "sysfs", kernel.MS_RDONLY)
    _mount_over(surroundings.sys_layer, real, root / "sys", scratch / "system")


def _mount_over(layer: Path, below: Path | None, target: Path, scratch: Path) -> None:
    """Mount *layer* over *below*, writable in memory until the next boot."""
    for name in ("upper", "work"):
        (scratch / name).mkdir(parents=True)
    lowers = str(layer) if below is None else f"{layer}:{below}"
    data = f"lowerdir={lowers},upperdir={scratch}/upper,workdir={scratch}/work"
    kernel.mount("overlay", target, "overlay", kernel.MS_NOSUID | kernel.MS_NODEV, data)


def _mount_devices(root: Path) -> None:
    """Mount /dev with the few devices that every program may have."""
    devices = root / "dev"
    kernel.mount("dev", devices, "tmpfs", kernel.MS_NOSUID, "mode=755,size=1m")
    for name in DEVICES:
        (devices / name).touch()
        kernel.mount(f"/dev/{name}", devices / name, flags=kernel.MS_BIND)
    for name in ("pts", "shm"):
        (devices / name).mkdir()
    kernel.mount(
        "devpts",
        devices / "pts",
        "devpts",
        kernel.MS_NOSUID,
        "newinstance,ptmxmode=666,mode=620,gid=5",
    )
    flags = kernel.MS_NOSUID | kernel.MS_NODEV
    kernel.mount("shm", devices / "shm", "tmpfs", flags, f"mode=1777,{TEMPORARY_BYTES}")
    for name, target in DEVICE_LINKS.items():
        (devices / name).symlink_to(target)


def _empty(folder: Path) -> None:
    """Delete what a boot deletes; a disk that cannot be written keeps it."""
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            with contextlib.suppress(OSError):
                path.unlink()
