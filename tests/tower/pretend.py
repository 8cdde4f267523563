"""What the kernel tells of a board: a Raspberry Pi's device tree, sensors and settings, all of them fakes."""

from __future__ import annotations

import os
from pathlib import Path

MODEL = "Raspberry Pi 4 Model B Rev 1.4"
TEMPERATURE_MILLICELSIUS = 48_312
THERMAL = "class/thermal/thermal_zone0/temp"
GOVERNORS = "conservative ondemand userspace powersave performance schedutil"
FREQUENCY_KHZ = {"min": 600_000, "max": 1_500_000, "cur": 1_500_000}
SETTINGS = {
    "net/core/rmem_default": "212992",
    "net/core/rmem_max": "212992",
    "net/core/wmem_default": "212992",
    "net/core/wmem_max": "212992",
    "kernel/sched_rt_runtime_us": "950000",
}
SETTING_BYTES_MAX = 65_536


def write_sys(folder: Path) -> None:
    """Write what is laid over /sys."""
    _write(folder / "firmware/devicetree/base/model", MODEL + "\0")
    _write(folder / "firmware/devicetree/base/compatible", "raspberrypi,4-model-b\0brcm,bcm2711\0")
    _write(folder / THERMAL, f"{TEMPERATURE_MILLICELSIUS}\n")
    _write(folder / "class/thermal/thermal_zone0/type", "cpu-thermal\n")
    for number in range(os.cpu_count() or 1):
        frequency = folder / f"devices/system/cpu/cpu{number}/cpufreq"
        _write(frequency / "scaling_governor", "ondemand\n")
        _write(frequency / "scaling_available_governors", GOVERNORS + "\n")
        for name, khz in FREQUENCY_KHZ.items():
            _write(frequency / f"scaling_{name}_freq", f"{khz}\n")
            _write(frequency / f"cpuinfo_{name}_freq", f"{khz}\n")
    for number, (name, kind) in enumerate((("phy0", "wlan"), ("hci0", "bluetooth"))):
        device = folder / f"class/rfkill/rfkill{number}"
        for entry, text in (
            ("name", name),
            ("type", kind),
            ("soft", "0"),
            ("hard", "0"),
            ("state", "1"),
        ):
            _write(device / entry, text + "\n")


def write_settings(folder: Path) -> None:
    """
    Write a copy of /proc/sys as plain files.

    Boards read and write this copy: a setting of theirs never reaches the kernel they share, and is
    gone after a reboot, as a real one is.
    """
    for parent, folders, names in os.walk("/proc/sys"):
        relative = os.path.relpath(parent, "/proc/sys")
        if relative == "fs":
            folders.remove("binfmt_misc") if "binfmt_misc" in folders else None
        if relative in ("net/ipv4/conf", "net/ipv6/conf", "net/ipv4/neigh", "net/ipv6/neigh"):
            folders[:] = [name for name in folders if name in ("all", "default", "lo")]
        for name in names:
            try:
                with open(os.path.join(parent, name), "rb") as file:
                    content = file.read(SETTING_BYTES_MAX)
            except OSError:
                continue  # write-only, or not for this machine
            _write(folder / relative / name, content.decode(errors="replace"))
    for path, text in SETTINGS.items():
        _write(folder / path, text + "\n")


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(0o644)
