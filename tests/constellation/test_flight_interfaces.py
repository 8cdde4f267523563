"""The same guidance by every protocol and over every transport; and what becomes of software that is not as it should."""

import json
import math
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import tty
from pathlib import Path

import guided_program
import pytest
from harness.cosmos_command import CosmosCommand
from harness.waiting import wait_until
from test_flight_process import HZ, PATIENCE_S, Ship, patience  # noqa: F401 - a fixture

from madns_runtime.errors import BlamedError
from madns_runtime.hardware.kind_registry import prepare
from madns_runtime.plugin import isolation
from madns_runtime.plugin.device_view import ChannelForm, ChannelFrame
from madns_runtime.simulations.constellation.flight.asked_ticks import UNANSWERED_MAX
from madns_runtime.simulations.constellation.flight.interface.program import FlightProgram
from madns_runtime.simulations.constellation.flight.interface.socket_transports import (
    SocketLink,
    UdpLink,
    resolve_both,
)
from madns_runtime.simulations.constellation.flight.interface.transport import READ_BYTES
from madns_runtime.simulations.constellation.flight.process import ExternalFlight

pytestmark = pytest.mark.process

HERE = Path(__file__).parent
FLIGHT = HERE.parents[1] / "scenarios/flight"
WAYS = (
    ("json_lines", {"kind": "stdio"}),
    ("frames", {"kind": "pty"}),
    ("space_packets", {"kind": "tcp", "address": "127.0.0.1:0", "listen": True}),
    ("frames", {"kind": "udp", "local": "127.0.0.1:0"}),
    ("json_lines", {"kind": "unix", "path": "${name}.sock", "listen": True}),
    ("space_packets", {"kind": "stdio"}),
)
SCENARIO = {
    "name": "ways",
    "simulation": "constellation",
    "time": {"mode": "lockstep", "duration_s": 9},
    "parameters": {
        "epoch_utc": "2026-01-01T00:00:00Z",
        "propagator": {"kind": "scipy", "forces": ["two_body"]},
        "vehicles": [
            {
                "thruster": {"isp_s": 220, "propellant_kg": 5},
                "sensors": {"gnss": {"rate_hz": 10}},
            }
        ],
    },
}
SETTINGS = {"a_m": 7_160_000, "tolerance_m": 0.01, "lead_s": 3}


def rule(protocol, transport, **rest):
    """Return the rule of the program above, which finds its way by its command and its environment."""
    return {
        "command": [sys.executable, str(HERE / "guided_program.py"), protocol]
        + [transport["kind"], "${address}"],
        "settings": SETTINGS,
        "answer_s": 60,
        "interface": {"transport": transport, "protocol": protocol, "start_s": 60},
        **rest,
    }


def records(run, name):
    """Return the rows of an agent's commands."""
    lines = (run / "agents" / name / "commands.jsonl").read_text().splitlines()
    return [row for row in map(json.loads, lines) if isinstance(row, list)]


def test_the_same_guidance_gives_the_same_maneuvers_to_the_bit_by_every_way(tmp_path):
    names = [f"agent-{number:02d}" for number in range(1, len(WAYS) + 1)]
    rules = [rule(*way, agents=[name]) for name, way in zip(names, WAYS, strict=True)]
    if shutil.which("cc") is not None:
        names.append("in-c")
        flags = ["-std=c99", "-O2", "-ffp-contract=off"]
        program = tmp_path / "in-c"
        subprocess.run(["cc", *flags, "-o", program, FLIGHT / "hold_frames.c", "-lm"], check=True)
        rules.append({**rule("frames", {"kind": "stdio"}), "command": ["./${name}"]})
    orbits = [{"name": f"SAT-{name}", "altitude_km": 780, "i_deg": 56} for name in names]
    scenario = {**SCENARIO, "agents": {"count": len(names), "names": names, "tick_hz": 10}}
    scenario["parameters"] |= {"satellites": {"keplerian": orbits}, "flight": rules}
    (tmp_path / "ways.yaml").write_text(json.dumps(scenario))

    done = CosmosCommand(tmp_path)("run", "ways.yaml", "--quiet", "--no-report")

    assert done.returncode == 0, done.stderr
    run = tmp_path / "runs/0001-ways"
    flown = {name: records(run, name) for name in names}
    assert len(flown["agent-01"]) == 2
    assert set(map(str, flown.values())) == {str(flown["agent-01"])}
    agents = json.loads((run / "run.json").read_text())["simulation"]["agents"]
    for name in names:
        told = agents[name]["flight"]
        assert told["answers"] == 90, name
        # Who needs longer to end than it is given, on a busy machine, is asked to.
        assert told["exit_code"] in (0, -signal.SIGTERM), name
        assert not any(told["interface"]["faults"].values()), name
    lines = (run / "host/maneuvers.jsonl").read_text().splitlines()
    rows = [row for row in map(json.loads, lines) if isinstance(row, list)]
    executed = {name: [row[6:10] for row in rows if row[1] == name] for name in names}
    assert set(map(str, executed.values())) == {str(executed["agent-01"])}


def answered(ship, count):
    """Tick in real time until so many ticks were answered."""
    software = ship.agent._cockpit._software
    ship.run_until(lambda: software._counts["answers"] >= count)


def played(protocol, read, write):
    """Play flight software in a thread."""

    def work():
        guidance = guided_program.Guidance()
        guidance.settings = dict(SETTINGS)
        software = guided_program.PROTOCOLS[protocol](guidance)
        try:
            while data := read():
                for answer in software.feed(data):
                    write(answer)
        except OSError:
            return

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    return thread


def attached(transport, protocol="frames", **rest):
    interface = {"transport": transport, "protocol": protocol, "start_s": 20.0, **rest}
    return {"interface": interface, "command": None, "settings": SETTINGS}


class Attached(Ship):
    """An agent whose flight software runs already."""

    process = None

    def __exit__(self, *_error):
        self.summary = self.agent.finish()["flight"]


def test_software_behind_a_serial_port_is_attached_to(tmp_path):
    main, other = os.openpty()
    tty.setraw(other)
    far = played("frames", lambda: os.read(main, 65536), lambda data: os.write(main, data))
    transport = {"kind": "serial", "port": os.ttyname(other), "baud_rate": 115_200}

    with Attached(tmp_path, None, flight=attached(transport), is_lockstep=False) as ship:
        answered(ship, 20)

    os.close(other)
    far.join()  # before its descriptor's number may be somebody else's
    os.close(main)
    assert ship.summary["interface"]["bytes_received"] >= 20 * 30
    rows = ship.context.records["flight_answers"]
    assert [row[1] for row in rows[:3]] == [0.0, 0.1, 0.2]
    assert all(0.0 < row[2] < 60e6 for row in rows)


@pytest.mark.parametrize("kind", ["tcp", "unix"])
def test_an_agent_connects_to_software_that_listens(tmp_path, kind):
    if kind == "tcp":
        listener = socket.create_server(("127.0.0.1", 0))
        transport = {"kind": "tcp", "address": f"127.0.0.1:{listener.getsockname()[1]}"}
    else:
        listener = socket.socket(socket.AF_UNIX)
        listener.bind(str(tmp_path / "a.sock"))
        listener.listen()
        transport = {"kind": "unix", "path": "a.sock"}

    with Attached(tmp_path, None, flight=attached(transport)) as ship, listener:
        peer = []

        def accept_and_play():
            one, _ = listener.accept()
            peer.append(one)
            played("frames", lambda: one.recv(65536), one.sendall)

        threading.Thread(target=accept_and_play, daemon=True).start()
        ship.run(10)

    assert ship.summary["answers"] == 10
    assert "exit_code" not in ship.summary and "answer_s_max" not in ship.summary
    peer[0].close()


def test_a_clock_of_its_own_is_estimated_and_answers_are_taken_when_they_come(
    tmp_path, monkeypatch
):
    flight = "madns_runtime.simulations.constellation.flight"
    for module in ("process", "interface.arrival_thread", "interface.transport"):
        # Or what is taken late on a busy machine would in part be taken for drift.
        monkeypatch.setattr(f"{flight}.{module}.monotonic", lambda: 0.0)
    frames = guided_program.Frames(None)
    listener = socket.create_server(("127.0.0.1", 0))
    transport = {"kind": "tcp", "address": f"127.0.0.1:{listener.getsockname()[1]}"}
    flight = attached(transport, clock="own")
    with Attached(tmp_path, None, flight=flight, is_lockstep=False) as ship:
        software = ship.agent._cockpit._software
        ship.run(1)
        board, _ = listener.accept()
        board.settimeout(20.0)
        for number in range(200):
            ship.context.clock_s = 0.1 * number
            # 4 % fast, started long ago, and unasked.
            board_us = round((50.0 + 0.1 * number * 1.04) * 1e6)
            board.sendall(frames.wrap(136, 0.0, board_us.to_bytes(8, "little")))
            ship.run_until(lambda n=number: software._counts["answers"] > n)
            ship._next = number + 1
        board.close()
        listener.close()
        software._link.transport.is_closed = False

    assert ship.summary["interface"]["clock_drift_ppm"] == pytest.approx(40_000, abs=1.0)
    assert ship.context.records["flight_clock"]
    assert "flight_answers" not in ship.context.records


class FakeDevice:
    """A serial line, of which the far end is flight software that answers at once."""

    name = "line"

    def __init__(self, **settings):
        program = prepare("serial", {"port": "/dev/ttyUSB0", "framing": "raw", **settings}, HERE)
        self.channels = {channel.name: channel for channel in program.channels}
        guidance = guided_program.Guidance()
        guidance.settings = dict(SETTINGS)
        self.software = guided_program.Frames(guidance)
        self.waiting = []

    def write(self, channel, value, *, due_s=None):
        assert channel == "sent"
        self.waiting += self.software.feed(value)

    def form_of(self, channel):
        return ChannelForm("", 0, self.channels[channel].is_line)

    def frames(self, channel):
        assert channel == "received"
        found, self.waiting = self.waiting, []
        return [ChannelFrame(value, number, 0.002) for number, value in enumerate(found)]


@pytest.mark.parametrize("is_lockstep", [True, False])
def test_software_behind_a_device_of_the_run(tmp_path, is_lockstep):
    flight = attached({"kind": "device", "device": "line"})
    devices = {"line": FakeDevice()}
    ship = Attached(tmp_path, None, flight=flight, is_lockstep=is_lockstep, hardware=devices)
    with ship:
        ship.run(10)

    assert ship.summary["answers"] == 10
    assert len(ship.context.records["flight_answers"]) == 10 * (not is_lockstep)
    with pytest.raises(BlamedError, match="this agent's hardware, other; got 'line'"):
        Attached(tmp_path, None, flight=flight, hardware={"other": FakeDevice()})


@pytest.mark.parametrize("protocol", ["json_lines", "frames", "space_packets"])
def test_software_behind_a_device_that_takes_the_ends_of_lines_is_refused(tmp_path, protocol):
    flight = attached({"kind": "device", "device": "line"}, protocol)
    told = f"device line: expected bytes as they come, among which {protocol} finds .*framing: raw"
    for framing in ("lines", "nmea"):
        with pytest.raises(BlamedError, match=told):
            Attached(tmp_path, None, flight=flight, hardware={"line": FakeDevice(framing=framing)})
    # In frames of any bytes packets may be.
    for framing in ("cobs", "length_prefixed"):
        device = FakeDevice(framing=framing)
        device.software.feed = lambda data: []
        Attached(tmp_path, None, flight=flight, hardware={"line": device}).agent.abandon()


def test_times_of_answers_name_the_tick_that_does_the_step(tmp_path):
    flight = attached({"kind": "device", "device": "line"}) | {"rate_hz": 5.0 * HZ}
    devices = {"line": FakeDevice()}
    with Attached(tmp_path, None, flight=flight, is_lockstep=False, hardware=devices) as ship:
        ship.run(4)

    told = ship.context.records["flight_answers"]
    assert [(tick, round(t_s * HZ, 9)) for tick, t_s, _ in told] == [
        (math.ceil(step / 5), step / 5) for step in range(len(told))
    ]
    assert len(told) > 10


def test_what_software_that_fell_silent_was_not_told_is_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(ExternalFlight, "last_answers_s", 0.0)
    device, flight = FakeDevice(), attached({"kind": "device", "device": "line"})
    device.software.feed = lambda data: []
    with Attached(
        tmp_path, None, flight=flight, is_lockstep=False, hardware={"line": device}
    ) as ship:
        ship.run(UNANSWERED_MAX)
        ship.agent._cockpit._software.receive(None)
        ship.run(1)

    assert (ship.summary["ticks_skipped"], ship.summary["mail_unsent"]) == (1, 1)


def test_of_a_flood_through_a_device_the_newest_bytes_are_taken(tmp_path):
    device = FakeDevice()
    flight = attached({"kind": "device", "device": "line"})
    with Attached(
        tmp_path, None, flight=flight, is_lockstep=False, hardware={"line": device}
    ) as ship:
        ship.run(5)
        device.waiting = [b"\xff" * 4095 + b"\0"] * 100 + device.waiting
        ship.run(5)

    interface = ship.summary["interface"]
    assert interface["floods"] == 1
    assert interface["bytes_dropped"] >= 100 * 4096 - 65_536
    assert ship.summary["answers"] == 10


def test_datagrams_go_to_a_place_that_is_known(tmp_path):
    board = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    board.bind(("127.0.0.1", 0))
    remote = f"127.0.0.1:{board.getsockname()[1]}"
    transport = {"kind": "udp", "local": "127.0.0.1:0", "remote": remote}
    vehicle = []

    def read():
        data, sender = board.recvfrom(65536)
        vehicle.append(sender)
        return data

    with Attached(tmp_path, None, flight=attached(transport)) as ship:
        played("frames", read, lambda data: board.sendto(data, vehicle[-1]))
        ship.run(10)

    assert ship.summary["answers"] == 10
    board.close()


def test_of_many_datagrams_at_once_the_rest_waits_for_the_next_look():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as board:
        board.bind(("127.0.0.1", 0))
        link = UdpLink("udp", ("127.0.0.1", 0), board.getsockname(), family=socket.AF_INET)
        link.open()
        for number in range(4):
            board.sendto(bytes([number]) * 30_000, ("127.0.0.1", int(link.address.split(":")[1])))

        looks = [link.receive() for _ in range(3)]
        link.close()

    assert [len(one or b"") for one in looks] == [90_000, 30_000, 0]
    assert len(looks[0]) < READ_BYTES + 30_000


@pytest.fixture
def lossy():
    """Return a function that plays software over UDP that answers some ticks, and returns the rule of flight for it."""
    board = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    board.bind(("127.0.0.1", 0))
    threads = []

    def play(answers):
        def work():
            while data := board.recv(65536):
                told = json.loads(data)
                if "t_s" in told and answers(round(told["t_s"] * HZ)):
                    board.sendto(b'{"t_s":%r}\n' % told["t_s"], vehicle["at"])

        def first_of_all():
            _, vehicle["at"] = board.recvfrom(65536)  # the setup
            work()

        vehicle = {}
        threads.append(threading.Thread(target=first_of_all, daemon=True))
        threads[0].start()
        remote = f"127.0.0.1:{board.getsockname()[1]}"
        return attached({"kind": "udp", "local": "127.0.0.1:0", "remote": remote}, "json_lines")

    yield play
    threads[0].join(20)
    board.close()


def test_software_that_was_cut_off_for_very_many_ticks_is_sent_ticks_again(tmp_path, lossy):
    flight = lossy(lambda tick: not 5 <= tick < 5 + 2 * UNANSWERED_MAX) | {"answer_s": 0.25}
    with Attached(tmp_path, None, flight=flight, is_lockstep=False) as ship:
        answered(ship, 30)
        summary = ship.agent._cockpit._software._interface_summary()

    assert summary["ticks_unanswered"] >= UNANSWERED_MAX
    assert [text for _, text in ship.context.logs if "are sent but one every 0.25 s" in text]


def test_lines_that_name_their_tick_are_for_it_though_datagrams_are_lost(tmp_path, lossy):
    flight = lossy(lambda tick: tick % 3 != 1)
    with Attached(tmp_path, None, flight=flight, is_lockstep=False) as ship:
        answered(ship, 20)
        ship._next += -ship._next % 3  # one that is answered
        answered(ship, 21)
        summary = ship.agent._cockpit._software._interface_summary()

    assert summary["ticks_unanswered"] >= 9
    ticks = [row[0] for row in ship.context.records["flight_answers"]]
    assert {tick % 3 for tick in ticks} == {0, 2}


def test_lines_without_a_time_are_carried_out_though_their_ticks_were_given_up(tmp_path):
    board = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    board.bind(("127.0.0.1", 0))
    board.settimeout(20)
    local, remote = "127.0.0.1:0", f"127.0.0.1:{board.getsockname()[1]}"
    transport = {"kind": "udp", "local": local, "remote": remote}
    flight = {**attached(transport, "json_lines"), "answer_s": 0.05}
    with Attached(tmp_path, None, flight=flight, is_lockstep=False) as ship:
        ship.run(1)
        _, sender = board.recvfrom(65536)
        board.sendto(b"{}\n", sender)
        answered(ship, 1)
        ship.run(10)
        time.sleep(0.1)  # too late by now
        count = ship._next - 1
        for number in range(count):
            board.sendto(b'{"estimate":{"number":%d}}\n' % number, sender)
        estimates = ship.context.records["estimates"]
        ship.run_until(lambda: len(estimates) == count)
    board.close()

    assert [row[-1] for row in estimates] == list(range(count))
    counted = ship.summary["answers"] + ship.summary["interface"]["answers_unasked"]
    assert counted == count + 1


def test_software_that_never_comes_is_named(tmp_path):
    transport = {"kind": "tcp", "address": "127.0.0.1:0", "listen": True}
    flight = attached(transport, start_s=0.2)
    ship = Attached(tmp_path, None, flight=flight)

    words = (
        r"expected somebody at tcp 127.0.0.1:0 within 0.2 s \(parameters.flight.interface.start_s\), "
        r"waiting for it to connect to 127.0.0.1:[1-9]\d*$"
    )
    with pytest.raises(BlamedError, match=words):
        ship.run(1)


@pytest.mark.parametrize(
    ("transport", "words"),
    [
        ({"kind": "unix", "path": "x.sock"}, "it to take a connection at .*x.sock$"),
        ({"kind": "udp", "local": "127.0.0.1:0"}, r"its first datagram at 127.0.0.1:[1-9]\d*$"),
    ],
)
def test_what_was_waited_for_is_named(tmp_path, transport, words):
    ship = Attached(tmp_path, None, flight=attached(transport, start_s=0.1))

    with pytest.raises(BlamedError, match=f"waiting for {words}"):
        ship.run(1)


def later(work, wait_s=0.3):
    """Do something a little later."""
    thread = threading.Timer(wait_s, work)
    thread.daemon = True
    thread.start()


@pytest.mark.parametrize("is_lockstep", [True, False], ids=["lockstep", "real time"])
def test_the_time_for_software_to_be_there_begins_when_it_is_looked_for(
    tmp_path, monkeypatch, is_lockstep
):
    others_s = [0.0]
    place = "madns_runtime.simulations.constellation.flight.interface.link.monotonic"
    monkeypatch.setattr(place, lambda: time.monotonic() + others_s[0])
    listener = socket.socket(socket.AF_UNIX)
    transport = {"kind": "unix", "path": "a.sock"}

    def come():
        listener.bind(str(tmp_path / "a.sock"))
        listener.listen()
        one, _ = listener.accept()
        played("frames", lambda: one.recv(65536), one.sendall)

    flight = attached(transport, start_s=60.0)
    with Attached(tmp_path, None, flight=flight, is_lockstep=is_lockstep) as ship:
        others_s[0] = 3600.0  # in which the others were set up
        later(come)
        ship.run_until(lambda: ship.agent._cockpit._software._counts["answers"])
    listener.close()

    assert ship.summary["answers"] >= 1


def test_in_lockstep_a_program_has_its_time_to_come_without_waits_for_a_processor(tmp_path):
    transport = {"kind": "unix", "path": "a.sock", "listen": True}
    flight = rule("space_packets", transport)
    flight["command"] = ["sh", "-c", 'sleep 1; exec "$@"', "sh", *flight["command"]]
    flight["interface"]["start_s"] = 0.1
    with Ship(tmp_path, flight["command"], flight=flight) as ship:
        link = ship.agent._cockpit._software._link
        link.stopwatch = lambda: lambda: 0.0  # it never had a processor
        ship.run(1)

    assert ship.summary["answers"] == 1


def test_a_program_that_sleeps_too_long_in_lockstep_had_time_of_its_own(tmp_path):
    transport = {"kind": "unix", "path": "a.sock", "listen": True}
    flight = {**attached(transport, start_s=0.2), "command": ["sleep", "600"]}
    ship = Ship(tmp_path, flight["command"], flight=flight)

    with pytest.raises(BlamedError, match=r"within 0.2 s of its own \(.*waiting for it to connect"):
        ship.run(1)


@pytest.mark.parametrize(
    ("transport", "words"),
    [
        ({"kind": "tcp", "address": "127.0.0.1:x"}, "transport.address: expected HOST:PORT"),
        ({"kind": "unix", "path": "x" * 200}, "expected a path of at most 107 bytes, got 2"),
        ({"kind": "unix", "path": "no/such", "listen": True}, "cannot be listened at"),
        ({"kind": "udp", "local": "192.0.2.1:0"}, "cannot be received at"),
        ({"kind": "serial", "port": "/dev/no-such"}, "serial /dev/no-such: cannot be opened"),
    ],
)
def test_an_address_that_cannot_be_is_named_and_keeps_no_socket(tmp_path, transport, words):
    before = open_sockets()

    with pytest.raises(BlamedError, match=words) as held:  # and with it all that its frames hold
        Attached(tmp_path, None, flight=attached(transport)).run(1)

    assert open_sockets() <= before, held.value


def open_sockets():
    """Return the sockets that this process holds."""
    links = (os.path.realpath(f"/proc/self/fd/{each}") for each in os.listdir("/proc/self/fd"))
    return {link for link in links if "socket:" in link}


def test_a_program_that_ends_before_it_connects_is_named_with_its_end(tmp_path):
    transport = {"kind": "unix", "path": "x.sock", "listen": True}
    flight = {**attached(transport), "command": ["sh", "-c", "echo no idea >&2; exit 3"]}
    ship = Ship(tmp_path, flight["command"], flight=flight)

    with pytest.raises(BlamedError, match=r"ended with exit code 3 .*'no idea'"):
        ship.run(1)


def test_a_peer_that_closes_its_end_is_named(tmp_path):
    listener = socket.create_server(("127.0.0.1", 0))
    transport = {"kind": "tcp", "address": f"127.0.0.1:{listener.getsockname()[1]}"}
    ship = Attached(tmp_path, None, flight=attached(transport), is_lockstep=False)
    ship.run(1)
    listener.accept()[0].close()
    listener.close()

    with pytest.raises(BlamedError, match=r"tcp 127.0.0.1:\d+ closed its end before"):
        ship.run_until(lambda: False)


def test_one_that_hangs_in_lockstep_is_named_and_killed(tmp_path):
    transport = {"kind": "pty"}
    flight = attached(transport) | {"answer_s": 0.05}
    command = [sys.executable, "-c", "import os, time; os.open('${pty}', 2); time.sleep(600)"]
    flight["command"] = command
    ship = Ship(tmp_path, None, flight=flight)

    with pytest.raises(BlamedError, match=r"the answer to the tick at 0 s within 0\.05 s"):
        ship.run(1)

    assert not Path(f"/proc/{ship.process.pid}").exists()


@pytest.mark.parametrize("is_lockstep", [True, False])
def test_one_that_prints_between_its_frames_is_told_what_came(tmp_path, is_lockstep):
    flight = attached({"kind": "stdio"})
    flight["command"] = ["sh", "-c", r"printf 'debug\000\n'; cat > /dev/null"]
    ship = Ship(tmp_path, None, flight=flight, is_lockstep=is_lockstep)
    told = r"; it said what was no good packet: corrupt \d+"
    software = ship.agent._cockpit._software
    if is_lockstep:
        with pytest.raises(BlamedError, match=told):
            ship.give_up_once(lambda: software._protocol.faults["corrupt"]).run(1)
        return
    ship.run(1)
    # It is told once, with what came by then: in that tick, or since.
    wait_until(lambda: software._protocol.faults["corrupt"] or software._link._thread._found)
    ship.run_until(lambda: any(re.search(told, text) for _, text in ship.context.logs))
    ship.agent.finish()


def test_one_that_floods_costs_no_tick_and_is_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(FlightProgram, "patience_s", 0.3)  # it never ends by itself
    flight = attached({"kind": "stdio"})
    flight["command"] = [
        sys.executable,
        "-c",
        "import os\nwhile True: os.write(1, bytes(range(1, 256)) * 64 + b'\\0')",
    ]
    with Ship(tmp_path, None, flight=flight, is_lockstep=False) as ship:
        software = ship.agent._cockpit._software
        ship.run_until(lambda: software._link.transport.counts["floods"] > 3)

    told = ship.summary["interface"]
    assert told["faults"]["corrupt"] + told["faults"]["overlong"] > 3
    assert ship.summary["answers"] == 0


def test_what_cannot_be_ends_the_agent_with_blame(tmp_path):
    software = guided_program.Frames(None)
    told = software.wrap(129, 0.0, bytes(32) + b"\x07" + bytes(7)) + software.wrap(
        136, 0.0, bytes(8)
    )
    flight = attached({"kind": "stdio"})
    program = tmp_path / "program.py"
    program.write_text(f"""
import os, sys, time
sys.path.insert(0, {str(Path(guided_program.__file__).parent)!r})
from guided_program import Frames
frames = Frames(None)
while 7 not in [number for number, *_ in frames.cut(os.read(0, 65536))]:  # the end of what a tick reports
    pass
os.write(1, {told!r})
time.sleep(60)  # until it is ended
""")
    flight["command"] = [sys.executable, str(program)]
    ship = Ship(tmp_path, None, flight=flight)

    with pytest.raises(BlamedError, match=r"one of inertial, rtn, body, got 'number 7'"):
        ship.run(1)


def test_a_protocol_of_ones_own_is_bytes_in_and_out(tmp_path):
    (tmp_path / "own.py").write_text(
        """
from madns_runtime.simulations.constellation.flight.interface.answers import FlightAnswer


class Own:
    answers_by_time = False

    def setup(self, setup):
        return []

    def tick(self, tick):
        return [b"%r\\n" % tick.t_s]

    def feed(self, data):
        return [FlightAnswer(estimate={"t_s": float(line)}) for line in data.split()]
"""
    )
    flight = attached({"kind": "stdio"}, "own.py:Own") | {"command": ["cat"]}

    with Ship(tmp_path, None, flight=flight) as ship:
        ship.run(5)

    assert ship.context.records["estimates"] == [(n, n / HZ) for n in range(5)]


OWN = """
from madns_runtime.simulations.constellation.flight.interface.answers import FlightAnswer


class Own:
    answers_by_time = False
    faults = 3

    def setup(self, setup):
        return [b"S\\n"]

    def tick(self, tick):
        return [b"T\\n"]

    def feed(self, data):
        return [FlightAnswer() for _ in range(data.count(b"\\n"))]


class Wrong(Own):
    def METHOD(self, given):
        BODY
"""
TALK = [
    sys.executable,
    "-c",
    "import sys\nsys.stdin.readline()  # the setup\nfor line in sys.stdin: print('A', flush=True)",
]


@pytest.mark.parametrize(
    ("method", "body", "told"),
    [
        ("feed", "return None", "Wrong.feed: expected a list of FlightAnswer, got None"),
        ("feed", "return ['x']", r"Wrong.feed: expected a list of FlightAnswer, got \['x'\]"),
        ("feed", "raise ValueError('odd')", r"Wrong.feed raised ValueError: odd \(own.py:2\d\)"),
        *[
            (
                "feed",
                f"return [FlightAnswer({part}={given})]",
                rf"Wrong.feed: expected FlightAnswer.{part} to be",
            )
            for part, given in (
                ("t_s", "'now'"),
                ("commands", "None"),
                ("commands", "('burn',)"),
                ("sends", "(('agent-02', 1, 2),)"),
                ("logs", "('hello',)"),
                ("board_us", "'1'"),
                ("fault", "None"),
                ("source", "'text'"),
            )
        ],
        ("feed", "raise KeyboardInterrupt", r"Wrong.feed raised KeyboardInterrupt \(own.py:2\d\)"),
        ("__init__", "pass", r"interface.protocol: own.py:Wrong: making it, .* raised TypeError"),
        ("tick", "return 'T'", "Wrong.tick: expected a list of bytes, got 'T'"),
        ("tick", "return b'T'", "Wrong.tick: expected a list of bytes, got b'T'"),
        ("setup", "return {}['x']", r"Wrong.setup raised KeyError: 'x' \(own.py:2\d\)"),
    ],
)
def test_what_a_protocol_of_ones_own_does_wrong_is_told_by_its_name(
    tmp_path, method, body, told, monkeypatch
):
    # As in an agent's process.
    monkeypatch.setattr(isolation, "is_interruption", lambda error: False)
    (tmp_path / "own.py").write_text(OWN.replace("METHOD", method).replace("BODY", body))
    flight = attached({"kind": "stdio"}, "own.py:Wrong") | {"command": TALK}

    with pytest.raises(BlamedError, match=told):
        Ship(tmp_path, None, flight=flight).run(3)


def test_what_a_protocol_of_ones_own_does_wrong_with_the_last_answers_is_told(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(ExternalFlight, "last_answers_s", PATIENCE_S)
    body = "if self.is_odd: raise ValueError('odd')\n        return Own.feed(self, given)"
    text = OWN.replace("METHOD", "feed").replace("BODY", body)
    (tmp_path / "own.py").write_text(text.replace("faults = 3", "is_odd = False"))
    flight = attached({"kind": "stdio"}, "own.py:Wrong") | {"command": TALK}

    with Ship(tmp_path, None, flight=flight, is_lockstep=False) as ship:
        ship.run(1)
        ship.agent._cockpit._software._protocol._protocol.is_odd = True

    told = "the last answers: Wrong.feed raised ValueError: odd (own.py:21)"
    assert [text for level, text in ship.context.logs if level == "error"] == [told]


@pytest.mark.parametrize("faults", ["faults = 3", "faults = {'odd': float('nan'), 'even': True}"])
def test_faults_of_a_protocol_of_ones_own_that_are_no_counts_are_left_out(tmp_path, faults):
    text = OWN.partition("class Wrong")[0].replace("faults = 3", faults)
    (tmp_path / "own.py").write_text(text)
    flight = attached({"kind": "stdio"}, "own.py:Own") | {"command": TALK}
    with Ship(tmp_path, None, flight=flight) as ship:
        ship.run(2)

    assert ship.summary["answers"] == 2
    assert ship.summary["interface"]["faults"] == {}


def test_a_socket_that_somebody_listens_at_is_left_to_him_and_one_left_behind_gives_way(tmp_path):
    transport = {"kind": "unix", "path": "a.sock", "listen": True}
    first = socket.socket(socket.AF_UNIX)
    first.bind(str(tmp_path / "a.sock"))
    first.listen()

    with pytest.raises(BlamedError, match="cannot be listened at: another program listens there"):
        Attached(tmp_path, None, flight=attached(transport))
    assert (tmp_path / "a.sock").is_socket()
    first.close()
    with Attached(tmp_path, None, flight=attached(transport)):
        assert (tmp_path / "a.sock").is_socket()
    assert not (tmp_path / "a.sock").exists()


class BoundToItsGoal(socket.socket):
    """A socket to which the kernel gives the port that it connects to, as it may where nobody listens there."""

    def connect_ex(self, place):
        self.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.bind(place)
        return super().connect_ex(place)


def test_an_agent_does_not_take_its_own_end_of_a_connection_for_software(monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as one:
        place = one.getsockname()
    link = SocketLink("tcp", socket.AF_INET, place, listens=False)
    link.open()
    with monkeypatch.context() as patched:
        patched.setattr(socket, "socket", BoundToItsGoal)
        link.push()  # begins to connect
    link.push()
    assert not link.is_ready

    with socket.create_server(place) as software:  # whose port is free
        wait_until(lambda: link.push() or link.is_ready, "a connection to the software")
        software.settimeout(PATIENCE_S)
        software.accept()[0].close()
    link.close()


@pytest.mark.parametrize(
    ("local", "remote"), [("localhost:0", "127.0.0.1:9"), ("127.0.0.1:0", "localhost:9")]
)
def test_a_name_that_stands_for_both_kinds_of_addresses_fits_either(local, remote):
    family, ours, theirs = resolve_both(local, remote)

    assert family == socket.AF_INET
    assert (ours[0], theirs[0]) == ("127.0.0.1", "127.0.0.1")
    with pytest.raises(BlamedError, match="same kind as local"):
        resolve_both("127.0.0.1:0", "[::1]:9")
