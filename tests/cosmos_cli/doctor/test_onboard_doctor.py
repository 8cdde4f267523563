"""What is looked at and measured on a machine: over played /proc and /sys, and once on this computer."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from harness.waiting import wait_until

from cosmos_cli.doctor.case import Case, Wants
from cosmos_cli.doctor.finding import HERE
from cosmos_cli.doctor.judge import judge
from cosmos_cli.doctor.probe import Responder, ask
from cosmos_cli.fleet.local import LocalConnection, LocalStream
from cosmos_cli.fleet.target import Target
from cosmos_cli.onboard import cpu_load, doctor, interfaces, timer_latency, udp_probe
from cosmos_cli.onboard.cpu_load import Moment, Task
from cosmos_cli.onboard.udp_probe import ANSWER, ASK, SILENCE_COUNT_MAX, Datagram

NOBODY = 65534


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


# Wake-ups


@pytest.mark.process
def test_wake_ups_are_measured_in_another_process() -> None:
    before = os.sched_getscheduler(0)

    told = timer_latency.wake_ups(count=5, rate_hz=500.0, policy="auto", priority=1)

    assert 0 <= told["p50_ms"] <= told["p99_ms"] <= told["max_ms"]
    assert (told["policy"] == "fifo") == (told["refusal"] is None)
    assert os.sched_getscheduler(0) == before


@pytest.mark.process
def test_normal_scheduling_is_not_refused_but_not_asked_for() -> None:
    told = timer_latency.wake_ups(count=2, rate_hz=1000.0, policy="normal", priority=1)

    assert (told["policy"], told["refusal"]) == ("normal", "not asked for")


# Who is busy


def moment(at_s: float, ticks: dict[int, int], **more: int) -> Moment:
    parents = {os.getpid(): 50, 50: 1, 60: os.getpid(), 70: 1, 80: 1, 1: 0}
    tasks = {
        pid: Task(name=f"p{pid}", parent=parents[pid], start=5, ticks=ticks.get(pid, 0))
        for pid in parents
    }
    cpu = {"idle": 0, "steal": 0} | more
    return Moment(at_s=at_s, tasks=tasks, cpu_ticks=cpu, swapped_pages=more.get("swapped", 0))


def test_share_of_others_is_told_without_our_own() -> None:
    second = cpu_load.TICKS_A_SECOND
    after = moment(2.0, {os.getpid(): second, 50: second, 60: second, 70: second, 80: 2 * second})

    told = cpu_load.compare(moment(0.0, {}), after)

    assert told["processors"] == pytest.approx(1.5)
    assert [(item["pid"], item["processors"]) for item in told["top"]] == [(80, 1.0), (70, 0.5)]


def test_process_that_took_a_dead_ones_number_is_left_out() -> None:
    before, after = moment(0.0, {70: 0}), moment(1.0, {70: 500})
    after.tasks[70] = Task(name="other", parent=1, start=6, ticks=500)

    assert cpu_load.compare(before, after)["processors"] == 0


def test_steal_is_a_share_of_all_time() -> None:
    told = cpu_load.compare(moment(0.0, {}), moment(1.0, {}, idle=150, steal=50))

    assert told["steal_share"] == 0.25


def test_counters_are_read_from_proc(tmp_path: Path) -> None:
    stat = "7 (a (b) c) S 1 7 7 0 -1 0 0 0 0 0 30 12 0 0 20 0 1 0 999 0 0"
    write(tmp_path / "7/stat", stat)
    write(tmp_path / "stat", "cpu  1 2 3 4 5 6 7 8 9\ncpu0 1\n")
    write(tmp_path / "vmstat", "pswpin 3\npswpout 4\nother 9\n")

    found = cpu_load.look(str(tmp_path))

    assert found.tasks == {7: Task(name="a (b) c", parent=1, start=999, ticks=42)}
    assert found.cpu_ticks["steal"] == 8
    assert found.swapped_pages == 7


# Interfaces


def test_only_the_connections_interface_is_told(tmp_path: Path) -> None:
    card = tmp_path / "class/net/eth0"
    for name, text in {"speed": "100\n", "duplex": "full\n", "mtu": "1500\n"}.items():
        write(card / name, text)
    write(card / "statistics/rx_errors", "3\n")
    write(card / "statistics/rx_packets", "1000\n")
    before = interfaces.interfaces(str(tmp_path), "eth0")
    write(card / "statistics/rx_errors", "5\n")

    (told,) = interfaces.interfaces(str(tmp_path), "eth0", before)

    assert (told["speed_mbit"], told["duplex"], told["mtu"]) == (100, "full", 1500)
    assert (told["errors"], told["new_errors"], told["packets"]) == (5, 2, 1000)
    assert (told["is_wireless"], told["saves_power"]) == (False, None)


def test_real_interfaces_that_are_up_are_told_when_the_connections_is_not_known(
    tmp_path: Path,
) -> None:
    net = tmp_path / "class/net"
    for name, is_real, state in (("eth0", 1, "up"), ("eth1", 1, "down"), ("docker0", 0, "up")):
        write(net / name / "operstate", state)
        if is_real:
            (net / name / "device").mkdir()
    (net / "eth0" / "wireless").mkdir()

    (told,) = interfaces.interfaces(str(tmp_path), None)

    assert (told["name"], told["is_wireless"]) == ("eth0", True)


def test_receive_drops_are_found_by_their_name(tmp_path: Path) -> None:
    write(
        tmp_path / "net/snmp",
        "Ip: A\nIp: 1\nUdp: InDatagrams NoPorts RcvbufErrors InErrors\nUdp: 1 2 33 4\n",
    )

    assert interfaces.receive_drops(str(tmp_path)) == 33
    assert interfaces.receive_drops(str(tmp_path / "nowhere")) is None


# The control group's quota


@pytest.mark.parametrize(
    ("own", "expected"),
    [("0::/a/b\n", 0.5), ("0::/a\n", 1.5), ("0::/\n", None), ("1:cpu:/x\n", None), ("", None)],
)
def test_smallest_quota_on_the_way_up_counts(
    tmp_path: Path, own: str, expected: float | None
) -> None:
    write(tmp_path / "a/cpu.max", "150000 100000\n")
    write(tmp_path / "a/b/cpu.max", "50000 100000\n")
    write(tmp_path / "cpu.max", "max 100000\n")

    assert doctor._cpu_quota(str(tmp_path), own) == expected


# Round trips

NONCE = b"n" * 16


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait for answers longer than a busy computer lets the thread wait that gives them."""
    monkeypatch.setattr(udp_probe, "ANSWER_TIMEOUT_S", 60.0)
    monkeypatch.setattr(udp_probe, "UNASKED_TIMEOUT_S", 60.0)


@pytest.mark.process
@pytest.mark.usefixtures("patient")
def test_round_trips_are_measured_both_ways() -> None:
    with Responder() as responder:
        told = udp_probe.round_trips("127.0.0.1", responder.port, responder.nonce, 10)

    assert (told["sent"], told["answered"], told["unasked"]) == (10, 10, 5)
    assert 0 < told["min_ms"] <= told["p50_ms"] <= told["max_ms"]
    assert abs(told["clock_offset_s"]) <= told["clock_uncertainty_s"] + 1e-3


@pytest.mark.process
def test_nobody_answers_a_stranger() -> None:
    with Responder() as responder:
        told = udp_probe.round_trips("127.0.0.1", responder.port, NONCE, 50)

        wait_until(lambda: responder.ignored == SILENCE_COUNT_MAX, lambda: str(responder.ignored))
    assert (told["sent"], told["answered"], told["p50_ms"]) == (SILENCE_COUNT_MAX, 0, None)


@pytest.fixture
def deaf_once() -> Iterator[int]:
    """Answers, but not the fifth datagram."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))

        def answer() -> None:
            while True:
                data, where = listener.recvfrom(2048)
                asked = Datagram.decode(data)
                if asked is None:
                    return
                if asked.sequence != 4:
                    reply = Datagram(nonce=asked.nonce, kind=ANSWER, sequence=asked.sequence)
                    listener.sendto(reply.encode(), where)

        thread = threading.Thread(target=answer, daemon=True)
        thread.start()
        yield listener.getsockname()[1]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(b"end", listener.getsockname())
        thread.join(10)
        assert not thread.is_alive()


@pytest.mark.process
@pytest.mark.usefixtures("patient")
def test_losses_are_counted(deaf_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(udp_probe, "ANSWER_TIMEOUT_S", 5.0)  # so long for the one that is lost
    monkeypatch.setattr(udp_probe, "UNASKED_TIMEOUT_S", 0.0)  # nobody sends any
    told = udp_probe.round_trips("127.0.0.1", deaf_once, NONCE, 10)

    assert (told["sent"], told["answered"]) == (10, 9)


def test_address_that_cannot_be_sent_to_is_an_error() -> None:
    told = udp_probe.round_trips("no.such.name.invalid", 9, NONCE, 3)

    assert told["error"]
    assert told["sent"] == 0


@pytest.mark.process
def test_responder_takes_another_port_when_the_wanted_one_is_taken() -> None:
    with Responder() as first, Responder(first.port) as second:
        assert second.is_port_taken
        assert second.port != first.port
        assert not first.is_port_taken


def test_datagrams_keep_what_they_carry() -> None:
    asked = Datagram(nonce=NONCE, kind=ASK, sequence=3, port=9, asked_s=1.5)

    assert Datagram.decode(asked.encode()) == asked
    assert Datagram.decode(asked.encode()[:-1]) is None
    assert Datagram.decode(b"x" * len(asked.encode())) is None


# All of it


class OrdinaryConnection(LocalConnection):
    """This computer, as a user who is nobody."""

    def open(self, command: str) -> LocalStream:
        return super().open(
            f"exec setpriv --reuid {NOBODY} --regid {NOBODY} --clear-groups"
            f" env -i PATH=/usr/bin:/bin HOME=/nonexistent sh -c {_quoted(command)}"
        )


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "'\\''") + "'"


def probed(connection: LocalConnection) -> dict[str, object]:
    wants = Wants()
    with Responder() as responder:
        return ask(connection, wants, responder)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cosmos_cli.doctor.probe.WAKE_UP_COUNT", 5)
    monkeypatch.setattr("cosmos_cli.doctor.probe.ROUND_TRIP_COUNT", 5)


@pytest.mark.process
@pytest.mark.usefixtures("quick")
def test_this_computer_can_be_probed_and_is_left_as_it_was(tmp_path: Path) -> None:
    target = Target(name="pi01", address="127.0.0.1", connection="local", root=str(tmp_path))

    told = probed(LocalConnection(target))
    findings = judge(Case.of("pi01", told, Wants()))

    assert {"system", "udp", "wake_up", "disk_write", "living"} <= {f.check for f in findings}
    assert list(tmp_path.iterdir()) == []


@pytest.mark.process
@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("is_allowed", [True, False])
def test_sudo_is_asked_unless_the_inventory_forbids_it(tmp_path: Path, is_allowed: bool) -> None:
    target = Target(
        name="pi01",
        address="127.0.0.1",
        connection="local",
        root=str(tmp_path),
        may_become_root=is_allowed,
    )

    facts = probed(LocalConnection(target))["facts"]

    assert isinstance(facts, dict)
    assert (facts["sudo"] is not None) is is_allowed


@pytest.mark.root
@pytest.mark.usefixtures("quick")
@pytest.mark.skipif(os.geteuid() != 0, reason="becomes another user")
@pytest.mark.skipif(not os.access("/usr/bin/python3", os.X_OK), reason="needs /usr/bin/python3")
def test_ordinary_user_without_a_home_can_be_probed() -> None:
    target = Target(
        name="pi01",
        address="127.0.0.1",
        connection="local",
        root="/nonexistent/cosmos",
        python="/usr/bin/python3",
    )

    told = probed(OrdinaryConnection(target))
    findings = {f.check: f for f in judge(Case.of("pi01", told, Wants()))}

    assert told["facts"]["user"]["id"] == NOBODY  # type: ignore[index]
    assert findings["environments"].remark.found.startswith("not set up yet")
    assert findings["disk_writable"].remark.found.startswith("nobody may not write in /")


@pytest.mark.process
@pytest.mark.usefixtures("quick")
def test_left_runs_and_half_made_environments_are_told(tmp_path: Path) -> None:
    write(tmp_path / "runs/0001-a-aabbccdd/agents/x.jsonl", "")
    write(tmp_path / "environments/whole/.complete", "")
    (tmp_path / "environments/half").mkdir()
    target = Target(name="pi01", address="127.0.0.1", connection="local", root=str(tmp_path))

    told = probed(LocalConnection(target))

    cosmos = told["cosmos"]
    assert isinstance(cosmos, dict)
    assert cosmos["runs"] == ["0001-a-aabbccdd"]
    assert sorted((e["name"], e["is_whole"]) for e in cosmos["environments"]) == [
        ("half", False),
        ("whole", True),
    ]
    assert Case.of(HERE, told, Wants()).is_here


def test_of_very_many_left_runs_the_newest_are_named_and_all_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COSMOS_STATE_DIR", f"{tmp_path}/state")
    names = [f"{number:04d}-a-aabbccdd" for number in range(60)]
    for age, name in enumerate(names):
        (tmp_path / "runs" / name).mkdir(parents=True)
        os.utime(tmp_path / "runs" / name, (1e9 + age, 1e9 + age))

    told = doctor._cosmos({"runs": f"{tmp_path}/runs", "state": f"{tmp_path}/state"})

    assert told["runs"] == names[10:]
    assert told["run_count"] == 60
