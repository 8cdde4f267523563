"""Every fault does what its line in the list says, and is undone by its opposite."""

from __future__ import annotations

import socket
import subprocess
import time

import pytest

from .faults import FAULTS
from .tower import Tower, TowerError

pytestmark = [pytest.mark.root, pytest.mark.nightly]

SHORT_S = 2.0
LOSS_PERCENT = 20
PACKETS = 2000
PATIENCE_S = 120.0
ECHO = """
import socket
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
s.bind(("", 9999))
print("ready", flush=True)
while True:
    data, peer = s.recvfrom(2048)
    s.sendto(data, peer)
"""
MARK = b"behind all that was sent"
MARK_S = 0.05


TRIES = 20
PAUSE_S = 0.1


def connects(tower: Tower, name: str) -> bool:
    """Whether a board answers as an SSH server within SHORT_S."""
    try:
        with socket.create_connection((tower.boards[name].address, 22), SHORT_S) as connection:
            connection.settimeout(SHORT_S)
            return connection.recv(4) == b"SSH-"
    except OSError:
        return False


def answers(tower: Tower, name: str) -> bool:
    """Whether a board answers within some tries: on a busy computer one alone may take longer than SHORT_S."""
    for _ in range(TRIES):
        if connects(tower, name):
            return True
        time.sleep(PAUSE_S)
    return False


def start(tower: Tower, name: str, command: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        ["ssh", "-F", str(tower.ssh_config), name, command],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def is_refused(tower: Tower, name: str, command: str = "true") -> str:
    result = tower.run(name, command, check=False)
    assert result.returncode != 0
    return result.stderr


def test_cable_is_pulled_and_plugged(tower8):
    tower8.fault("pi01", "down")
    assert not connects(tower8, "pi01")
    assert answers(tower8, "pi02")

    tower8.fault("pi01", "up")
    assert answers(tower8, "pi01")


def test_pulled_cable_stays_pulled_through_a_reboot(tower8):
    boots = tower8.state()["boards"]["pi01"]["boots"]
    tower8.fault("pi01", "down")
    tower8.fault("pi01", "reboot")
    tower8.wait_until_on("pi01", boots + 1)
    assert not connects(tower8, "pi01")


def test_frozen_board_says_nothing_and_goes_on_after_thaw(tower8):
    tower8.fault("pi02", "freeze")
    assert tower8.state()["boards"]["pi02"]["is_frozen"]
    assert not connects(tower8, "pi02")

    tower8.fault("pi02", "thaw")
    assert answers(tower8, "pi02")


@pytest.mark.parametrize("fault", ["loss", "udploss"])
def test_share_of_packets_is_lost_each_way_and_none_after(tower8, fault):
    echo = start(tower8, "pi03", f"exec python3 -uc '{ECHO}'")
    assert echo.stdout is not None and echo.stdout.readline() == "ready\n"
    try:
        tower8.fault("pi03", fault, LOSS_PERCENT)
        returned = count_echoes(tower8, "pi03")
        tower8.fault("pi03", "noloss")
        returned_after = count_echoes(tower8, "pi03")
    finally:
        echo.kill()
        echo.communicate()

    share = (1 - LOSS_PERCENT / 100) ** 2
    assert abs(returned / PACKETS - share) < 0.06  # five standard deviations
    assert returned_after == PACKETS


def test_board_that_loses_every_datagram_still_lets_in(tower8):
    tower8.fault("pi03", "udploss", 100)
    try:
        assert answers(tower8, "pi03")
    finally:
        tower8.fault("pi03", "noloss")


def count_echoes(tower: Tower, name: str) -> int:
    """Send packets, few enough at once for every buffer, and count those that come back: none overtakes another."""
    count, until_s = 0, time.monotonic() + PATIENCE_S
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as endpoint:
        endpoint.connect((tower.boards[name].address, 9999))
        endpoint.settimeout(MARK_S)
        for batch in range(PACKETS // 100):
            for number in range(100):
                endpoint.send(b"%d" % number)
            mark = b"%d %s" % (batch, MARK)
            answer = b""
            while answer != mark:
                assert time.monotonic() < until_s, "no echo comes any more"
                try:
                    answer = endpoint.recv(2048)
                except TimeoutError:  # lost, or still to come
                    endpoint.send(mark)
                else:
                    count += MARK not in answer
    return count


def test_power_cut_ends_a_board_without_a_goodbye_and_it_comes_back(tower8):
    session = start(tower8, "pi04", "echo here; cat")
    assert session.stdout is not None and session.stdout.readline() == "here\n"
    boots = tower8.state()["boards"]["pi04"]["boots"]

    tower8.fault("pi04", "crash")
    tower8.wait_until_on("pi04", boots + 1)

    try:
        with pytest.raises(subprocess.TimeoutExpired):
            session.wait(0.5)  # its peer hears nothing: no reset, no end
    finally:
        session.kill()
        session.communicate()


def test_power_cut_loses_what_was_not_synced(tower8):
    boots = tower8.state()["boards"]["pi05"]["boots"]
    tower8.run("pi05", "echo a > synced; sync -f .; echo b > unsynced")

    tower8.fault("pi05", "crash")
    tower8.wait_until_on("pi05", boots + 1)

    assert tower8.run("pi05", "ls").stdout.split() == ["synced"]
    assert tower8.run("pi05", "cat synced").stdout == "a\n"


def test_power_cut_brings_back_whole_what_was_deleted_and_not_synced(tower8):
    boots = tower8.state()["boards"]["pi05"]["boots"]
    tower8.run("pi05", "mkdir -p d/e && yes | head -c 100K > d/e/f && sync -f . && rm -r d")

    tower8.fault("pi05", "crash")
    tower8.wait_until_on("pi05", boots + 1)

    assert (
        tower8.run("pi05", "yes | head -c 100K | cmp - d/e/f && touch d/e/g && echo whole").stdout
        == "whole\n"
    )


def test_reboot_in_good_order_loses_nothing(tower8):
    boots = tower8.state()["boards"]["pi05"]["boots"]
    tower8.run("pi05", "echo b > unsynced; sudo reboot", check=False)
    tower8.wait_until_on("pi05", boots + 1)
    assert tower8.run("pi05", "cat unsynced").stdout == "b\n"


def test_power_stays_off_until_it_is_on(tower8):
    tower8.fault("pi06", "poweroff")
    tower8.wait_until(lambda board: board["power"] == "off", "pi06", "off")
    assert not connects(tower8, "pi06")

    tower8.fault("pi06", "poweron")
    tower8.wait_until_on("pi06")
    assert answers(tower8, "pi06")


def test_full_disk_refuses_to_write_and_has_room_again(tower8):
    write = "head -c 3M /dev/zero > big && sync -f ."
    tower8.fault("pi07", "fill", 1024)
    assert "No space left" in is_refused(tower8, "pi07", write)
    tower8.run("pi07", "rm big; head -c 500K /dev/zero > small")

    tower8.fault("pi07", "unfill")
    tower8.run("pi07", write)


def test_disk_is_read_only_and_writable_again(tower8):
    tower8.fault("pi08", "ro")
    assert "Read-only file system" in is_refused(tower8, "pi08", "touch x")
    assert not tower8.state()["boards"]["pi08"]["has_disk_failed"]

    tower8.fault("pi08", "rw")
    tower8.run("pi08", "touch x")


def test_disk_fails_under_open_files_until_the_next_boot(tower8):
    boots = tower8.state()["boards"]["pi08"]["boots"]
    tower8.run("pi08", "echo kept > note; sync -f .")
    writer = start(tower8, "pi08", "exec 3> open; echo here; cat >&3 && echo more >&3; cat note")
    assert writer.stdout is not None and writer.stdout.readline() == "here\n"

    tower8.fault("pi08", "ro")
    out, err = writer.communicate("text\n", timeout=120)

    assert "Read-only file system" in err
    assert out == "kept\n"  # it can still be read
    with pytest.raises(TowerError, match="disk has failed"):
        tower8.fault("pi08", "rw")
    tower8.fault("pi08", "crash")
    tower8.wait_until_on("pi08", boots + 1)
    assert tower8.run("pi08", "cat note; touch x").stdout == "kept\n"


def test_sudo_asks_for_a_password_or_takes_its_time(tower8):
    tower8.fault("pi01", "no-sudo")
    assert "password is required" in is_refused(tower8, "pi01", "sudo -n true")
    tower8.fault("pi01", "sudo")

    tower8.fault("pi01", "slow-sudo", 1.5)
    started_s = time.monotonic()
    tower8.run("pi01", "sudo -n true")
    assert time.monotonic() - started_s > 1.5

    tower8.fault("pi01", "sudo")
    tower8.run("pi01", "sudo -n true && ! grep sleep /etc/pam.d/sudo")


def test_users_key_is_a_strangers(tower8):
    tower8.fault("pi02", "wrong-key")
    assert "Permission denied" in is_refused(tower8, "pi02")
    tower8.fault("pi02", "right-key")
    tower8.run("pi02", "true")


def test_host_key_changes_and_changes_back(tower8):
    tower8.fault("pi03", "new-host-key")
    tower8.wait_until(lambda _: answers(tower8, "pi03"), "pi03", "listening")
    assert "REMOTE HOST IDENTIFICATION HAS CHANGED" in is_refused(tower8, "pi03")

    tower8.fault("pi03", "own-host-key")
    tower8.wait_until(lambda _: answers(tower8, "pi03"), "pi03", "listening")
    tower8.run("pi03", "true")


def test_sshd_stops_and_starts(tower8):
    tower8.fault("pi04", "stop-sshd")
    tower8.wait_until(lambda _: not connects(tower8, "pi04"), "pi04", "closed")
    assert "refused" in is_refused(tower8, "pi04")

    tower8.fault("pi04", "start-sshd")
    tower8.wait_until(lambda _: answers(tower8, "pi04"), "pi04", "open")


def test_connections_are_cut_and_new_ones_taken(tower8):
    session = start(tower8, "pi05", "echo here; cat")
    assert session.stdout is not None and session.stdout.readline() == "here\n"

    tower8.fault("pi05", "cut")

    # Its input stays open: the end of that would end it, too.
    assert session.wait(timeout=120) == 255
    session.communicate()
    tower8.run("pi05", "true")


def test_throttling_and_temperature_show(tower8):
    tower8.fault("pi06", "throttle", "0x50005")
    tower8.fault("pi06", "temperature", 81.5)
    shown = tower8.run("pi06", "vcgencmd get_throttled; vcgencmd measure_temp").stdout
    assert shown == "throttled=0x50005\ntemp=81.5'C\n"


@pytest.mark.parametrize(
    ("fault", "argument", "told"),
    [
        ("explode", None, "there are down, up"),
        ("loss", "lots", "expected a number"),
        ("loss", 120, "0 to 100"),
        ("freeze", 5, "takes no argument"),
        ("poweron", None, "on already"),
    ],
)
def test_wrong_requests_are_told_and_change_nothing(tower8, fault, argument, told):
    with pytest.raises(TowerError, match=told):
        tower8.fault("pi01", fault, argument)
    tower8.run("pi01", "true")


def test_unknown_board_is_told(tower8):
    with pytest.raises(TowerError, match="no board 'pi99'; there are pi01"):
        tower8.fault("pi99", "freeze")


def test_every_fault_is_explained():
    assert all(fault.text and fault.text[0].islower() for fault in FAULTS.values())


def test_board_that_is_not_up_yet_is_left_alone(tower8):
    """Until its boot has changed its root directory, a board's file system is the operator's."""
    tower8.fault("pi01", "poweroff")
    tower8.wait_until(lambda board: board["power"] == "off", "pi01", "off")
    tower8.fault("pi01", "poweron")
    with pytest.raises(TowerError, match="pi01 is (away|booting|ending), expected it to be on"):
        for _ in range(1000):  # it may be up before the first of these is heard
            tower8.fault("pi01", "no-sudo")
            tower8.fault("pi01", "crash")
            time.sleep(0.001)
