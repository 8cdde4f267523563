"""`cosmos run --check` says what a run here would meet, and leaves no trace."""

from __future__ import annotations

import json
import socket
from types import SimpleNamespace

import pytest

from cosmos_cli.app import run as cosmos
from cosmos_cli.launch import rehearsal
from cosmos_cli.models.loading import load_scenario

SCENARIO = """
name: checked
simulation: counter
agents: {count: 3, tick_hz: 10}
time: {duration_s: 1}
"""


@pytest.fixture
def place(tmp_path, monkeypatch):
    for name in ("COSMOS_RUNS", "COSMOS_INVENTORY", "COSMOS_LIMIT"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.yaml").write_text(SCENARIO)
    return tmp_path


def check(capsys, *arguments):
    code = cosmos(["run", "s.yaml", "--check", "--json", *arguments])
    answer = json.loads(capsys.readouterr().out)
    assert answer["exit_code"] == code
    return code, answer


def test_run_that_can_start_is_ready_and_nothing_is_there_afterwards(place, capsys):
    code, answer = check(capsys)

    assert code == 0
    assert answer["here"] == [] and answer["machines"] == [] and answer["up"] is None
    assert sorted(path.name for path in place.iterdir()) == ["s.yaml"]
    assert cosmos(["run", "s.yaml", "--check"]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == "READY: 3 agents on this computer; nothing was changed"


def test_plan_and_inequalities_are_shown_as_help_promises(place, capsys):
    assert cosmos(["run", "s.yaml", "--check"]) == 0
    told = capsys.readouterr().out

    assert "agent-01, agent-02, agent-03" in told
    assert "3 agents keep real time" in told
    _, answer = check(capsys)
    assert answer["feasibility"]["holds"] is True
    assert answer["capacity"]["agents"] >= 3


def test_lockstep_is_shown_without_inequalities(place, capsys):
    code, answer = check(capsys, "--set", "time.mode=lockstep")

    assert (code, answer["feasibility"], answer["warnings"]) == (0, None, [])
    assert cosmos(["run", "s.yaml", "--check", "--set", "time.mode=lockstep"]) == 0
    assert "the inequalities of real time do not apply" in capsys.readouterr().out


def test_broken_inequality_is_a_warning_as_a_run_starts_nevertheless(place, capsys):
    many = ("--set", "agents.count=4000", "--set", "agents.tick_hz=1000")
    code, answer = check(capsys, *many)

    (warning,) = answer["warnings"]
    assert code == 0
    assert answer["feasibility"]["holds"] is False
    assert "inequality 2.10 is broken" in warning
    cosmos(["run", "s.yaml", "--check", *many])
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("READY: 4000 agents on this computer, but it cannot keep real time")


def test_more_agents_than_are_predicted_are_not_said_to_keep_real_time(place, capsys):
    quick = ("--set", "agents.tick_hz=10000", "--set", "plan.latency_ms=0.001")

    assert cosmos(["run", "s.yaml", "--check", *quick]) == 0

    told = capsys.readouterr().out
    assert "3 agents may not keep real time: the inequalities hold, but up to 0 are" in told
    doubt = "but it may not keep real time (up to 0 agents are predicted, by "
    assert doubt in told.splitlines()[-1]
    _, answer = check(capsys, *quick)
    assert answer["feasibility"]["holds"] is True
    assert answer["capacity"]["agents"] == 0
    (warning,) = answer["warnings"]
    assert answer["capacity"]["binding"] in warning


@pytest.mark.process
def test_simulation_that_cannot_say_what_it_asks_for_is_a_warning(place, capsys):
    plugin = """
from dataclasses import dataclass
from madns_runtime.plugin.api import AgentSimulation, HostSimulation, Simulation
@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    pass
class Host(HostSimulation):
    pass
class Agent(AgentSimulation):
    pass
def demand(*everything):
    raise ValueError("no idea")
simulation = Simulation(name="p", parameters=Parameters, host=":Host", agent=":Agent", demand=":demand")
"""
    (place / "p.py").write_text(plugin)

    code, answer = check(capsys, "--set", "simulation=./p.py:simulation")

    assert (code, answer["feasibility"]) == (0, None)
    assert "no idea" in answer["warnings"][0]


def test_access_that_is_none_is_refused_as_the_run_would(place, capsys, monkeypatch):
    monkeypatch.setenv("COSMOS_ACCESS", "world")

    assert cosmos(["run", "s.yaml", "--check"]) == 2
    assert "COSMOS_ACCESS: expected one of" in capsys.readouterr().err


def test_folder_of_runs_that_is_none_is_named(place, capsys):
    (place / "file").write_text("")

    code, answer = check(capsys, "--runs", "file")

    assert code == 2
    assert "cannot be written" in answer["here"][0]["text"]


def test_folder_of_runs_that_cannot_be_looked_at_is_named(place, capsys):
    code, answer = check(capsys, "--runs", "r" * 300)

    assert code == 2
    assert answer["here"] == [
        {
            "text": f"{'r' * 300}: File name too long",
            "cure": "choose another folder with --runs",
        }
    ]


def test_room_for_the_records_is_asked_for(place, capsys, monkeypatch):
    monkeypatch.setattr(rehearsal, "RECORD_BYTES_A_TICK", 1e18)

    code, answer = check(capsys)

    assert code == 2
    assert "free, " in answer["here"][0]["text"]
    assert answer["here"][0]["cure"] == "choose another folder with --runs"


def test_port_that_is_taken_is_named(place, capsys):
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as taken:
        taken.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
        taken.bind(("", 0))
        port = taken.getsockname()[1]

        code, answer = check(capsys, "--set", f"network.port={port}")

    assert code == 2
    assert answer["here"][0]["text"] == f"network.port: UDP port {port} is taken here"


@pytest.mark.parametrize(
    "words",
    [
        ["--manual", "nobody"],
        ["--set", "agents.count=0"],
        ["--set", "time.mode=lockstep", "-i", "pi01,"],
    ],
)
def test_what_a_run_would_refuse_is_refused(place, capsys, words):
    assert cosmos(["run", "s.yaml", "--check", *words]) == 2


def test_machine_that_is_not_reached_is_named(place, capsys):
    code, answer = check(capsys, "-i", "no-such-machine.invalid,")

    (machine,) = answer["machines"]
    assert code == 3
    assert (machine["ok"], machine["is_ready"]) == (False, False)
    assert machine["failure"]["kind"] == "unreachable"
    assert answer["plan"]["machines"]["no-such-machine.invalid"]["agents"]


@pytest.mark.parametrize(
    ("said", "given", "asked"),
    [
        ("127.0.0.1", None, "10.0.0.1"),
        ("10.9.9.9", None, "10.9.9.9"),
        ("10.9.9.9", "192.0.2.9", "192.0.2.9"),
    ],
)
def test_datagrams_are_tried_by_the_address_that_the_run_would_use(place, said, given, asked):
    scenario = load_scenario(place / "s.yaml", overrides=[f"network.address={said}"])
    trial = rehearsal.Rehearsal(
        plan=SimpleNamespace(host=None), scenario=scenario, runs=place, options=None, forks=1
    )
    told = []

    class Board:
        def call(self, verb, arguments, *, timeout_s):
            told.append(arguments["address"])
            return SimpleNamespace(value={})

    machine = SimpleNamespace(variables=SimpleNamespace(cosmos_host_address=given))

    trial._trips(
        Board(),
        SimpleNamespace(own_address="10.0.0.1"),
        machine,
        SimpleNamespace(port=1, nonce=b"n" * 16),
    )

    assert told == [asked]
