"""A run in real time whose flight software is late, mute, deaf, noisy, killed or there twice: each is named or counted."""

import contextlib
import json
import os
import socket
import subprocess
import sys
import threading
import time
import tty
from pathlib import Path

import guided_program
import psutil
import pytest
from harness.cosmos_command import LOOSE, CosmosCommand
from harness.ports import free_port
from harness.waiting import wait_until

pytestmark = pytest.mark.process

HERE = Path(__file__).parent
DURATION_S = 8
HZ = 10
TICKS = DURATION_S * HZ
PEERS = ("deaf", "late", "killed", "noisy", "flooding", "twice", "halves", "hanging", "well")


def is_connected(pid):
    """Return whether a process has a connection over TCP."""
    with contextlib.suppress(psutil.Error):
        return any(
            one.status == psutil.CONN_ESTABLISHED for one in psutil.Process(pid).net_connections()
        )
    return False


def rule(name, transport, protocol="frames", **rest):
    interface = {"transport": transport, "protocol": protocol, "start_s": 60}
    settings = {"a_m": 7_160_000, "tolerance_m": 0.01, "lead_s": 3}
    return {"agents": [name], "interface": interface, "settings": settings, "answer_s": 5, **rest}


@contextlib.contextmanager
def unheard():
    """Go on where nothing comes; where nobody listens yet, which is told at once, after a moment."""
    try:
        yield
    except TimeoutError:
        return
    except OSError:
        time.sleep(0.02)


class Peers:
    """All flight software of a run, in threads of this process and processes of its own."""

    def __init__(self, folder):
        self.folder = folder
        self.is_over = threading.Event()
        self.seen = {}
        self.processes = []
        self.threads = []
        self.closing = contextlib.ExitStack()
        self.late_port, self.killed_port = free_port(), free_port()
        self.twice_port, self.well_port = free_port(), free_port(kind=socket.SOCK_DGRAM)
        self.noisy_port = free_port(kind=socket.SOCK_DGRAM)
        self.deaf = self.closing.enter_context(socket.create_server(("127.0.0.1", 0)))
        self.flooding = self.closing.enter_context(socket.socket(socket.AF_UNIX))
        self.flooding.bind(str(folder / "flood.sock"))
        self.flooding.listen()
        self.line, self.far_end = os.openpty()
        tty.setraw(self.far_end)

    def rules(self):
        here = "127.0.0.1"
        hang = "import os, time; os.open('${pty}', os.O_RDWR | os.O_NOCTTY); time.sleep(600)"
        udp = {"kind": "udp", "local": f"{here}:{self.noisy_port}"}
        return [
            rule("deaf", {"kind": "tcp", "address": f"{here}:{self.deaf.getsockname()[1]}"}),
            rule("late", {"kind": "tcp", "address": f"{here}:{self.late_port}"}),
            rule(
                "killed", {"kind": "tcp", "address": f"{here}:{self.killed_port}", "listen": True}
            ),
            rule("noisy", udp, "space_packets"),
            rule("flooding", {"kind": "unix", "path": "flood.sock"}, "space_packets"),
            rule("twice", {"kind": "tcp", "address": f"{here}:{self.twice_port}", "listen": True}),
            rule("halves", {"kind": "serial", "port": os.ttyname(self.far_end)}, "space_packets"),
            rule("hanging", {"kind": "pty"}, command=[sys.executable, "-c", hang]),
            rule("well", {"kind": "udp", "local": f"{here}:{self.well_port}"}, "json_lines"),
        ]

    def begin(self):
        for name in (
            "deaf_",
            "late_",
            "killed_",
            "noisy_",
            "flooding_",
            "twice_",
            "halves_",
            "well_",
        ):
            thread = threading.Thread(
                target=self._guarded, args=(getattr(self, name),), daemon=True
            )
            thread.start()
            self.threads.append(thread)

    def _guarded(self, play):
        with contextlib.suppress(OSError):
            play()

    def end(self):
        self.is_over.set()
        for process in self.processes:
            process.kill()
            process.wait()
        self.closing.close()
        for fd in (self.line, self.far_end):
            os.close(fd)
        for thread in self.threads:
            thread.join(20)
        assert not [thread for thread in self.threads if thread.is_alive()]

    # Each of them --------------------------------------------------------------------------------

    def deaf_(self):
        with self.accept(self.deaf):
            self.is_over.wait()

    def accept(self, listener):
        listener.settimeout(0.1)
        while not self.is_over.is_set():
            with contextlib.suppress(TimeoutError):
                one, _ = listener.accept()
                one.settimeout(0.5)
                return one
        raise OSError

    def serve(self, read, write, protocol="frames"):
        software = guided_program.PROTOCOLS[protocol](guided_program.Guidance())
        while not self.is_over.is_set():
            with contextlib.suppress(TimeoutError):
                data = read()
                if not data:
                    return
                for answer in software.feed(data):
                    write(answer)

    def late_(self):
        self.until_tick("well", 10)  # of the 64 that wait for it a busy machine may add some
        listener = socket.create_server(("127.0.0.1", self.late_port))
        with listener, self.accept(listener) as one:
            self.serve(lambda: one.recv(65536), one.sendall)

    def killed_(self):
        command = [sys.executable, HERE / "guided_program.py", "frames", "tcp"]
        command.append(f"127.0.0.1:{self.killed_port}")
        process = None
        while not self.is_over.is_set():
            if process is None or process.poll() is not None:  # nobody listened, or it was killed
                process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
                self.processes.append(process)
            elif (
                self.seen.get("well", 0.0) >= 0.5
                and "killed" not in self.seen
                and is_connected(process.pid)
            ):
                self.seen["killed"] = True
                process.kill()
            time.sleep(0.05)

    def noisy_(self):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
            one.connect(("127.0.0.1", self.noisy_port))
            one.settimeout(0.05)
            packets = guided_program.Packets(guided_program.Guidance())
            number = 0
            while not self.is_over.is_set():
                with unheard():
                    one.send(os.urandom(200))
                    for answer in packets.feed(one.recv(65536)):
                        number += 1
                        one.send(answer if number % 10 else answer[:-5])

    def flooding_(self):
        with self.accept(self.flooding) as one:
            while not self.is_over.is_set():
                with contextlib.suppress(TimeoutError):
                    one.send(os.urandom(100_000))
                time.sleep(0.1)

    def connect(self, port):
        found = []

        def try_it():
            with contextlib.suppress(OSError):
                found.append(socket.create_connection(("127.0.0.1", port), timeout=5))
            return found or self.is_over.is_set()

        wait_until(try_it, 120)
        if not found:
            raise OSError
        return found[0]

    def twice_(self):
        first = self.closing.enter_context(self.connect(self.twice_port))
        self.until_tick("well", 10)
        with socket.create_connection(("127.0.0.1", self.twice_port), timeout=20) as second:

            def wait():
                try:
                    self.seen["second"] = second.recv(100)
                except ConnectionResetError:
                    self.seen["second"] = b""

            other = threading.Thread(target=wait, daemon=True)
            other.start()
            self.serve(lambda: first.recv(65536), first.sendall)
            other.join(20)

    def halves_(self):
        packets = guided_program.Packets(guided_program.Guidance())
        number = 0
        while not self.is_over.is_set():
            for answer in packets.feed(os.read(self.line, 65536)):
                number += 1
                os.write(self.line, answer[: len(answer) // 2] if number % 4 == 0 else answer)

    def well_(self):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
            one.connect(("127.0.0.1", self.well_port))
            one.settimeout(0.1)
            lines = guided_program.Lines(guided_program.Guidance())
            while not self.is_over.is_set():
                with unheard():
                    if "well" not in self.seen:
                        one.send(b"")
                    data = one.recv(65536)
                    for answer in lines.feed(data):
                        self.seen["well"] = json.loads(answer)["t_s"]
                        one.send(answer)

    def until_tick(self, name, tick):
        wait_until(lambda: self.is_over.is_set() or self.seen.get(name, -1.0) >= tick / HZ, 120)


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """Return the folder of the run, its run.json, and what the peers saw."""
    folder = tmp_path_factory.mktemp("peers")
    peers = Peers(folder)
    scenario = {
        "name": "peers",
        "simulation": "constellation",
        "agents": {"count": len(PEERS), "names": PEERS, "tick_hz": HZ, "restarts_max": 1},
        "time": {"mode": "realtime", "duration_s": DURATION_S},
        "on_agent_loss": "continue",
        "parameters": {
            "epoch_utc": "2026-01-01T00:00:00Z",
            "propagator": {"kind": "scipy", "forces": ["two_body"]},
            "satellites": {"walker": f"56:{len(PEERS)}/1/0", "altitude_km": 780},
            "vehicles": [
                {
                    "thruster": {"isp_s": 220, "propellant_kg": 5},
                    "sensors": {"gnss": {"rate_hz": HZ}},
                }
            ],
            "flight": peers.rules(),
        },
    }
    (folder / "peers.yaml").write_text(json.dumps(scenario))
    cosmos = CosmosCommand(folder)
    peers.begin()
    try:
        with cosmos.start_run(folder / "peers.yaml", *LOOSE) as process:
            _, err = process.communicate(timeout=240)
    finally:
        peers.end()
    document = json.loads((folder / "runs/0001-peers/run.json").read_text())
    return folder / "runs/0001-peers", document, peers.seen, err


def told(flown, name):
    """Return an agent's summary of its flight software, of the interface, its faults, and how many ticks it had."""
    flight = flown[1]["simulation"]["agents"][name]["flight"]
    faults = {kind: count for kind, count in flight["interface"]["faults"].items() if count}
    return flight, flight["interface"], faults, flight["ticks_sent"] + flight["ticks_skipped"]


def test_the_run_comes_to_its_end_and_nothing_is_left_behind(flown):
    run, document, _, err = flown
    assert (document["status"], document["exit_code"]) == ("complete", 4), err
    assert document["data"] == {"complete": True, "missing": []}
    assert document["records"]["dropped"] == 0
    folder = str(run.parents[1])
    assert [each for each in Path("/proc").glob("[0-9]*") if working_folder(each) == folder] == []


def working_folder(process):
    try:
        return os.readlink(process / "cwd")
    except OSError:
        return ""


def test_no_agent_loses_a_tick_by_its_peer(flown):
    for name in set(PEERS) - {"killed"}:
        *_, ticks = told(flown, name)
        assert ticks >= TICKS - flown[1]["timing"]["missed"], name


def test_one_that_is_well_beside_all_others_has_every_answer(flown):
    flight, _, faults, ticks = told(flown, "well")

    assert (flight["answers"], flight["unanswered"], faults) == (ticks, 0, {})


@pytest.mark.parametrize("name", ["deaf", "flooding", "hanging"])
def test_ticks_that_nobody_answers_are_counted_and_no_more_are_sent(flown, name):
    flight, interface, faults, ticks = told(flown, name)

    sent = min(ticks, 64)  # an agent that has to wait for a processor misses ticks
    assert (flight["answers"], flight["unanswered"]) == (0, sent)
    assert flight["ticks_skipped"] == ticks - sent
    check = next(c for c in flown[1]["checks"] if c["name"] == "constellation.flight_answers_late")
    assert check["got"] >= flight["ticks_skipped"] and not check["passed"]
    if name == "flooding":
        assert interface["floods"] > 10
        assert faults["bytes_skipped"] >= 0.9 * interface["bytes_received"] > 10 * 65_536


def test_one_that_comes_late_is_waited_for_and_given_all_it_missed(flown):
    flight, _, faults, ticks = told(flown, "late")

    assert (flight["ticks_sent"], flight["answers"], faults) == (ticks, ticks, {})
    assert flight["answer_s_max"] > 0.1


def test_one_that_is_killed_ends_its_agent_by_name_and_is_met_again_by_the_next(flown):
    run, document, *_ = flown
    assert document["agents"]["incarnations"] == {"killed": 2}
    events = (run / "host/events.jsonl").read_text().splitlines()
    reasons = [str(row.get("reason")) for row in map(json.loads, events) if "reason" in row]
    assert [reason for reason in reasons if "closed its end before" in reason], reasons
    assert told(flown, "killed")[0]["answers"] > 0


def test_garbage_between_packets_and_cut_ones_are_counted_and_the_rest_is_taken(flown):
    flight, _, faults, ticks = told(flown, "noisy")
    assert flight["answers"] >= 0.7 * ticks
    assert faults["corrupt"] + faults.get("cut", 0) > 30 and faults["bytes_skipped"] > 5_000

    flight, interface, faults, ticks = told(flown, "halves")
    assert faults["cut"] + faults.get("corrupt", 0) >= 10
    assert flight["answers"] + interface["ticks_unanswered"] + flight["unanswered"] == ticks


def test_who_connects_second_is_turned_away_and_counted(flown):
    flight, interface, faults, ticks = told(flown, "twice")

    assert (flight["answers"], interface["peers_refused"], faults) == (ticks, 1, {})
    assert flown[2]["second"] == b""
