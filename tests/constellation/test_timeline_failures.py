"""Failures in whole lockstep runs: measurements change and truth does not, or truth does as the failure says."""

import json
import shutil
import time
from collections import Counter

import pytest
import yaml
from harness.cosmos_command import SCENARIOS, CosmosCommand

pytestmark = pytest.mark.process


@pytest.fixture
def cosmos(tmp_path):
    return CosmosCommand(tmp_path)


def rows(folder, agent, stream):
    lines = (folder / "agents" / agent / f"{stream}.jsonl").read_text().splitlines()
    return [row for line in lines if isinstance(row := json.loads(line), list)]


def write(folder, name, timeline):
    scenario = yaml.safe_load((SCENARIOS / "iridium10.yaml").read_text())
    scenario |= {
        "name": name,
        "agents": {"count": 2, "tick_hz": 1},
        "time": {"mode": "lockstep", "duration_s": 60},
        "timeline": timeline,
    }
    scenario["parameters"]["vehicles"] = [{"sensors": {"gnss": {"rate_hz": 1, "noise": 0}}}]
    scenario["parameters"]["satellites"] = {"walker": "86.4:2/2/0", "altitude_km": 780}
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(scenario))
    return path


def test_a_biased_receiver_measures_beside_the_truth_which_stays_as_it_was(cosmos, tmp_path):
    bias = {
        "at_s": 20,
        "action": "sensor_fault",
        "agents": ["agent-01"],
        "sensor": "gnss",
        "fault": "biased",
        "bias": [500.0],
        "for_s": 20,
    }
    runs = {}
    for name, timeline in (("undisturbed", []), ("biased", [bias])):
        code, result = cosmos.run(write(tmp_path, name, timeline))
        assert code == 0, result
        runs[name] = cosmos.directory(result)

    for agent in ("agent-01", "agent-02"):
        states = [rows(folder, agent, "state") for folder in runs.values()]
        assert states[0] == states[1]
    measured = [rows(folder, "agent-01", "gnss") for folder in runs.values()]
    moved = {round(b[1]): round(b[2] - a[2], 3) for a, b in zip(*measured, strict=True)}
    assert {t_s for t_s, by_m in moved.items() if by_m == 500.0} == set(range(20, 40))
    assert {by_m for t_s, by_m in moved.items() if not 20 <= t_s < 40} == {0.0}


@pytest.mark.nightly
def test_a_receiver_stays_biased_over_a_restart_of_its_agent_until_its_end(cosmos, tmp_path):
    fault = {"action": "sensor_fault", "sensor": "gnss", "fault": "biased", "bias": [500.0]}
    both = ["agent-01", "agent-02"]
    restart = {"at_s": 10, "action": "restart", "agents": both}
    # One that lasts over the restart, and one that was over before: its end lifts nothing.
    biased = {"at_s": 5, "agents": ["agent-01"], "for_s": 30} | fault
    over = {"at_s": 5, "agents": ["agent-02"], "for_s": 3} | fault
    runs = {}
    for name, timeline in (("sound", [restart]), ("biased", [biased, over, restart])):
        code, result = cosmos.run(write(tmp_path, name, timeline), "on_agent_loss=continue")
        assert code == 0, result
        runs[name] = cosmos.directory(result)

    moved = {}
    for agent in both:
        measured = [rows(folder, agent, "gnss.2") for folder in runs.values()]
        by_m = [(round(a[1]), round(b[2] - a[2], 3)) for a, b in zip(*measured, strict=True)]
        moved[agent] = [t_s for t_s, metres in by_m if metres == 500.0]
    assert moved["agent-01"][-1] == 34 and len(moved["agent-01"]) >= 23
    assert moved["agent-02"] == []
    events = (runs["biased"] / "host/events.jsonl").read_text().splitlines()
    resumed = [e for e in map(json.loads, events) if e.get("event") == "action_resumed"]
    assert [(e["agent"], e["action"]) for e in resumed] == [("agent-01", "sensor_fault")]


def test_a_stuck_thruster_repeats_to_the_bit_and_moves_its_vehicle_alone(cosmos, tmp_path):
    stuck = {"at_s": 10, "action": "stick_thruster_open", "agents": ["agent-01"], "for_s": 30}
    thruster = "{isp_s: 220, propellant_kg: 2, thrust_n: 1}"
    vehicles = f"parameters.vehicles=[{{thruster: {thruster}}}]"
    path = write(tmp_path, "stuck", [stuck])

    runs = [cosmos.run(path, vehicles, f"agents.per_process={number}") for number in (1, 2)]
    code, undisturbed = cosmos.run(write(tmp_path, "sound", []), vehicles)

    assert [code, *(code for code, _ in runs)] == [0, 0, 0]
    assert runs[0][1]["records_sha256"] == runs[1][1]["records_sha256"]
    folders = [cosmos.directory(result) for result in (runs[0][1], undisturbed)]
    ours, theirs = (rows(folder, "agent-01", "state") for folder in folders)
    assert [one == other for one, other in zip(ours, theirs, strict=True)].index(False) == 11
    assert rows(folders[0], "agent-02", "state") == rows(folders[1], "agent-02", "state")
    lines = (folders[0] / "host/stuck_thrusters.jsonl").read_text().splitlines()
    left_kg = [row[4] for row in map(json.loads, lines) if isinstance(row, list)]
    assert left_kg[0] == 2.0
    assert left_kg[-1] == pytest.approx(2.0 - 30.0 / (220 * 9.80665))


PATIENCE_S = 120.0
RADIO_ACTIONS = [
    {"at_s": 20, "action": "telecommand", "agents": ["agent-01"], "text": "report"},
    {
        "at_s": 25,
        "action": "telecommand",
        "agents": ["IRIDIUM 5"],
        "text": "report",
        "station": "svalbard",
    },
    {"at_s": 30, "action": "lose_satellite", "agents": ["agent-02"], "for_s": 40},
    {"at_s": 80, "action": "darken_station", "station": "svalbard", "for_s": 30},
    # The end of one lights no station that the other still darkens.
    {"at_s": 85, "action": "darken_station", "station": "svalbard", "for_s": 10},
]
RISE_S = 45.525
"""Of IRIDIUM 5, agent-04, over svalbard: tests/authorities/passes.json."""


@pytest.fixture(scope="module")
def passes(tmp_path_factory):
    """The first minutes of the shipped scenario of ground passes with failures, and the same in other processes."""
    folder = tmp_path_factory.mktemp("passes")
    scenario = yaml.safe_load((SCENARIOS / "groundpass.yaml").read_text())
    scenario["parameters"] |= {"uplinks": [], "record": {"state_hz": 1}}
    scenario["parameters"]["flight"]["settings"] = {"status_s": 5, "beacon_s": 5}
    for name in ("data", "flight"):
        shutil.copytree(SCENARIOS / name, folder / name)
    (folder / "passes.yaml").write_text(yaml.safe_dump(scenario | {"timeline": RADIO_ACTIONS}))
    cosmos = CosmosCommand(folder)
    runs = [
        cosmos.run(folder / "passes.yaml", "time.duration_s=150", f"agents.per_process={number}")
        for number in (1, 5)
    ]
    return cosmos.directory(runs[0][1]), [result for _, result in runs], [code for code, _ in runs]


def named(path):
    """Return a stream's records as mappings."""
    head, *lines = map(json.loads, path.read_text().splitlines())
    names = [field["name"] for field in head["fields"]]
    return [dict(zip(names, line, strict=True)) for line in lines if isinstance(line, list)]


@pytest.mark.nightly
def test_failures_of_radio_repeat_to_the_bit_and_break_nothing(passes):
    _, results, codes = passes

    assert codes == [0, 0]
    assert results[0]["records_sha256"] == results[1]["records_sha256"]


def test_downlinks_fail_for_want_of_contact_while_a_station_is_dark_and_no_longer(passes):
    folder, _, _ = passes
    down = [row for row in named(folder / "host/links.jsonl") if row["sender"] == "agent-04"]
    seen = [row for row in down if row["to"].startswith("ground") and row["sent_s"] > RISE_S]

    dark = [row["sent_s"] for row in seen if row["outcome"] == "no_contact"]
    lit = [row["sent_s"] for row in seen if row["outcome"] == "delivered"]
    assert len(dark) >= 5
    assert len(lit) >= 10
    assert all(80 <= t_s < 110 for t_s in dark)
    assert not any(80 <= t_s < 110 for t_s in lit)


def test_a_telecommand_comes_at_once_or_waits_for_its_stations_contact(passes):
    folder, _, _ = passes

    def heard(agent):
        rows = named(folder / "agents" / agent / "messages.jsonl")
        return [
            (row["tick"], row["peer"])
            for row in rows
            if row["way"] == "received" and row["peer"].startswith("ground")
        ]

    assert heard("agent-01") == [(20, "ground")]
    ((tick, station),) = heard("agent-04")
    assert station == "ground:svalbard"
    assert tick == 46


def test_a_lost_satellite_says_and_hears_nothing_and_comes_back(passes):
    folder, results, _ = passes

    ticks = [row["tick"] for row in named(folder / "agents/agent-02/messages.jsonl")]
    assert not [tick for tick in ticks if 30 <= tick < 70]
    assert min(ticks) < 30
    assert max(ticks) >= 70
    links = named(folder / "host/links.jsonl")
    meanwhile = [row for row in links if 30 <= row["sent_s"] < 70 and row["to"] == "agent-02"]
    assert {row["outcome"] for row in meanwhile} <= {"lost"}
    assert any(
        row["outcome"] == "delivered"
        for row in links
        if row["to"] == "agent-02" and row["sent_s"] < 30
    )
    states = named(folder / "agents/agent-02/state.jsonl")
    assert [row["tick"] for row in states] == list(range(150))
    agents = results[0]["agents"]
    assert (agents["lost"], agents["lost_on_purpose"]) == ([], ["agent-02"])


def test_a_living_run_lists_its_actions_and_takes_them_by_their_words(cosmos, tmp_path):
    path = write(tmp_path, "living", [])

    def inject(*arguments):
        done = cosmos("inject", "last", *arguments, "--json")
        assert done.returncode in (0, 1), done.stderr
        return json.loads(done.stdout)

    with cosmos.start_run(path, "time.duration_s=1e7") as run:
        deadline_s = time.monotonic() + PATIENCE_S
        while not list(cosmos.runs.glob("*/.actions.sock")):
            assert time.monotonic() < deadline_s
            time.sleep(0.1)
        inject("agent-01", "lose_satellite")
        refused = inject("agent-01", "stick_thruster_open", "thrust_n=1")
        listed = inject("--list")
        inject("run", "stop")
        out, _ = run.communicate(timeout=PATIENCE_S)

    words = {each["action"] for each in listed["actions"]}
    assert {"stick_thruster_open", "lose_satellite", "telecommand", "darken_station"} <= words
    assert [each["action"] for each in listed["in_force"]] == ["lose_satellite"]
    assert refused["refusal"] == "without a thruster in parameters.vehicles: agent-01"
    assert json.loads(out)["agents"]["lost_on_purpose"] == ["agent-01"]


def test_an_action_that_a_vehicle_cannot_carry_out_then_is_refused_on_record(cosmos, tmp_path):
    stuck = {"action": "stick_thruster_open", "agents": ["agent-02"], "thrust_n": 1}
    path = write(tmp_path, "twice", [{"at_s": 3} | stuck, {"at_s": 5} | stuck])

    code, result = cosmos.run(
        path, "parameters.vehicles=[{thruster: {isp_s: 220, propellant_kg: 2}}]"
    )

    events = (cosmos.directory(result) / "host" / "events.jsonl").read_text().splitlines()
    refused = [e for e in map(json.loads, events) if e.get("event") == "action_refused"]
    assert code == 0
    assert [(e["t_s"], e["reason"]) for e in refused] == [
        (5.0, "agent-02: its thruster is stuck open already")
    ]


def test_a_telecommand_that_nobody_can_hear_is_refused_on_record(cosmos, tmp_path):
    text = {"action": "telecommand", "text": "report"}
    kill = {"at_s": 3, "action": "kill", "agents": ["agent-02"], "for_s": 10}
    timeline = [
        kill,
        {"at_s": 5, "agents": ["agent-02"]} | text,
        {"at_s": 6, "agents": ["*"]} | text,
    ]
    path = write(tmp_path, "unheard", timeline)
    shutil.copytree(SCENARIOS / "flight", tmp_path / "flight")

    code, result = cosmos.run(
        path,
        "on_agent_loss=continue",
        "parameters.flight={software: flight/beacon.py:Beacon, input: truth}",
    )

    assert code == 0, result["verdict"]
    assert [each for each in result["remarks"] if each.startswith("timeline")] == [
        "timeline: telecommand was refused 1 time by host: nobody hears it at present: agent-02"
    ]


def test_the_record_of_links_holds_what_faults_made_of_messages_as_the_account_does(
    cosmos, tmp_path
):
    faults = [
        {"at_s": 5, "action": "lose_messages", "agents": ["agent-01"], "for_s": 10},
        {"at_s": 20, "action": "delay_messages", "agents": ["agent-02"], "delay_s": 5, "for_s": 10},
        {"at_s": 35, "action": "duplicate_messages", "agents": ["agent-03"], "for_s": 5},
    ]
    path = write(tmp_path, "touched", [entry | {"traffic": "between_agents"} for entry in faults])
    shutil.copytree(SCENARIOS / "flight", tmp_path / "flight")
    beacon = "flight: {software: 'flight/beacon.py:Beacon', settings: {status_s: 100, beacon_s: 1}}"

    code, result = cosmos.run(
        path,
        "agents.count=3",
        "parameters.satellites.walker='86.4:66/1/0'",
        "parameters.crosslinks={range_km_max: 6000}",
        f"parameters.{beacon.replace(': ', '=', 1)}",
    )

    links = named(cosmos.directory(result) / "host" / "links.jsonl")
    told = Counter(row["outcome"] for row in links)
    account = result["simulation"]["host"]["links"]
    counts = result["faults"]["between_agents"]
    assert code == 0
    assert (told["lost"], told["delivered"]) == (account["lost"], account["delivered"])
    assert told["lost"] == counts["lost"] > 0
    late = [row for row in links if row["arrives_s"] and row["arrives_s"] - row["sent_s"] > 5]
    assert len(late) == counts["late"] > 0
    pairs = Counter((row["sender"], row["number"], row["to"]) for row in links)
    assert sum(count - 1 for count in pairs.values()) == counts["doubled"] > 0
