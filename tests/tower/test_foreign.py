"""Boards of foreign architectures: real Debian systems, run by an emulator."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from .fixtures import need_tower
from .roots import EMULATORS, REGISTRY, cache_folder, ensure_root, why_unavailable
from .specification import BoardSpec
from .tower import Tower

# The first use builds the systems.
pytestmark = [pytest.mark.root, pytest.mark.nightly, pytest.mark.timeout(1200)]

MACHINES = {"arm64": "aarch64", "armhf": "armv7l"}


@pytest.fixture(scope="module")
def tower() -> Iterator[Tower]:
    need_tower()
    for arch in MACHINES:
        reason = why_unavailable(arch)
        if reason:
            pytest.skip(reason)
        ensure_root(arch)
    boards = [BoardSpec(name=arch, arch=arch) for arch in MACHINES]
    with Tower(boards=boards, boot_delay_s=0.1) as tower:
        yield tower


@pytest.mark.parametrize("arch", MACHINES)
def test_board_is_of_its_architecture_and_its_user_has_sudo(tower, arch):
    shown = tower.run(arch, "uname -m; dpkg --print-architecture; id -un; sudo id -un").stdout
    assert shown.split() == [MACHINES[arch], arch, "pi", "root"]


@pytest.mark.parametrize("arch", MACHINES)
def test_python_makes_a_venv(tower, arch):
    command = "python3 -m venv --without-pip /tmp/v && /tmp/v/bin/python -c 'print(1)'"
    assert tower.run(arch, command, timeout_s=120).stdout == "1\n"


def test_32_bit_board_has_the_distributions_packages(tower):
    code = "import msgpack, numpy, psutil; print(numpy.arange(3).sum())"
    assert tower.run("armhf", f'python3 -c "{code}"', timeout_s=120).stdout == "3\n"


def test_foreign_board_reboots(tower):
    tower.run("arm64", "echo kept > note; sync -f .; sudo reboot", check=False)
    tower.wait_until_on("arm64", 2)
    assert tower.run("arm64", "cat note").stdout == "kept\n"


def test_settings_of_a_foreign_board_are_its_own(tower):
    command = "sudo sysctl -q -w net.core.rmem_max=4321; sysctl -n net.core.rmem_max"
    assert tower.run("armhf", f"PATH=$PATH:/usr/sbin; {command}").stdout == "4321\n"


def test_emulators_are_registered_for_the_tower_alone(tower):
    assert not any((REGISTRY / f"cosmos-{name}").exists() for name in EMULATORS.values())


def test_missing_tools_are_named(monkeypatch, tmp_path):
    monkeypatch.setenv("COSMOS_TOWER_CACHE", str(tmp_path))
    monkeypatch.setenv("PATH", "/nowhere")
    assert cache_folder() == Path(tmp_path)
    assert "mmdebstrap" in (why_unavailable("arm64") or "")
