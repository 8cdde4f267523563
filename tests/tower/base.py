"""
What all boards of one architecture have in common: a layer over a Debian system that makes it a board.

What is shown of the system below is a list of what may be seen, not of what may not: where that system
is the operator's own computer, nothing of its users, keys, configuration or history gets into a board.
"""

from __future__ import annotations

import os
from pathlib import Path

from .layer import BOARD_FILES, Layer

USER = "pi"
USER_ID = 1000
SYSTEM_ID_MAX = 999
NOBODY_ID = 65534
ROOT_SHOWN = ("bin", "sbin", "lib", "lib32", "lib64", "libx32", "usr", "etc", "var")
ROOT_NEW = {
    **dict.fromkeys(
        ("boot", "dev", "home", "media", "mnt", "opt", "proc", "run", "srv", "sys"), 0o755
    ),
    "boot/firmware": 0o755,
    "root": 0o700,
    "tmp": 0o1777,
    "usr/local": 0o755,
    **{f"usr/local/{name}": 0o755 for name in ("bin", "etc", "lib", "sbin", "share")},
}
ETC_SHOWN = frozenset((BOARD_FILES / "etc_shown").read_text().split())
VAR_LIB_SHOWN = ("dpkg", "pam", "python")
VAR_NEW = {
    **dict.fromkeys(("var/backups", "var/mail", "var/opt", "var/spool"), 0o755),
    **dict.fromkeys(("var/cache/apt/archives/partial", "var/cache/debconf"), 0o755),
    **dict.fromkeys(("var/lib/apt/lists/partial", "var/lib/sudo", "var/log/apt"), 0o755),
    "var/tmp": 0o1777,
}
APT_NEW = (
    "apt.conf.d",
    "auth.conf.d",
    "keyrings",
    "preferences.d",
    "sources.list.d",
    "trusted.gpg.d",
)
ETC_NEW = ("apt", *(f"apt/{name}" for name in APT_NEW), "profile.d", "ssh", "sudoers.d", "sysctl.d")
GROUPS = ("adm", "dialout", "sudo", "audio", "video", "plugdev", "gpio", "i2c", "spi")
SHADOW_AGE = "19700:0:99999:7:::"
NO_PASSWORD_NEEDED = "etc/sudoers.d/010_pi-nopasswd"
REPOSITORY = "/opt/cosmos-test-repo"
SERVICE_LINKS = "etc/systemd/system"


def write_base(layer: Layer, public_key: str) -> None:
    """Turn the Debian system below *layer* into a board without a name."""
    _show_system(layer)
    _write_accounts(layer, public_key)
    _write_configuration(layer)
    _write_programs(layer)


def write_python(layer: Layer, kind: str) -> None:
    """Take the Python of a board away, or make it look old, in a layer over its base."""
    programs = sorted(path.name for path in (layer.lower / "usr/bin").glob("python3*"))
    for name in programs:
        layer.hide(f"usr/bin/{name}")
    if kind == "old":
        real = (layer.lower / "usr/bin/python3").resolve()
        layer.copy("usr/bin/python3.9", real)
        for name in ("python3", real.name):
            (layer.folder / "usr/bin" / name).unlink()
        layer.hide(f"usr/bin/{real.name}")
        layer.link("usr/bin/python3", "python3.9")
        layer.install(f"usr/lib/{real.name}/sitecustomize.py", "old_python.py", 0o644)


def _show_system(layer: Layer) -> None:
    """Decide what is seen of the system below."""
    layer.keep_only("", ROOT_SHOWN)
    layer.keep_only("etc", ETC_SHOWN)
    layer.keep_only("var", ("lib",))
    layer.keep_only("var/lib", VAR_LIB_SHOWN)
    for path, mode in ROOT_NEW.items():
        _renew(layer, path, mode)
    for name in ETC_NEW:
        _renew(layer, f"etc/{name}", 0o755)
    _renew(layer, "etc/ssl/private", 0o700)
    _renew(layer, SERVICE_LINKS, 0o755)
    for path, mode in VAR_NEW.items():
        for parent in reversed(Path(path).parents):
            if str(parent) not in (".", "var", "var/lib"):
                _renew(layer, str(parent), 0o755)
        _renew(layer, path, mode)
    layer.link("var/run", "/run")
    layer.link("var/lock", "/run/lock")


def _renew(layer: Layer, path: str, mode: int) -> None:
    """Make an empty folder, also where the system below has something else, or nothing."""
    target = layer.folder / path
    if not target.is_dir() and os.path.lexists(target):
        target.unlink()
    layer.renew(path, mode)


def _write_accounts(layer: Layer, public_key: str) -> None:
    """Keep the system's accounts, without passwords, and add the user."""
    accounts = [line.split(":") for line in (layer.lower / "etc/passwd").read_text().splitlines()]
    kept = [fields for fields in accounts if _is_system(int(fields[2]))]
    kept.append([USER, "x", str(USER_ID), str(USER_ID), "", f"/home/{USER}", "/bin/bash"])
    layer.add("etc/passwd", _join(kept))
    shadow = [f"{fields[0]}:*:{SHADOW_AGE}" for fields in kept]
    layer.add("etc/shadow", "\n".join(shadow) + "\n", 0o640)
    groups = [line.split(":") for line in (layer.lower / "etc/group").read_text().splitlines()]
    groups = [fields for fields in groups if _is_system(int(fields[2]))]
    known, used = {fields[0] for fields in groups}, {int(fields[2]) for fields in groups}
    free = (number for number in range(SYSTEM_ID_MAX, 100, -1) if number not in used)
    groups += [[name, "x", str(next(free)), ""] for name in GROUPS if name not in known]
    members = [[*fields[:3], USER if fields[0] in GROUPS else ""] for fields in groups]
    members.append([USER, "x", str(USER_ID), ""])
    layer.add("etc/group", _join(members))
    layer.add("etc/gshadow", "".join(f"{fields[0]}:*::{fields[3]}\n" for fields in members), 0o640)
    home = f"home/{USER}"
    layer.renew(home, 0o755)
    layer.renew(f"{home}/.ssh", 0o700)
    layer.add(f"{home}/.ssh/authorized_keys", public_key + "\n", 0o600)
    for path in (home, f"{home}/.ssh", f"{home}/.ssh/authorized_keys"):
        os.chown(layer.folder / path, USER_ID, USER_ID)


def _write_configuration(layer: Layer) -> None:
    """Write what a board is configured by."""
    layer.install("etc/sudoers", "sudoers", 0o440)
    layer.add(NO_PASSWORD_NEEDED, f"{USER} ALL=(ALL) NOPASSWD: ALL\n", 0o440)
    layer.add("etc/nsswitch.conf", "passwd: files\ngroup: files\nshadow: files\nhosts: files\n")
    layer.add("etc/resolv.conf", "")
    layer.add("etc/environment", "")
    layer.add("etc/default/locale", "LANG=C.UTF-8\n")
    layer.add("etc/fstab", "")
    layer.add("etc/sysctl.conf", "")
    layer.add("etc/apt/sources.list", f"deb [trusted=yes] file:{REPOSITORY} ./\n")
    layer.install("etc/os-release", "os_release", 0o644)
    layer.install("etc/ssh/sshd_config", "sshd_config", 0o644)
    layer.install("etc/pam.d/sshd", "pam_sshd", 0o644)
    layer.install("etc/pam.d/sudo", "pam_sudo", 0o644)
    layer.install("boot/firmware/config.txt", "config.txt", 0o644)


def _write_programs(layer: Layer) -> None:
    """Put programs in place of those that need a real boot, firmware or kernel device."""
    layer.install("usr/lib/tower/init", "init")
    for name in ("reboot", "poweroff", "halt", "shutdown"):
        layer.install(f"usr/sbin/{name}", "power")
    layer.install("usr/bin/systemctl", "systemctl")
    layer.install("usr/bin/vcgencmd", "vcgencmd")
    layer.install("usr/sbin/rfkill", "rfkill")
    if not (layer.lower / "usr/sbin/sysctl").exists():
        layer.install("usr/sbin/sysctl", "sysctl")


def _is_system(number: int) -> bool:
    return number <= SYSTEM_ID_MAX or number == NOBODY_ID


def _join(table: list[list[str]]) -> str:
    return "".join(":".join(fields) + "\n" for fields in table)
