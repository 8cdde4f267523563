"""Flight software in any language: what the program is told, what it may answer, and how it ends."""

import json
import math
import os
import re
import shutil
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from constellation_fakes import SCENARIOS, WALKER, FakeContext, parameters, tell, tick
from harness.waiting import is_alive, wait_until

from madns_runtime.errors import BlamedError
from madns_runtime.plugin.api import Tick
from madns_runtime.simulations.constellation.agent import ConstellationAgent
from madns_runtime.simulations.constellation.flight import process
from madns_runtime.simulations.constellation.flight.asked_ticks import UNANSWERED_MAX
from madns_runtime.simulations.constellation.flight.interface import arrival_thread, transport
from madns_runtime.simulations.constellation.flight.interface import program as flight_program
from madns_runtime.simulations.constellation.flight.interface.local_transports import StdioLink
from madns_runtime.simulations.constellation.flight.process import LATE_CHECK
from madns_runtime.simulations.constellation.messages import (
    Command,
    CommandResult,
    Delivery,
    Initial,
    Segment,
    TransmissionRefusal,
)

pytestmark = pytest.mark.process

HZ = 10.0
PATIENCE_S = 20.0
CIRCULAR = (7.158137e6, 0.0, 0.0, 0.0, 7462.3, 0.0)
ECHO = """
import json, sys
setup = json.loads(sys.stdin.readline())["setup"]
for line in sys.stdin:
    tick = json.loads(line)
    {body}
"""
ANSWER = "print(json.dumps({}), flush=True)"


@pytest.fixture(autouse=True)
def patience(monkeypatch):
    """Other tests' programs ended in this process, too; and a busy machine takes its time to let one end."""
    monkeypatch.setattr(flight_program, "END_S", PATIENCE_S)
    monkeypatch.setattr(flight_program.FlightProgram, "patience_s", PATIENCE_S)
    monkeypatch.setattr(process.ExternalFlight, "last_answers_s", process.LAST_ANSWERS_S)


def program(folder, body, text=ECHO):
    lines = "\n    ".join(body.splitlines())
    (folder / "program.py").write_text(text.replace("{body}", lines))
    return [sys.executable, "program.py"]


class Ship:
    """One agent that is flown by a program."""

    def __init__(self, folder, command, *, is_lockstep=True, **rest):
        flight = {
            "command": command,
            "input": "truth",
            "answer_s": PATIENCE_S,
            **rest.pop("flight", {}),
        }
        if flight["command"] is None:  # it runs already
            del flight["command"]
        hardware = rest.pop("hardware", {})
        self.context = FakeContext(
            "agent-01",
            ("agent-01", "agent-02"),
            parameters(WALKER, flight=flight, **rest),
            tick_hz=HZ,
            base_directory=Path(folder),
            is_lockstep=is_lockstep,
            hardware=hardware,
        )
        states = np.tile(CIRCULAR, (61, 1))
        segment = Segment(revision=0, t0_s=0.0, knot_s=1.0, states=states)
        initial = Initial(
            satellite="SAT-1", frame="TEME", epoch_utc="2026-01-01T00:00:00Z", segment=segment
        )
        self.agent = ConstellationAgent()
        self.agent.setup(self.context, initial.to_message())
        self._next = 0
        self.summary = self.late = None

    @property
    def process(self):
        return self.agent._cockpit._software._link.program

    def run(self, ticks):
        for _ in range(ticks):
            index, self._next = self._next, self._next + 1
            tick(self.agent, Tick(index, index / HZ, 1.0 / HZ, 0.0, 0))
        return self

    def run_until(self, is_done):
        """Tick like real time does, as long as it takes."""
        deadline_s = time.monotonic() + PATIENCE_S
        while not is_done():
            assert time.monotonic() < deadline_s, "waited in vain"
            self.run(1)
            time.sleep(0.002)
        return self

    def run_until_answered(self, count):
        """Tick when an answer has come, until *count* were taken."""
        software = self.agent._cockpit._software
        self.run(1)
        while software._counts["answers"] < count:
            wait_until(lambda: software._link._thread._found)
            self.run(1)

    def give_up_once(self, is_so):
        """In lockstep, have the time for an answer be over when something is so, however late that is."""
        link = self.agent._cockpit._software._link
        link.stopwatch = lambda: lambda: math.inf if is_so() else 0.0
        return self

    def __enter__(self):
        return self

    def __exit__(self, *_error):
        summary = self.agent.finish()
        self.summary = summary["flight"]
        self.late = {check["name"]: check for check in summary["checks"]}.get(LATE_CHECK)
        assert not Path(f"/proc/{self.process.pid}").exists()

    def commands(self):
        return [Command.from_message(m) for _, _, m in self.context.sent if m["kind"] == "command"]


def test_in_lockstep_every_tick_has_its_answer_before_it_ends(tmp_path):
    body = """
answer = {"estimate": {"t": tick["t_s"]}}
if tick["t_s"] == 0.3:
    answer["commands"] = [{"delta_v_m_s": [0, 0.5, 0], "at_s": 1.0}]
print(json.dumps(answer), flush=True)
"""
    with Ship(tmp_path, program(tmp_path, body)) as ship:
        ship.run(10)

    assert ship.context.records["estimates"] == [(n, n / HZ) for n in range(10)]
    assert ship.commands() == [
        Command(
            number=0,
            kind="delta_v",
            commanded_s=0.3,
            at_s=1.0,
            frame="rtn",
            vector=(0.0, 0.5, 0.0),
        )
    ]
    assert ship.summary["answers"] == ship.summary["ticks_sent"] == 10
    assert ship.summary["exit_code"] == 0


def test_a_program_that_cannot_be_told_its_setup_is_ended(tmp_path, monkeypatch):
    begun, begin = [], flight_program.FlightProgram.__init__

    def noted(self, *arguments, **options):
        begun.append(self)
        begin(self, *arguments, **options)

    monkeypatch.setattr(flight_program.FlightProgram, "__init__", noted)
    settings = {"text": "x" * 2_000_000}

    with pytest.raises(BlamedError, match="give fewer settings"):
        Ship(tmp_path, program(tmp_path, ANSWER), flight={"settings": settings})

    (one,) = begun
    assert one.has_exited


def test_it_is_told_who_it_is_and_what_it_may_know(tmp_path):
    body = """
with open("told.json", "a") as file:
    file.write(json.dumps(setup) + "\\n" + json.dumps(tick) + "\\n")
print("{}", flush=True)
"""
    command = program(tmp_path, body)
    with Ship(tmp_path, command, crosslinks={}, flight={"settings": {"k": [1.0]}}) as ship:
        message = Delivery(sender="agent-02", sent_s=-0.5, arrives_s=0.0, payload={"b": b"\x00"})
        result = CommandResult(number=4, status="refused", at_s=1.0, revision=0, reason="no fuel")
        refusal = TransmissionRefusal(number=1, to="*", sent_s=0.0, reason="no_line_of_sight")
        for one in (message, result.to_message(), refusal):
            tell(ship.agent, one)
        ship.run(1)

    setup, tick = map(json.loads, (tmp_path / "told.json").read_text().splitlines())
    assert setup.pop("seed") >= 0
    assert setup == {
        "name": "agent-01",
        "satellite": "SAT-1",
        "agents": ["agent-01", "agent-02"],
        "index": 0,
        "tick_hz": HZ,
        "rate_hz": HZ,
        "duration_s": 60.0,
        "epoch_utc": "2026-01-01T00:00:00Z",
        "frame": "TEME",
        "input": "truth",
        "first_number": 0,
        "settings": {"k": [1.0]},
    }
    assert tick["t_s"] == 0.0
    assert tick["readings"] == {"truth": {"t_s": 0.0, "values": list(CIRCULAR)}}
    assert tick["messages"] == [
        {
            "sender": "agent-02",
            "sent_s": -0.5,
            "arrives_s": 0.0,
            "payload": {"b": {"base64": "AA=="}},
        }
    ]
    assert tick["results"][0]["reason"] == "no fuel"
    assert tick["refusals"] == [
        {"number": 1, "to": "*", "sent_s": 0.0, "reason": "no_line_of_sight"}
    ]


def test_it_sends_by_radio_and_logs(tmp_path):
    body = """
print(json.dumps({"send": [{"to": "*", "payload": [1, "x"]}],
                  "log": [{"level": "warning", "text": "hello"}]}), flush=True)
"""
    with Ship(tmp_path, program(tmp_path, body), crosslinks={}) as ship:
        ship.run(1)

    ((_, message),) = ship.context.transmitted
    assert (message.to, message.payload) == ("*", [1, "x"])
    assert ("warning", "hello") in ship.context.logs


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        ("'nonsense'", "expected a JSON object, got 'nonsense'"),
        ("'[]'", "expected a JSON object; it wrote"),
        ("'{\"command\": []}'", "got command"),
        ("'{\"commands\": {}}'", "commands to be a list"),
        ('\'{"commands": [{"at_s": 1}]}\'', "one of delta_v_m_s, torque_n_m, ballistic_m2_kg"),
        ('\'{"commands": [{"delta_v_m_s": [0, 0, 0]}]}\'', "with at_s, delta_v_m_s"),
        ('\'{"commands": [{"delta_v_m_s": [0, 0], "at_s": 1}]}\'', "three numbers in m/s"),
        ('\'{"send": [{"to": "x"}]}\'', "a message with payload, to, got to;"),
        ('\'{"send": [{"to": "x", "payload": 1, "when": 2}]}\'', "got to, payload, when"),
        ('\'{"log": [{"text": "x"}]}\'', "words to log with level, text, got text"),
        ("'{\"estimate\": []}'", "a mapping of 1 to 64"),
        ("'{\"estimate\": 3}'", "a mapping of 1 to 64"),
        ("'{}\\n{}'", "one line for each tick and none for the setup"),
        ("'{\"t_s\": 7.5}'", "the answer to the tick at 0 s, got 7.5"),
        ('\'{"t_s": "x"}\'', "t_s to be the number that the tick has, got 'x'; it wrote"),
        ("'{\"t_s\": true}'", "t_s to be the number that the tick has, got True; it wrote"),
        ('\'{"estimate": {"a_m": NaN}}\'', "JSON has no NaN and no infinity: write null"),
        ('\'{"estimate": {"a_m": -inf}}\'', "JSON has no NaN and no infinity: write null"),
        ('\'{"estimate": {"a_m": "5"}}\'', "expected numbers for a_m, as in the first call, got"),
        ("'x' * 262_145", "lines of at most 262144 bytes"),
    ],
)
def test_what_is_no_answer_fails_the_agent_by_the_programs_name(tmp_path, answer, words):
    ship = Ship(tmp_path, program(tmp_path, f"print({answer}, flush=True)"), crosslinks={})

    # A second line may pass for the next tick's answer, for as long as a busy machine keeps the program waiting.
    with pytest.raises(BlamedError, match=words) as caught:
        ship.run(5000)

    assert str(caught.value).startswith(sys.executable)
    assert not Path(f"/proc/{ship.process.pid}").exists()


def test_a_program_that_dies_fails_the_agent_with_its_exit_code_and_its_last_words(tmp_path):
    body = "print('out of ideas', file=sys.stderr, flush=True)\nsys.exit(7)"
    ship = Ship(tmp_path, program(tmp_path, body))

    with pytest.raises(BlamedError, match=r"\(pid \d+\) ended with exit code 7") as caught:
        ship.run(1)

    told = "; its last words: 'out of ideas' (agents/agent-01/flight_stderr.txt)"
    assert str(caught.value).endswith(told)
    assert ship.context.texts == {"flight_stderr": b"out of ideas\n"}


def test_a_program_that_does_not_answer_in_lockstep_fails_the_agent(tmp_path):
    command = program(tmp_path, "pass")
    ship = Ship(tmp_path, command, flight={"answer_s": 0.05})

    with pytest.raises(BlamedError, match=r"the answer to the tick at 0 s within 0\.05 s"):
        ship.run(1)

    assert not Path(f"/proc/{ship.process.pid}").exists()


def test_an_answer_without_the_end_of_its_line_is_told_with_the_wait_for_it(tmp_path):
    ship = Ship(tmp_path, ["sh", "-c", "read setup; read tick; printf '{}'; cat"])
    protocol = ship.agent._cockpit._software._protocol

    with pytest.raises(BlamedError, match=r"; it wrote '\{\}' without the end of a line$"):
        ship.give_up_once(lambda: protocol.rest).run(1)


def test_text_where_frames_are_expected_is_told_with_the_wait_for_it(tmp_path):
    flight = {"interface": {"protocol": "frames"}}
    ship = Ship(tmp_path, ["sh", "-c", "echo hi; cat >&2"], flight=flight)
    protocol = ship.agent._cockpit._software._protocol

    with pytest.raises(BlamedError, match=r"it wrote 'hi\\n' which is no whole frame: text goes"):
        ship.give_up_once(lambda: protocol.rest).run(1)


def test_what_is_printed_where_lines_of_json_are_expected_is_told_with_where_to_print(tmp_path):
    ship = Ship(tmp_path, program(tmp_path, "print('debug: nan', flush=True)"))

    with pytest.raises(BlamedError, match=r"got 'debug: nan' \(standard output is for answers"):
        ship.run(1)


FOREIGN = """
import json, socket, sys
host, port = sys.argv[1].split(":")
way = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
way.connect((host, int(port)))
way.send(b"")
setup = way.recv(65536)
while line := way.recv(65536):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.sendto(b"{}\\n", (host, int(port)))
    way.send(b"{}\\n")
"""


def test_what_others_send_is_counted_in_lockstep_too(tmp_path):
    command = [*program(tmp_path, "", FOREIGN), "${address}"]
    transport = {"kind": "udp", "local": "127.0.0.1:0"}
    flight = {"answer_s": 20.0, "interface": {"transport": transport, "start_s": 60}}

    with Ship(tmp_path, command, flight=flight) as ship:
        ship.run(3)

    interface = ship.summary["interface"]
    assert (ship.summary["answers"], interface["packets_foreign"]) == (3, 3)
    assert not {"bytes_sent", "packets_unsent", "floods"} & set(interface)


LONG = Delivery("agent-02", 0.0, 0.0, "x" * 2_000_000)


def test_in_lockstep_a_report_that_its_way_has_no_room_for_fails_the_agent(tmp_path):
    ship = Ship(tmp_path, program(tmp_path, ANSWER), crosslinks={}).run(1)
    ship.agent.hear(LONG)

    with pytest.raises(BlamedError, match="stdio has no room for 20[0-9]{5} bytes in 1 packet"):
        ship.run(1)


def test_in_real_time_mail_that_its_way_has_no_room_for_is_dropped_and_the_next_tick_sent(tmp_path):
    command = program(tmp_path, ANSWER)
    with Ship(tmp_path, command, is_lockstep=False, crosslinks={}) as ship:
        ship.run_until_answered(1)
        sent = ship.agent._cockpit._software._counts["ticks_sent"]
        ship.agent.hear(LONG)
        ship.run(2)

    assert ship.summary["ticks_sent"] == sent + 1
    assert (ship.summary["ticks_skipped"], ship.summary["mail_dropped"]) == (1, 1)
    assert not ship.late["passed"]


def test_in_real_time_no_tick_waits_and_answers_are_taken_when_they_come(tmp_path):
    gate, second_gate = tmp_path / "gate", tmp_path / "second"
    body = f"""
import os, time
while not os.path.exists({str(second_gate)!r} if tick["t_s"] else {str(gate)!r}):
    time.sleep(0.001)
print(json.dumps({{"estimate": {{"of_t": tick["t_s"]}}}}), flush=True)
"""
    command = program(tmp_path, body)
    with Ship(tmp_path, command, is_lockstep=False, flight={"answer_s": 1e-6}) as ship:
        ship.run(5)
        assert "estimates" not in ship.context.streams
        gate.touch()
        ship.run_until(lambda: "estimates" in ship.context.streams)
        second_gate.touch()
        ship.run_until(lambda: len(ship.context.records["estimates"]) >= 5)

    rows = ship.context.records["estimates"]
    assert [of_t for _, of_t in rows[:5]] == [0.0, 0.1, 0.2, 0.3, 0.4]
    assert all(tick >= 5 for tick, _ in rows)
    # The first one tells that the program has begun; all others took longer than a microsecond.
    assert ship.summary["answers_late"] == ship.summary["answers"] - 1 >= 4
    assert ship.late["got"] >= 4
    assert not ship.late["passed"]


def lines_of(thread):
    """Count the lines that lie there since the last tick."""
    return sum(arrival.data.count(b"\n") for arrival in list(thread._found))


def test_an_answer_that_lies_there_until_the_next_tick_is_not_late(tmp_path, monkeypatch):
    command = program(tmp_path, ANSWER)
    clock_s = 0.0
    for module in (process, arrival_thread, transport):
        monkeypatch.setattr(module, "monotonic", lambda: clock_s)
    with Ship(tmp_path, command, is_lockstep=False, flight={"answer_s": 1.0}) as ship:
        ship.run_until_answered(1)
        software = ship.agent._cockpit._software
        thread = software._link._thread
        for _ in range(3):
            ship.run(1)
            wait_until(lambda: lines_of(thread) == len(software._asked))
            clock_s += 2.0  # a tick every two seconds

    assert ship.summary["answers"] >= 4
    assert ship.summary["answers_late"] == 0
    assert ship.late["passed"]


def test_a_slow_start_is_no_late_answer(tmp_path, monkeypatch):
    gate = tmp_path / "gate"
    text = f"""
import os, sys, time
while not os.path.exists({str(gate)!r}):
    time.sleep(0.001)
sys.stdin.readline()
for line in sys.stdin:
    print("{{}}", flush=True)
"""
    command = program(tmp_path, "", text)
    clock_s = 0.0
    for module in (process, arrival_thread, transport):
        monkeypatch.setattr(module, "monotonic", lambda: clock_s)
    with Ship(tmp_path, command, is_lockstep=False, flight={"answer_s": 1.0}) as ship:
        ship.run(3)
        clock_s = 5.0
        gate.touch()
        ship.run_until_answered(3)
        clock_s = 5.9
        ship.run_until_answered(5)

    assert ship.summary["answer_s_max"] == 5.0
    assert ship.late["got"] == 0


@pytest.mark.parametrize("rate_hz", [HZ, 5.0 * HZ])
def test_one_that_catches_up_in_real_time_may_command_by_each_answer_what_a_tick_may(
    tmp_path, rate_hz
):
    gate = tmp_path / "gate"
    body = f"""
import os, time
while not os.path.exists({str(gate)!r}):
    time.sleep(0.001)
command = {{"delta_v_m_s": [0, 0.001, 0], "at_s": tick["t_s"] + 5}}
said = {{"commands": [command] * 3, "send": [{{"to": "agent-02", "payload": 1}}] * 12}}
print(json.dumps(said), flush=True)
"""
    flight, command = {"rate_hz": rate_hz}, program(tmp_path, body)
    with Ship(tmp_path, command, is_lockstep=False, flight=flight, crosslinks={}) as ship:
        software = ship.agent._cockpit._software
        ship.run(12)
        asked = software._counts["ticks_sent"]
        gate.touch()
        wait_until(lambda: lines_of(software._link._thread) >= asked)
        ship.run(1)

    numbers = [row[1] for row in ship.context.records["commands"]]
    assert numbers[: 3 * asked] == list(range(3 * asked))
    assert len(ship.context.records["messages"]) >= 12 * asked


def test_a_program_that_falls_behind_is_sent_no_more_than_it_can_hold(tmp_path):
    # It reads nothing at all after the setup line.
    command = program(tmp_path, "sys.stdin.read()")
    with Ship(tmp_path, command, is_lockstep=False) as ship:
        ship.run(UNANSWERED_MAX + 30)

    assert ship.summary["ticks_sent"] == UNANSWERED_MAX
    assert ship.summary["ticks_skipped"] == 30
    assert ship.summary["unanswered"] == UNANSWERED_MAX
    # Patience has not run out for those that were sent, but nothing was ever answered.
    got = 30 + UNANSWERED_MAX
    assert ship.late == {"name": LATE_CHECK, "limit": 0, "got": got, "passed": False}


def test_a_program_that_never_answers_breaks_a_check(tmp_path):
    command = program(tmp_path, "pass")
    with Ship(tmp_path, command, is_lockstep=False, flight={"answer_s": 1e-6}) as ship:
        ship.run(5)

    # The last one, too, has its time.
    assert ship.late == {"name": LATE_CHECK, "limit": 0, "got": 5, "passed": False}


def test_a_program_that_never_answers_breaks_it_though_the_run_is_shorter_than_its_patience(
    tmp_path,
):
    command = program(tmp_path, "pass")
    with Ship(tmp_path, command, is_lockstep=False) as ship:
        ship.run(5)

    assert ship.summary["unanswered"] == 5
    assert ship.late == {"name": LATE_CHECK, "limit": 0, "got": 5, "passed": False}


def test_the_first_answer_is_waited_for_at_the_end(tmp_path, monkeypatch):
    """An agent that has rejoined just now, say: its program is still starting."""
    monkeypatch.setattr(process.ExternalFlight, "last_answers_s", PATIENCE_S)
    command = ["sh", "-c", "read setup; read tick; sleep 0.3; echo '{}'; cat"]
    with Ship(tmp_path, command, is_lockstep=False) as ship:
        ship.run(1)

    assert ship.summary["answers"] == 1
    assert ship.late == {"name": LATE_CHECK, "limit": 0, "got": 0, "passed": True}


def test_one_that_answers_in_time_breaks_none(tmp_path):
    command = program(tmp_path, "print('{}', flush=True)")
    with Ship(tmp_path, command, is_lockstep=False) as ship:
        ship.run_until_answered(3)

    assert ship.late == {"name": LATE_CHECK, "limit": 0, "got": 0, "passed": True}


def test_what_it_says_on_standard_error_is_kept_and_counted(tmp_path):
    body = """
for n in range(3000):
    print("word", n, file=sys.stderr)
sys.stderr.flush()
print("{}", flush=True)
"""
    with Ship(tmp_path, program(tmp_path, body)) as ship:
        ship.run(1)

    kept = ship.context.texts["flight_stderr"].decode().splitlines()
    assert kept == [f"word {n}" for n in range(3000)]
    assert ship.summary["stderr_lines"] == 3000
    assert ship.summary["stderr_bytes"] == len("".join(f"{line}\n" for line in kept))


def test_a_word_on_standard_error_without_end_holds_nobody_up(tmp_path):
    body = """
sys.stderr.write("x" * 60_000)
sys.stderr.flush()
print("{}", flush=True)
"""
    with Ship(tmp_path, program(tmp_path, body)) as ship:
        ship.run(20)

    assert ship.summary["answers"] == 20
    assert ship.summary["stderr_lines"] == 1
    assert ship.summary["stderr_bytes"] % 60_000 == 0
    assert set(ship.context.texts["flight_stderr"]) == {ord("x")}


def test_a_program_that_does_not_end_with_its_input_is_stopped(tmp_path, monkeypatch):
    monkeypatch.setattr(flight_program.FlightProgram, "patience_s", 0.3)
    text = """
import signal, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
sys.stdin.readline()
sys.stdin.readline()
print("{}", flush=True)
while True:
    time.sleep(1)
"""
    (tmp_path / "stubborn.py").write_text(text)
    with Ship(tmp_path, [sys.executable, "stubborn.py"]) as ship:
        ship.run(1)

    assert ship.summary["exit_code"] == -9
    # The first wait took all that was left, the second what there is always.
    assert flight_program.FlightProgram.patience_s <= -flight_program.PATIENCE_S_MIN
    assert [level for level, text in ship.context.logs if "exit code -9" in text] == ["warning"]


def test_what_a_program_starts_itself_ends_with_it(tmp_path):
    script = "sleep 600 & echo $! > pid; read setup; while read tick; do echo '{}'; done"
    with Ship(tmp_path, ["sh", "-c", script]) as ship:
        ship.run(2)

    assert ship.summary["exit_code"] == 0
    pid = int((tmp_path / "pid").read_text())
    wait_until(lambda: not is_alive(pid))


def test_a_missing_program_is_named_at_set_up(tmp_path):
    with pytest.raises(BlamedError, match=f"no-such: .*{re.escape(str(tmp_path))}"):
        Ship(tmp_path, ["no-such"])


def test_a_program_dies_with_its_agents_process(tmp_path):
    command = program(tmp_path, "print('{}', flush=True)", "import time\ntime.sleep(600)\n")
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        process = flight_program.FlightProgram(command, tmp_path)
        os.write(writer, str(process.pid).encode())
        os._exit(0)
    os.close(writer)
    pid = int(os.read(reader, 20))
    os.close(reader)
    os.waitpid(child, 0)

    wait_until(lambda: not is_alive(pid))


def test_the_example_in_c_holds_its_semi_major_axis(tmp_path):
    if shutil.which("cc") is None:
        pytest.skip("no C compiler")
    flight = {
        "input": "measurements",
        "command": ["flight/hold.sh"],
        "settings": {"a_m": 7_160_000, "tolerance_m": 50, "lead_s": 3},
    }
    sensors = {"gnss": {"rate_hz": HZ}}
    with Ship(SCENARIOS, flight["command"], flight=flight, vehicles=[{"sensors": sensors}]) as ship:
        ship.run(11)

    mu = 398600.4418e9
    a_m = 1.0 / (2.0 / CIRCULAR[0] - CIRCULAR[4] ** 2 / mu)
    rows = ship.context.records["estimates"]
    assert [row[0] for row in rows] == list(range(11))
    assert rows[0][1] == pytest.approx(a_m, abs=0.01)
    first = ship.commands()[0]
    assert first.at_s == 3.0
    # Vis viva: after the burn the semi-major axis is the one wanted, but for the square of delta-v.
    after_m_s = CIRCULAR[4] + first.vector[1]
    reached_m = 1.0 / (2.0 / CIRCULAR[0] - after_m_s**2 / mu)
    assert reached_m == pytest.approx(7_160_000, abs=2.0)
    assert ship.summary["exit_code"] == 0


def test_its_end_closes_no_descriptor_that_somebody_else_has_by_then(tmp_path):
    process = flight_program.FlightProgram(["sh", "-c", "cat; sleep 0.1"], tmp_path)
    way = StdioLink("stdio")
    way.use(*process.pipes)
    number = process.pipes[1]
    null_fd = os.open(os.devnull, os.O_RDONLY)

    def read():
        os.dup2(null_fd, number)  # as a writer of records may get it for a file of its own

    code = process.end(way.close_input, read)
    os.close(null_fd)

    assert code == 0
    assert os.fstat(number).st_rdev == os.stat(os.devnull).st_rdev
    os.close(number)
