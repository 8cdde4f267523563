"""What a guest boots with beside its system: an initramfs, and a disk with the project, its dependencies and modules."""

from __future__ import annotations

import gzip
import shutil
import stat
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path

from .system import PYTHON, System, make_disk, run_tool

ROOT = Path(__file__).parents[2]
HERE = Path(__file__).parent
BOOT_MODULES = ("virtio_pci", "virtio_blk", "ext4", "crc32c_generic")
MODULES = (
    "virtio_console",
    "i2c-dev", "i2c-stub", "ds4424", "hmc5843_i2c",
    "vcan", "can-raw",
    "uhid", "hid-cp2112",
    "xhci-pci", "ftdi_sio",
)  # fmt: skip
OUTSIDE = ("pytest", "pytest-timeout", "pyserial", "smbus2")
UNUSED = ("pip", "plotly", "scipy", "sgp4")
"""Large, and not needed by runs without a report."""
COMPILE = (
    *("unshare", "--mount", "sh", "-c"),
    'mount --bind "$1" "$2/cosmos" && exec chroot "$2" python3 -m compileall -q -j 2 -x "/(tests|templates)/" /cosmos/site',
    "compile",
)
FIRST = """#!/bin/busybox sh
# The first process: loads what the disks need, and hands over to the system on the first of them.
/bin/busybox mkdir -p /dev /proc /system
/bin/busybox mount -t devtmpfs dev /dev
/bin/busybox mount -t proc proc /proc
for module in $(/bin/busybox cat /modules); do /bin/busybox insmod "$module"; done
/bin/busybox mount -t ext4 /dev/vda /system
/bin/busybox mount -t ext4 /dev/vdb /system/cosmos
/bin/busybox umount /proc
/bin/busybox mount --move /dev /system/dev
exec /bin/busybox switch_root /system /cosmos/init
"""


def make_initramfs(system: System, target: Path) -> None:
    """Write an initramfs that mounts two virtio disks and goes on with /cosmos/init."""
    paths = modules_needed(system.modules, BOOT_MODULES)
    files: dict[str, bytes] = {"bin/busybox": system.busybox.read_bytes(), "init": FIRST.encode()}
    names = []
    for path in paths:
        names.append(f"/{Path(path).name}")
        files[Path(path).name] = (system.modules / path).read_bytes()
    files["modules"] = "\n".join(names).encode()
    target.write_bytes(gzip.compress(archive(files), 1))


def make_code_disk(system: System, target: Path, scratch: Path) -> None:
    """
    Write a disk with the project as installed, its tests, and modules of the kernel.

    Args:
        system: Whose modules.
        target: The disk.
        scratch: An empty folder.
    """
    site = scratch / "site"
    requirements = scratch / "unused.txt"
    requirements.write_text("".join(f"{name}; python_version < '0'\n" for name in UNUSED))
    run_tool(
        sys.executable, "-m", "uv", "pip", "install", "--quiet", "--target", str(site),
        "--python-version", PYTHON, "--python-platform", "x86_64-manylinux_2_28",
        "--override", str(requirements), f"{ROOT}[host,can,gpio]", *OUTSIDE, timeout_s=600,
    )  # fmt: skip
    content = scratch / "disk"
    content.mkdir()
    site.rename(content / "site")
    # Here, since an emulated processor would need minutes for it.
    run_tool(*COMPILE, str(content), str(system.root), timeout_s=600)
    for name in ("guest", "hardware", "harness"):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / "tests" / name, content / "tests" / name, ignore=ignored)
    modules = content / "modules" / system.modules.name
    for path in modules_needed(system.modules, MODULES):
        (modules / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(system.modules / path, modules / path)
    for path in system.modules.glob("modules.*"):
        shutil.copy2(path, modules / path.name)
    shutil.copy2(HERE / "init", content / "init")
    make_disk(target, content)


def modules_needed(folder: Path, names: Iterable[str]) -> list[str]:
    """Return paths of modules and of all that they depend on, in the order in which they load."""
    needs: dict[str, list[str]] = {}
    by_name: dict[str, str] = {}
    for line in (folder / "modules.dep").read_text().splitlines():
        path, _, rest = line.partition(":")
        needs[path] = rest.split()[::-1]  # the last named is the first that is needed
        by_name[Path(path).name.partition(".")[0].replace("-", "_")] = path
    found: dict[str, None] = {}
    for name in names:
        path = by_name[name.replace("-", "_")]
        found |= dict.fromkeys([*needs[path], path])
    return list(found)


def archive(files: Mapping[str, bytes]) -> bytes:
    """Return an archive of executable files in cpio's format "newc", as the kernel reads it."""
    folders = sorted({str(parent) for name in files for parent in Path(name).parents} - {"."})
    entries = [(name, stat.S_IFDIR | 0o755, b"") for name in folders]
    entries += [(name, stat.S_IFREG | 0o755, data) for name, data in files.items()]
    entries += [("TRAILER!!!", 0, b"")]
    found = b""
    for number, (name, mode, data) in enumerate(entries, 1):
        fields = (number, mode, 0, 0, 1, 0, len(data), 0, 0, 0, 0, len(name) + 1, 0)
        head = b"070701" + b"".join(b"%08X" % field for field in fields) + name.encode() + b"\0"
        found += head + b"\0" * (-len(head) % 4) + data + b"\0" * (-len(data) % 4)
    return found
