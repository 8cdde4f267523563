"""`cosmos collect` over real SSH from virtual boards, with everything that can go wrong with them."""

import contextlib
import os
import signal
import time

import pytest
from board_run import PATIENCE_S, BoardRun

pytestmark = pytest.mark.root

LARGE_BYTES = 40_000_000
HOLD_OPEN = (
    "nohup sh -c 'exec 9>>{path}; touch /dev/shm/held; exec sleep 600' >/dev/null 2>&1 &"
    " until test -e /dev/shm/held; do sleep 0.05; done"
)


def wait_for_part(run, size_bytes):
    """Wait until so much of a file of pi01 is on its way here."""
    incoming = run.run.path / ".incoming/pi01"
    until_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < until_s:
        for part in incoming.glob("*.part"):
            with contextlib.suppress(FileNotFoundError):  # it has come whole since it was listed
                if part.stat().st_size >= size_bytes:
                    return
        time.sleep(0.002)
    raise AssertionError(f"no part of {size_bytes} bytes came")


def start_over_a_slow_link(run, tower):
    """Start to collect, and return in the midst of a large file, most of which is still to come."""
    tower.fault("pi01", "loss", 3)
    process = run.cosmos.start("collect")
    wait_for_part(run, 2_000_000)
    return process


def restart(tower, name, fault):
    """Do what makes a board start again, and wait until it has."""
    boots = tower.state()["boards"][name]["boots"]
    tower.fault(name, fault)
    tower.wait_until_on(name, boots=boots + 1)


def test_records_of_all_boards_come_and_are_released(tower8, tmp_path):
    run = BoardRun(tmp_path, tower8, boards=8)

    done = run.cosmos("collect")

    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("PASSED")
    assert run.is_here()
    assert not any(run.lies_on(name) for name in run.names)
    assert run.cosmos("collect").stdout == done.stdout


@pytest.mark.nightly
def test_link_that_is_cut_in_the_midst_of_a_large_file_is_taken_up_again(tower8, tmp_path):
    run = BoardRun(tmp_path, tower8, boards=2, noise_bytes=LARGE_BYTES)
    process = start_over_a_slow_link(run, tower8)
    tower8.fault("pi01", "down")

    _, talk = process.communicate(timeout=PATIENCE_S)

    assert process.returncode == 5, talk
    assert run.missing() == {"pi01", "agent-01"} - {"agent-01" if run.is_here("pi01") else ""}
    assert run.is_here("pi02")
    tower8.fault("pi01", "up")
    tower8.fault("pi01", "noloss")
    assert run.lies_on("pi01")

    done = run.cosmos("collect")

    assert done.returncode == 0, done.stderr
    assert "resumed after" in done.stderr
    assert run.is_here()
    assert not run.lies_on("pi01")


@pytest.mark.nightly
def test_link_that_comes_back_soon_is_not_even_an_error(tower8, tmp_path):
    run = BoardRun(tmp_path, tower8, boards=2, noise_bytes=LARGE_BYTES)
    process = run.cosmos.start("collect")
    wait_for_part(run, 2_000_000)
    tower8.fault("pi01", "cut")  # every connection is torn, the link itself stays

    _, talk = process.communicate(timeout=PATIENCE_S)

    assert process.returncode == 0, talk
    assert run.is_here()


@pytest.mark.parametrize("fault", [pytest.param("reboot", marks=pytest.mark.nightly), "crash"])
def test_board_that_starts_anew_in_the_midst_of_a_large_file_is_collected_whole(
    tower8, tmp_path, fault
):
    run = BoardRun(tmp_path, tower8, boards=2, noise_bytes=LARGE_BYTES)
    tower8.run("pi01", "sync -f .")
    process = run.cosmos.start("collect")
    wait_for_part(run, 2_000_000)
    restart(tower8, "pi01", fault)

    _, talk = process.communicate(timeout=PATIENCE_S)

    # Within that time it may have been reached again, or given up.
    assert process.returncode == (0 if run.is_here("pi01") else 5), talk
    assert run.is_here("pi02")
    done = run.cosmos("collect")
    assert done.returncode == 0, done.stderr
    assert run.is_here()
    assert not run.lies_on("pi01")


@pytest.mark.nightly
def test_frozen_board_is_named_and_collected_once_it_thaws(tower8, tmp_path):
    run = BoardRun(tmp_path, tower8, boards=2, noise_bytes=LARGE_BYTES)
    process = start_over_a_slow_link(run, tower8)
    tower8.fault("pi01", "freeze")

    _, talk = process.communicate(timeout=PATIENCE_S)

    assert process.returncode == 5, talk
    assert "pi01" in run.missing()
    tower8.fault("pi01", "thaw")
    tower8.fault("pi01", "noloss")
    assert run.cosmos("collect").returncode == 0
    assert run.is_here()


@pytest.mark.nightly
def test_board_that_is_off_is_named_and_collected_once_it_is_on(tower8, tmp_path):
    run = BoardRun(tmp_path, tower8, boards=3)
    tower8.fault("pi02", "poweroff")

    first = run.cosmos("collect")

    assert first.returncode == 5
    assert run.missing() == {"pi02", "agent-02"}
    assert run.is_here("pi01", "pi03")
    assert run.run.bundle.exists()
    restart(tower8, "pi02", "poweron")

    second = run.cosmos("collect")

    assert second.returncode == 0, second.stderr
    assert run.is_here()


def test_power_cut_ends_what_wrote_there_and_the_records_are_collected_afterwards(tower8, tmp_path):
    run = BoardRun(tmp_path, tower8, boards=2)
    path = f"{run.directory}/agents/agent-01/ticks.jsonl"
    tower8.run("pi01", HOLD_OPEN.format(path=path))

    alive = run.cosmos("collect")

    assert alive.returncode == 2
    assert "writes agents/agent-01/ticks.jsonl" in alive.stderr
    assert run.lies_on("pi02")
    restart(tower8, "pi01", "crash")

    done = run.cosmos("collect")

    assert done.returncode == 0, done.stderr
    assert run.is_here()


@pytest.mark.nightly
def test_packets_that_are_lost_cost_time_alone(tower8, tmp_path):
    run = BoardRun(tmp_path, tower8, boards=2, noise_bytes=LARGE_BYTES // 10)
    tower8.fault("pi01", "loss", 3)

    done = run.cosmos("collect")

    assert done.returncode == 0, done.stderr
    assert run.is_here()


def test_full_disk_of_a_board_does_not_keep_its_records(tower8, tmp_path):
    run = BoardRun(tmp_path, tower8, boards=2)
    tower8.fault("pi01", "fill")

    done = run.cosmos("collect")

    assert done.returncode == 0, done.stderr
    assert run.is_here()
    assert not run.lies_on("pi01")


@pytest.mark.nightly
def test_read_only_disk_of_a_board_gives_its_records_and_keeps_them(tower8, tmp_path):
    run = BoardRun(tmp_path, tower8, boards=2)
    tower8.fault("pi01", "ro")

    done = run.cosmos("collect")

    assert done.returncode == 0, done.stderr
    assert "it could not be deleted there" in done.stderr
    assert run.is_here()
    restart(tower8, "pi01", "reboot")
    assert run.lies_on("pi01")
    assert run.cosmos("collect").returncode == 0
    assert not run.lies_on("pi01")


@pytest.mark.nightly
def test_interrupted_collect_ends_at_once_and_is_taken_up_again(tower8, tmp_path):
    run = BoardRun(tmp_path, tower8, boards=2, noise_bytes=LARGE_BYTES)
    process = start_over_a_slow_link(run, tower8)
    process.send_signal(signal.SIGINT)

    process.communicate(timeout=120)
    tower8.fault("pi01", "noloss")

    assert process.returncode == 130
    assert run.lies_on("pi01")
    assert run.cosmos("collect").returncode == 0
    assert run.is_here()


def test_wipe_deletes_what_was_collected_and_keeps_the_rest(tower8, tmp_path):
    run = BoardRun(tmp_path, tower8, boards=2)
    inventory = tmp_path / "tower.yaml"
    tower8.write_inventory(inventory, boards=["pi01", "pi02"])
    wipe = ("wipe", "-i", os.fspath(inventory), "--yes")
    tower8.fault("pi01", "ro")
    run.cosmos("collect", "--forks", "1")
    restart(tower8, "pi01", "reboot")
    tower8.run("pi02", f"mkdir -p {run.directory.replace('0001', '0099')}/agents")

    done = run.cosmos(*wipe)

    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1].startswith("2 machines: 1 run deleted")
    assert not run.lies_on("pi01")
    assert run.is_there("pi02", run.directory.replace("0001", "0099"))
    assert run.cosmos(*wipe, "--all", "--uncollected").returncode == 0
    assert not run.is_there("pi02", "cosmos")
