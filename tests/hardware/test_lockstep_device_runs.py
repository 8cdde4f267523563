"""Devices in lockstep: judged by the agents' accounts, and the same records each time."""

import json

import pytest
from harness.cosmos_command import LOOSE, CosmosCommand

pytestmark = pytest.mark.process

SCENARIO = """
name: even
simulation: counter
agents: {count: 2, tick_hz: 20}
time: {duration_s: 3, mode: lockstep}
seed: 5
hardware:
  devices:
    - name: gps
      kind: synthetic
      rate_hz: 20
      parameters: {channels: [{name: value, elements: [{shape: sine, amplitude: 1.0, noise: 0.1}]}]}
"""


def test_two_lockstep_runs_with_devices_record_the_same(tmp_path):
    scenario = tmp_path / "even.yaml"
    scenario.write_text(SCENARIO)
    cosmos = CosmosCommand(tmp_path)

    (code, first), (_, second) = (cosmos.run(scenario, *LOOSE) for _ in range(2))

    assert code == 0, first["verdict"]
    assert first["records_sha256"] == second["records_sha256"]
    assert first["devices"] == second["devices"]
    assert set(first["devices"]) == {"agent-01/gps", "agent-02/gps"}
    assert first["devices"]["agent-01/gps"]["samples"] == 60
    assert "hardware.lost" in {check["name"] for check in first["checks"]}
    assert list(cosmos.directory(first).glob("devices/agent-01/gps/value.jsonl"))


def test_an_agent_that_returns_is_told_of_its_devices_status(tmp_path):
    scenario = tmp_path / "even.yaml"
    loss = "timeline:\n  - {at_s: 1, action: kill, agents: [agent-01], for_s: 0.5}\n"
    scenario.write_text(f"{SCENARIO}on_agent_loss: continue\n{loss}")
    cosmos = CosmosCommand(tmp_path)

    _, run = cosmos.run(scenario, *LOOSE)

    folder = cosmos.directory(run) / "agents" / "agent-01"
    for name, t_s in (("events", 0.0), ("events.2", 1.5)):
        lines = map(json.loads, (folder / f"{name}.jsonl").read_text().splitlines())
        told = [(line["t_s"], line["status"]) for line in lines if line.get("event") == "device"]
        assert told == [(t_s, "ok")]


VALVE = """
from madns_runtime.hardware.contract import Channel, DeviceKind, Sample, SimulatedDevice


class Valve(SimulatedDevice):
    kind = DeviceKind(
        name="valve",
        summary="a valve that is moved, and leaks",
        channels=(
            Channel(name="position"),
            Channel(name="duty", direction="out", limits=(0.0, 1.0), safe=0.0),
        ),
        needs_hardware=False,
        follows_simulated_time=True,
    )

    def sample_at(self, t_s):
        self.count("lost_bytes", 2)
        return Sample(values={"position": t_s}, taken_s=t_s)

    def write(self, values, due_s):
        pass
"""
MOVER = """
from dataclasses import dataclass

from madns_runtime.plugin.api import AgentSimulation, HostSimulation, Simulation


@dataclass(frozen=True, kw_only=True)
class Parameters:
    pass


class Host(HostSimulation):
    pass


class Agent(AgentSimulation):
    def setup(self, context, initial):
        self.context, self.changes = context, []

    def step(self, tick):
        valve = self.context.hardware["valve"]
        valve.write("duty", tick.t_s / 10)
        if not tick.t_s:
            valve.write("duty", 0.9, due_s=1000.0)

    def device_changed(self, device, status):
        self.changes.append((self.context.now_s(), status))

    def finish(self):
        return {"changes": self.changes}


simulation = Simulation(name="mover", parameters=Parameters, host=":Host", agent=":Agent")
"""
MOVED = """
name: moved
simulation: ./mover.py:simulation
agents: {count: 1, tick_hz: 10}
time: {duration_s: 6, mode: lockstep}
hardware:
  armed: true
  devices: [{name: valve, kind: ./valve.py:Valve, rate_hz: 10}]
timeline:
  - {at_s: 3, action: device_fault, agents: ["*"], device: valve, fault: disconnect, for_s: 1.5}
"""


def rows(path):
    lines = map(json.loads, path.read_text().splitlines()[1:])
    return [row for row in lines if isinstance(row, list) or "event" in row]


def test_what_the_driver_does_not_take_in_lockstep_is_refused_and_told(tmp_path):
    picky = VALVE.replace(
        "        pass\n",
        "        if 0.15 < values['duty'] < 0.35:\n            raise PluginError('stuck')\n",
    )
    picky = "from madns_runtime.errors import PluginError\n" + picky.replace(
        'self.count("lost_bytes", 2)', "pass"
    )
    untouched = MOVED[: MOVED.index("timeline:")]
    for name, text in (("valve.py", picky), ("mover.py", MOVER), ("moved.yaml", untouched)):
        (tmp_path / name).write_text(text)
    cosmos = CosmosCommand(tmp_path)

    code, run = cosmos.run(tmp_path / "moved.yaml", *LOOSE)

    assert code == 0, run["verdict"]
    told = run["devices"]["agent-01/valve"]
    assert (told["counts"]["refused"], told["errors"], told["lost"]) == (19, 0, 0)
    remark = (
        "device agent-01/valve: 19 times something was refused; its events.jsonl says what and why"
    )
    assert remark in run["remarks"]
    folder = cosmos.directory(run)
    events = rows(next(folder.glob("devices/*/valve/events.jsonl")))
    assert {e["why"] for e in events if e["event"] == "refused"} == {"duty: stuck"}
    put_out = [row[2] for row in rows(next(folder.glob("devices/*/valve/duty.jsonl")))]
    assert len(put_out) == 40
    assert not [value for value in put_out if 0.15 < value < 0.35]


def test_a_device_that_is_disconnected_in_lockstep_takes_nothing_and_is_lost_at_once(tmp_path):
    for name, text in (("valve.py", VALVE), ("mover.py", MOVER), ("moved.yaml", MOVED)):
        (tmp_path / name).write_text(text)
    cosmos = CosmosCommand(tmp_path)

    code, run = cosmos.run(tmp_path / "moved.yaml", *LOOSE)

    assert code == 4
    told = run["devices"]["agent-01/valve"]
    assert (told["samples"], told["lost"]) == (45, 1)
    assert told["why"] == "an inserted fault disconnects it"
    assert told["stale_ratio"] == pytest.approx(1.5 / 6.0), "of the whole run"
    counts = told["counts"]
    assert counts["lost_bytes"] == 120, "what a driver counts by itself"
    assert "hardware.lost_bytes" in run["verdict"]
    assert (counts["passed_while_closed"], counts["writes_lost"]) == (15, 15)
    # Of those still to come the newest of an output alone waits: that of the last tick, which no other followed.
    assert (counts["writes_replaced"], counts["writes_left"]) == (1, 1)
    folder = cosmos.directory(run)
    put_out_s = [row[0] for row in rows(next(folder.glob("devices/*/valve/duty.jsonl")))]
    assert not [t_s for t_s in put_out_s if 2.9 < t_s < 4.4]
    events = rows(next(folder.glob("devices/*/valve/events.jsonl")))
    assert [(e["event"], e["t_s"]) for e in events[1:-1]] == [
        ("fault", 3.0),
        ("made_safe", 3.0),
        ("closed", 3.0),
        ("fault", 4.5),
        ("opened", 4.5),
        ("made_safe", 6.0),
    ]
    (end,) = [
        e for e in rows(folder / "agents" / "agent-01" / "events.jsonl") if e["event"] == "end"
    ]
    assert end["t_s"] == 6.0, "also where no message was left behind the last tick"
    result = json.loads((folder / "result.json").read_text())
    changes = result["agents"]["agent-01"]["simulation"]["changes"]
    assert [[round(t_s, 6), status] for t_s, status in changes] == [
        [0.0, "ok"],
        [3.0, "lost"],
        [4.5, "ok"],
    ]


PAST = """
on_agent_loss: continue
timeline:
  - {at_s: 0.5, action: device_fault, agents: ["*"], device: gps, fault: bias, value: 100, for_s: 1}
  - {at_s: 1.2, action: kill, agents: [agent-01], for_s: 0.6}
  - {at_s: 1.5, action: kill, agents: [agent-02], for_s: 0.3}
checks:
  - {name: biased, stream: gps.value, field: value, from_s: 0.6, to_s: 1.1, above: 50}
  - {name: biased_no_more, stream: gps.value, field: value, from_s: 2, below: 50}
"""


def test_the_owners_end_makes_a_device_safe_in_lockstep_too(tmp_path):
    killed = MOVED[: MOVED.index("timeline:")] + (
        "on_agent_loss: continue\nagents: {count: 2, tick_hz: 10}\n"
        'timeline:\n  - {at_s: 3, action: kill, agents: ["agent-01"], for_s: 1}\n'
    )
    killed = killed.replace("agents: {count: 1, tick_hz: 10}\n", "", 1)
    valve = VALVE.replace('self.count("lost_bytes", 2)', "pass")
    for name, text in (("valve.py", valve), ("mover.py", MOVER), ("moved.yaml", killed)):
        (tmp_path / name).write_text(text)
    cosmos = CosmosCommand(tmp_path)

    _, run = cosmos.run(tmp_path / "moved.yaml", *LOOSE)

    folder = cosmos.directory(run) / "devices"
    safe_s = {
        agent: [
            round(each["t_s"])
            for each in rows(folder / agent / "valve/events.jsonl")
            if each["event"] == "made_safe"
        ]
        for agent in ("agent-01", "agent-02")
    }
    assert safe_s == {"agent-01": [3, 6], "agent-02": [6]}
    lost = [run["devices"][f"{agent}/valve"]["counts"].get("writes_lost", 0) for agent in safe_s]
    assert lost == [1, 0]  # what it said in its last tick


def test_a_fault_that_ends_while_its_agent_is_away_is_over_when_that_returns(tmp_path):
    (tmp_path / "past.yaml").write_text(SCENARIO + PAST)
    cosmos = CosmosCommand(tmp_path)

    code, run = cosmos.run(tmp_path / "past.yaml", *LOOSE)

    assert code == 0, run["verdict"]
    assert run["agents"]["lost_on_purpose"] == ["agent-01", "agent-02"]
    ended = [
        row for row in rows(cosmos.directory(run) / "host" / "events.jsonl") if "number" in row
    ]
    told = next(row for row in ended if row["event"] == "action_ended")
    assert (told["action"], told["not_there"]) == ("device_fault", ["agent-01"])


FRAMES = """
from madns_runtime.hardware.contract import Channel, DeviceKind, Sample, SimulatedDevice


class Line(SimulatedDevice):
    kind = DeviceKind(
        name="line",
        summary="frames",
        channels=(Channel(name="received", is_frame=True, passing="queue"),),
        needs_hardware=False,
        follows_simulated_time=True,
    )

    def sample_at(self, t_s):
        return Sample(values={"received": b"x"}, taken_s=t_s)
"""
BIASED = """
name: biased
simulation: counter
agents: {count: 1, tick_hz: 10}
time: {duration_s: 3, mode: lockstep}
hardware:
  devices: [{name: line, kind: ./line.py:Line, rate_hz: 10}]
timeline:
  - {at_s: 1, action: device_fault, agents: ["*"], device: line, fault: bias, value: 3}
"""


def test_a_fault_between_two_ticks_alters_the_samples_of_its_time(tmp_path):
    scenario = tmp_path / "swift.yaml"
    scenario.write_text("""
name: swift
simulation: counter
agents: {count: 1, tick_hz: 10}
time: {duration_s: 1, mode: lockstep}
hardware:
  devices:
    - name: gps
      kind: synthetic
      rate_hz: 100
      parameters: {channels: [{name: value, elements: [{shape: sine, amplitude: 1.0}]}]}
timeline:
  - {at_s: 0.33, action: device_fault, agents: ["*"], device: gps, fault: bias, value: 100, for_s: 0.03}
  - {at_s: 0.55, action: device_fault, agents: ["*"], device: gps, fault: bias, value: 100, for_s: 0.3}
""")
    cosmos = CosmosCommand(tmp_path)

    _, run = cosmos.run(scenario, *LOOSE)

    folder = cosmos.directory(run) / "devices/agent-01/gps"
    rows = [json.loads(line) for line in (folder / "value.jsonl").read_text().splitlines()]
    altered = [row[0] for row in rows if isinstance(row, list) and row[-1] > 50.0]
    assert altered == [number / 100 for number in (33, 34, 35, *range(55, 85))]
    events = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    told = [event["t_s"] for event in events if event.get("event") == "fault"]
    assert told == [0.33, 0.36, 0.55, 0.85]


def test_a_fault_that_would_alter_nothing_is_refused_before_the_run(tmp_path):
    (tmp_path / "line.py").write_text(FRAMES)
    (tmp_path / "biased.yaml").write_text(BIASED)
    cosmos = CosmosCommand(tmp_path)

    done = cosmos("validate", "biased.yaml")

    assert done.returncode == 2
    told = "timeline[0].fault: bias is added to numbers, and line measures frames of bytes alone"
    assert told in done.stderr
    (tmp_path / "biased.yaml").write_text(BIASED.replace("bias, value: 3", "freeze"))
    assert cosmos("validate", "biased.yaml").returncode == 0


FAILING = """

class Failing(Valve):
    kind = Valve.kind

    def METHOD(self, *given):
        raise RAISED("stuck")
"""


@pytest.mark.parametrize(
    ("method", "raised"),
    [
        *((name, "ValueError") for name in ("__init__", "open", "sample_at", "write", "make_safe")),
        *(("close", name) for name in ("ValueError", "BaseException")),
    ],
)
def test_what_a_driver_raises_in_lockstep_is_told_by_its_own_line(tmp_path, method, raised):
    text = VALVE.replace('        self.count("lost_bytes", 2)\n', "")
    failing = FAILING.replace("METHOD", method).replace("RAISED", raised)
    (tmp_path / "valve.py").write_text(text + failing)
    (tmp_path / "mover.py").write_text(MOVER)
    moved = MOVED.partition("timeline:")[0].replace("duration_s: 6", "duration_s: 1")
    (tmp_path / "moved.yaml").write_text(moved.replace("valve.py:Valve", "valve.py:Failing"))

    code, run = CosmosCommand(tmp_path).run(tmp_path / "moved.yaml", *LOOSE)

    line = len((text + FAILING).splitlines())
    kind = "./valve.py:" if method == "__init__" else ""  # of which there is no driver yet
    told = f"device valve: {kind}Failing.{method} raised {raised}: stuck (valve.py:{line})"
    device = run["devices"]["agent-01/valve"]
    if method != "__init__":
        assert (device["why"], device["errors"]) == (told, 1)
    if method in ("make_safe", "close"):  # the run is over, and its account is given all the same
        assert device["samples"] == 10
        assert device["unsafe"] == (method == "make_safe")
        assert ("hardware.unsafe" in run["verdict"]) == (method == "make_safe")
        assert code == (4 if method == "make_safe" else 0)
    else:
        assert code == 1
        assert told in run["verdict"]


READER = """

from dataclasses import dataclass

from madns_runtime.plugin.api import AgentSimulation, HostSimulation, Simulation


@dataclass(frozen=True, kw_only=True)
class Parameters:
    pass


class Host(HostSimulation):
    pass


class Agent(AgentSimulation):
    def setup(self, context, initial):
        self.context, self.numbers = context, []

    def step(self, tick):
        frames = self.context.hardware["line"].frames("received")
        self.numbers += [frame.number for frame in frames]

    def finish(self):
        return {"taken": len(self.numbers), "last": self.numbers[-1]}


simulation = Simulation(name="reader", parameters=Parameters, host=":Host", agent=":Agent")
"""
READ = """
name: read
simulation: ./line.py:simulation
agents: {count: 1, tick_hz: TICK_HZ}
time: {duration_s: 24, mode: lockstep}
hardware:
  devices: [{name: line, kind: ./line.py:Line, rate_hz: 1000}]
"""


@pytest.mark.parametrize(("tick_hz", "taken", "dropped"), [(1, 23_001, 0), (0.0625, 10_001, 6000)])
def test_frames_between_two_ticks_come_whole_or_are_counted(tmp_path, tick_hz, taken, dropped):
    """More than a socket holds, by far; and more than a queue does."""
    (tmp_path / "line.py").write_text(FRAMES + READER)
    (tmp_path / "read.yaml").write_text(READ.replace("TICK_HZ", str(tick_hz)))
    cosmos = CosmosCommand(tmp_path)

    code, run = cosmos.run(tmp_path / "read.yaml", *LOOSE)

    assert code == 0, run["verdict"]
    assert "frames_missed" not in run["devices"]["agent-01/line"]["counts"]
    folder = cosmos.directory(run)
    result = json.loads((folder / "result.json").read_text())
    told = result["agents"]["agent-01"]["simulation"]
    assert told == {"taken": taken, "last": taken + dropped}
    events = rows(folder / "agents" / "agent-01" / "events.jsonl")
    losses = [each["frames_dropped"] for each in events if each["event"] == "device_losses"]
    assert losses == ([dropped] if dropped else [])
    told = f"agent-01: device line: there was no room for all: frames_dropped {dropped}"
    assert (told in run["remarks"]) == bool(dropped)


def test_frames_that_an_agent_had_no_room_for_before_it_was_killed_are_told(tmp_path):
    (tmp_path / "line.py").write_text(FRAMES + READER)
    killed = READ.replace("TICK_HZ", "0.0625").replace("count: 1", "count: 2")
    killed = killed.replace("duration_s: 24", "duration_s: 48")
    killed += """on_agent_loss: continue
timeline: [{at_s: 20, action: kill, agents: [agent-01]}]
"""
    (tmp_path / "read.yaml").write_text(killed)
    cosmos = CosmosCommand(tmp_path)

    code, run = cosmos.run(tmp_path / "read.yaml", *LOOSE)

    assert code == 0, run["verdict"]
    events = rows(cosmos.directory(run) / "agents" / "agent-01" / "events.jsonl")
    assert "killed" in [each["event"] for each in events]
    (dropped,) = [each["frames_dropped"] for each in events if each["event"] == "device_losses"]
    assert dropped > 0
    told = f"agent-01: device line: there was no room for all: frames_dropped {dropped}"
    assert told in run["remarks"]


WRITER = """
    def write(self, values, due_s):
        pass
"""


def test_all_frames_that_an_agent_writes_in_a_tick_are_put_out(tmp_path):
    sent = 'Channel(name="sent", direction="out", is_frame=True, passing="queue")'
    line = FRAMES.replace('passing="queue"),)', f'passing="queue"), {sent})') + WRITER
    step = "for number in range(2000): self.context.hardware['line'].write('sent', b'%d' % number)"
    reader = READER.replace(
        'frames = self.context.hardware["line"]',
        f"{step}\n        frames = self.context.hardware['line']",
    )
    (tmp_path / "line.py").write_text(line + reader)
    read = READ.replace("TICK_HZ", "1").replace("duration_s: 24", "duration_s: 4")
    (tmp_path / "read.yaml").write_text(read.replace("hardware:", "hardware:\n  armed: true"))
    cosmos = CosmosCommand(tmp_path)

    code, run = cosmos.run(tmp_path / "read.yaml", *LOOSE)

    assert code == 0, run["verdict"]
    folder = cosmos.directory(run)
    put_out = [
        bytes.fromhex(row[-1]) for row in rows(next(folder.glob("devices/*/line/sent.jsonl")))
    ]
    # Those of the last tick are left.
    assert put_out == [b"%d" % number for number in range(2000)] * 3
    assert run["devices"]["agent-01/line"]["counts"]["writes_left"] == 2000


KILLED = """
name: killed
simulation: ./line.py:simulation
agents: {count: 2, tick_hz: 10, per_process: 2}
time: {duration_s: 11.5, mode: lockstep}
on_agent_loss: continue
hardware:
  devices: [{name: line, kind: ./line.py:Line, rate_hz: 1000}]
timeline: [{at_s: 11, action: kill, agents: [agent-01]}]
"""


def test_what_an_agent_did_not_take_of_a_queue_before_it_was_lost_is_told(tmp_path):
    idle = READER.replace('.frames("received")', ".collect() or ()").replace("[-1]", "")
    (tmp_path / "line.py").write_text(FRAMES + idle)
    (tmp_path / "killed.yaml").write_text(KILLED)
    cosmos = CosmosCommand(tmp_path)

    code, run = cosmos.run(tmp_path / "killed.yaml", *LOOSE)

    assert code == 0, run["verdict"]
    result = json.loads((cosmos.directory(run) / "result.json").read_text())
    lost, other = (result["agents"][name]["records"] for name in ("agent-01", "agent-02"))
    dropped = [records["device_losses"]["line"]["frames_dropped"] for records in (lost, other)]
    assert dropped == [901, 1401], "of those up to its last tick all but 10,000"
    told = [text for text in run["remarks"] if "there was no room for all" in text]
    assert [text.partition(":")[0] for text in told] == ["agent-01", "agent-02"]


def test_devices_go_on_while_their_agents_take_no_step_or_are_away(tmp_path):
    scenario = tmp_path / "even.yaml"
    scenario.write_text(
        SCENARIO
        + "on_agent_loss: continue\n"
        + "timeline:\n"
        + "  - {at_s: 0, action: kill, agents: [agent-01], for_s: 1}\n"
        + "  - {at_s: 2, action: kill, agents: [agent-01]}\n"
        + "  - {at_s: 0, action: hang, agents: [agent-02]}\n"
    )

    code, result = CosmosCommand(tmp_path).run(scenario, *LOOSE)

    assert code == 0, result["verdict"]
    told = {each: result["devices"][f"{each}/gps"] for each in ("agent-01", "agent-02")}
    assert {each: (of["samples"], of["stale_ratio"]) for each, of in told.items()} == {
        "agent-01": (60, 0.0),
        "agent-02": (60, 0.0),
    }


@pytest.mark.parametrize(
    ("duration_s", "lost", "stale_ratio"), [(6, 0, 0.0), (6, 1, 0.0), (0.05, 0, 0.0)]
)
def test_a_device_counts_up_to_the_end_of_the_run_behind_the_last_tick(
    tmp_path, duration_s, lost, stale_ratio
):
    scenario = tmp_path / "even.yaml"
    fault = "{at_s: 5.99, action: device_fault, agents: [agent-01], device: gps, fault: disconnect}"
    scenario.write_text(SCENARIO + f"timeline: [{fault if lost else ''}]\n")
    cosmos = CosmosCommand(tmp_path)

    code, result = cosmos.run(scenario, *LOOSE, f"time.duration_s={duration_s}")

    told = result["devices"]["agent-01/gps"]
    assert (code, told["lost"], told["stale_ratio"]) == (4 * lost, lost, stale_ratio)
    assert told["status"] == ("lost" if lost else "ok")


@pytest.mark.parametrize("ends", [True, False])
def test_what_a_driver_raises_while_its_agent_hangs_is_told(tmp_path, ends):
    raising = VALVE.replace(
        "        self.count",
        "        if t_s > 2.0:\n            raise OSError('it leaks')\n        self.count",
    )
    (tmp_path / "valve.py").write_text(raising)
    (tmp_path / "mover.py").write_text(MOVER)
    scenario = tmp_path / "moved.yaml"
    length = ", for_s: 2" if ends else ""
    hang = f'  - {{at_s: 1, action: hang, agents: ["*"]{length}}}\n'
    scenario.write_text(MOVED.partition("timeline:")[0] + "timeline:\n" + hang)

    code, result = CosmosCommand(tmp_path).run(scenario, *LOOSE)

    if ends:
        assert code == 1
        assert "Valve.sample_at raised OSError: it leaks (valve.py:19)" in result["verdict"]
        assert "agent-01" in result["verdict"]
        return
    assert code == 4
    device = result["devices"]["agent-01/valve"]
    assert (device["errors"], device["status"]) == (1, "lost")
    assert "it leaks (valve.py:19)" in device["why"]
    assert device["stale_ratio"] > 0.5
