"""However a tower ends, nothing of it is left: no process, mount, namespace, link, group or file."""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from harness.waiting import wait_until

from . import kernel
from .fixtures import need_tower
from .network import list_networks
from .places import TOWERS_MAX, Places
from .specification import BoardSpec
from .tower import Tower, TowerError, wait_until_gone

pytestmark = [pytest.mark.root, pytest.mark.nightly]

PATIENCE_S = 120.0
ROOT = Path(__file__).parents[2]
CLI = (sys.executable, "-m", "tests.tower")
OWNER = """
import sys, time
sys.path.insert(0, sys.argv[1])
from tower import Tower
with Tower(count=2, index=int(sys.argv[2])) as tower:
    print(tower.places.index, flush=True)
    time.sleep(600)
"""


def list_processes(folder: str) -> set[tuple[int, str]]:
    """Return the processes that live on a tower's mounts: number and start time."""
    found = set()
    for path in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            fields = (path / "stat").read_text().rpartition(")")[2].split()
            mounts = (path / "mountinfo").read_text()
            if f"lowerdir={folder}/" in mounts and fields[0] not in "ZX":
                found.add((int(path.name), fields[19]))
    return found


def list_traces(places: Places) -> list[str]:
    """Return what is left of a tower, in words."""
    traces = [f"process {pid}" for pid, _ in list_processes(str(places.folder))]
    if places.folder.exists():
        names = sorted(name for _, *found in os.walk(places.folder) for name in sum(found, []))
        traces.append(f"{places.folder}: {names[:5]}")
    if Path(f"/sys/class/net/{places.uplink}").exists():
        traces.append(places.uplink)
    if str(places.folder) in Path("/proc/self/mountinfo").read_text():
        traces.append("mounts")
    return traces + list_groups(places)


def list_disks(name: str) -> list[Path]:
    """Return the loop devices that hold a disk of a board with this name, which no other tower has."""
    found = []
    for backing in Path("/sys/block").glob("loop*/loop/backing_file"):
        with contextlib.suppress(OSError):
            if f"/{name}.img" in backing.read_text():  # the folder does not show in our namespace
                found.append(backing.parents[1])
    return found


def list_groups(places: Places) -> list[str]:
    """Return the tower's control groups, seen from a mount of our own."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            kernel.unshare(kernel.CLONE_NEWNS)
            kernel.make_mounts_private()
            kernel.mount("cgroup2", "/mnt", "cgroup2")
            # Groups of others may vanish meanwhile, which a walk bears.
            found = [top for top, _, _ in os.walk("/mnt") if Path(top).name == places.cgroup]
            os.write(write, json.dumps(found).encode())
        finally:
            os._exit(0)
    os.close(write)
    os.waitpid(child, 0)
    with os.fdopen(read) as pipe:
        return json.loads(pipe.read())  # type: ignore[no-any-return]


def own_index() -> int:
    """Return an index that no tower takes by itself: those take the first, and would leave traces of their own there."""
    return secrets.choice(range(TOWERS_MAX // 2, TOWERS_MAX))


def stress(tower: Tower) -> None:
    """Do to a tower what makes it hard to clean up."""
    tower.fault("pi01", "freeze")
    tower.run("pi02", "setsid sleep 1000 >/dev/null 2>&1 & echo; head -c 5M /dev/zero > big")
    tower.fault("pi02", "loss", 10)


def find_guardian(supervisor: int) -> int:
    """Return the supervisor's guardian: the other process that holds the tower's folder open."""
    return find_guardians(supervisor)[0]


def find_guardians(supervisor: int) -> list[int]:
    """Return who else has the lock of a supervisor."""
    folder = os.readlink(next(iter(find_locks(supervisor))))
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        if int(path.name) != supervisor:
            with contextlib.suppress(OSError):
                if any(os.readlink(link) == folder for link in (path / "fd").iterdir()):
                    found.append(int(path.name))
    return found


def find_locks(process: int) -> list[Path]:
    """Return the descriptors by which a process owns a tower's index."""
    found = []
    for link in Path(f"/proc/{process}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # closed meanwhile
            if os.readlink(link).startswith("/run/cosmos-tower/"):
                found.append(link)
    return found


def test_traces_are_seen_while_a_tower_runs(make_tower):
    name = f"disk{secrets.token_hex(4)}"
    tower = make_tower(boards=[BoardSpec(name=name)])
    traces = " ".join(list_traces(tower.places))
    for word in ("process", str(tower.places.folder), tower.places.uplink, "/mnt/"):
        assert word in traces
    assert list_disks(name)


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_ended_tower_lets_its_disks_go(make_tower, how):
    before = set(Path("/sys/block").glob("loop*"))
    names = [f"disk{secrets.token_hex(4)}-{number}" for number in range(12)]
    tower = make_tower(boards=[BoardSpec(name=name) for name in names], index=own_index())
    added = {path for name in names for path in list_disks(name)} - before

    os.kill(tower.process.pid, how)
    wait_until_gone(tower.places)

    wait_until(lambda: not any(list_disks(name) for name in names), "disks in use")
    # Another tower may have taken one in the meantime, and be about to use it, or to give it back.
    wait_until(
        lambda: not [p for p in added if p.exists() and not (p / "loop/backing_file").exists()],
        "loop devices that nobody uses",
    )


def test_stopped_tower_leaves_nothing(make_tower):
    tower = make_tower(count=2, index=own_index())
    stress(tower)
    tower.stop()
    assert list_traces(tower.places) == []


def test_tower_ends_with_a_failing_test(make_tower):
    class Failure(Exception):
        pass

    with pytest.raises(Failure), Tower(count=1, index=own_index()) as tower:
        raise Failure
    assert list_traces(tower.places) == []


def test_killed_supervisor_leaves_nothing(make_tower):
    tower = make_tower(count=2, index=own_index())
    stress(tower)
    assert len(list_processes(str(tower.places.folder))) >= 4

    os.kill(tower.process.pid, signal.SIGKILL)
    wait_until_gone(tower.places)

    wait_until(lambda: not list_traces(tower.places), lambda: f"{list_traces(tower.places)}")


def test_down_cleans_up_after_supervisor_and_guardian_were_killed(make_tower):
    tower = make_tower(count=2, index=own_index())
    stress(tower)
    guardian = find_guardian(tower.process.pid)

    os.kill(guardian, signal.SIGKILL)
    os.kill(tower.process.pid, signal.SIGKILL)
    tower.process.wait()
    assert tower.places.folder.exists()
    run_cli("--tower", str(tower.places.index), "down")

    wait_until(lambda: not list_traces(tower.places), lambda: f"{list_traces(tower.places)}")


def test_killed_owner_takes_its_tower_with_it():
    need_tower()
    command = [sys.executable, "-c", OWNER, str(ROOT / "tests"), str(own_index())]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as owner:
        assert owner.stdout is not None
        places = Places(int(owner.stdout.readline()))
        assert list_traces(places)
        owner.kill()
    wait_until_gone(places)
    wait_until(lambda: not list_traces(places), lambda: f"{list_traces(places)}")


def test_killed_boot_leaves_nothing():
    """A supervisor killed at any moment of its start leaves nothing either."""
    need_tower()
    for delay_s in (0.1, 0.3, 0.5, 0.7):
        with subprocess.Popen(
            [*CLI, "--tower", str(own_index()), "up", "4"],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        ) as process:
            time.sleep(delay_s)
            process.send_signal(signal.SIGSTOP)
            wait_until(lambda: is_stopped(process.pid), "a stopped supervisor")  # noqa: B023 - called at once
            owned = find_owned(process.pid)
            is_guarded = owned is not None and bool(find_guardians(process.pid))
            process.kill()
        if owned is not None:
            if is_guarded:
                wait_until_gone(owned)
            # Before there is a guardian there is nothing but the folder, which the next tower takes over.
            left = [] if is_guarded else [[f"{owned.folder}: []"]]
            wait_until(lambda: list_traces(owned) in ([], *left), lambda: f"{list_traces(owned)}")  # noqa: B023
            owned.remove()


def is_stopped(process: int) -> bool:
    """Tell whether a process does nothing any more: stopped, or it has ended."""
    return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] in "TZ"


def find_owned(process: int) -> Places | None:
    """Return the tower whose lock a process holds; a folder that it has only opened may be another's."""
    locks = Path("/proc/locks").read_text()
    for link in find_locks(process):
        with contextlib.suppress(FileNotFoundError):
            folder = Path(os.readlink(link))
            found = link.stat()
            device = f"{os.major(found.st_dev):02x}:{os.minor(found.st_dev):02x}:{found.st_ino}"
            if folder.name.isdigit() and re.search(rf"FLOCK .* {process} {device} ", locks):
                return Places(int(folder.name))
    return None


def test_towers_at_once_share_nothing(make_tower):
    first, second = make_tower(count=1), make_tower(count=1)

    assert first.places != second.places
    assert first.boards["pi01"].address != second.boards["pi01"].address
    first.run("pi01", "touch first")
    assert second.run("pi01", "ls").stdout == ""
    first.stop()
    second.run("pi01", "true")


def test_network_in_use_is_refused(make_tower):
    tower = make_tower(count=1)
    prefix = ".".join(tower.boards["pi01"].address.split(".")[:2])
    with pytest.raises(TowerError, match=r"is in use here .*choose another"):
        make_tower(count=1, network=prefix)
    with pytest.raises(TowerError, match="is not private"):
        make_tower(count=1, network="8.8")


def test_index_in_use_is_refused(make_tower):
    taken = make_tower(count=1).places.index
    command = [*CLI, "--tower", str(taken), "up", "1"]
    run = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert (run.returncode, "runs already" in run.stderr) == (1, True)


def test_networks_of_this_computer_are_known():
    need_tower()
    assert any(network.is_loopback for network in list_networks())


def test_ctrl_c_ends_a_tower_in_the_foreground():
    need_tower()
    with subprocess.Popen(
        [*CLI, "--tower", str(own_index()), "up", "2", "--json"],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as process:
        assert process.stdout is not None
        places = Places(json.loads(process.stdout.readline())["tower"])
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 0
    assert list_traces(places) == []


def run_cli(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*CLI, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=True
    )
