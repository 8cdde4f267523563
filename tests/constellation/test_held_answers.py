"""Answers of a program in the rerun of a run in real time: carried out in the ticks in which they were carried out then."""

import json

import pytest
from harness.cosmos_command import CosmosCommand

from madns_runtime.simulations.constellation.flight.held_answers import HeldAnswers
from madns_runtime.simulations.constellation.flight.interface.answers import FlightAnswer

ANSWERS = [FlightAnswer(source=bytes([number])) for number in range(3)]
PROGRAM = """
import json
import sys

for line in sys.stdin:
    report = json.loads(line)
    if "setup" in report:
        continue
    burn = {"delta_v_m_s": [0, 0.01, 0], "at_s": report["t_s"] + 1.5}
    is_time = round(10 * report["t_s"]) % 5 == 0
    print(json.dumps({"commands": [burn] if is_time else []}), flush=True)
"""
SCENARIO = """
name: burns
simulation: constellation
agents: {count: 1, tick_hz: 10}
time: {mode: lockstep, duration_s: 1.5}
parameters:
  satellites: {walker: "56:1/1/0", altitude_km: 780}
  epoch_utc: 2026-01-01T00:00:00Z
  vehicles: [{thruster: {isp_s: 220, propellant_kg: 5}}]
  flight: {command: [python3, burns.py], input: truth}
"""


def taken(held, *times_s):
    return [[ANSWERS.index(answer) for answer, _ in held.take(t_s)] for t_s in times_s]


def test_an_answer_is_carried_out_in_the_tick_behind_that_which_it_answers(tmp_path):
    held = HeldAnswers(tmp_path, 10.0)
    held.hold(ANSWERS[0], 0.1)

    assert held.take(0.1) == []
    assert held.take(0.2) == [(ANSWERS[0], 0.1)]
    assert held.take(0.3) == []


def test_one_that_took_longer_than_a_tick_holds_up_those_behind_it(tmp_path):
    (tmp_path / "flight_answers.jsonl").write_text(
        '{"schema":1,"stream":"flight_answers","shape":"array","fields":[{"name":"tick","unit":"","kind":"int"},'
        '{"name":"t_s","unit":"s","kind":"float"},{"name":"answer_us","unit":"us","kind":"float"}]}\n'
        "[1,0.1,250000.0]\n[2,0.2,1000.0]\n"
    )
    held = HeldAnswers(tmp_path, 10.0)
    for answer, asked_s in zip(ANSWERS, (0.1, 0.2), strict=False):
        held.hold(answer, asked_s)

    assert taken(held, 0.2, 0.3, 0.4, 0.5) == [[], [], [0, 1], []]


def test_steps_of_one_tick_are_answered_in_the_next(tmp_path):
    held = HeldAnswers(tmp_path, 10.0)
    for answer, asked_s in zip(ANSWERS, (0.92, 0.98, 1.0), strict=False):
        held.hold(answer, asked_s)

    assert taken(held, 0.98, 1.0, 1.02, 1.04) == [[], [], [0, 1, 2], []]


@pytest.mark.process
def test_a_rerun_of_real_time_has_a_programs_commands_in_their_ticks(tmp_path):
    (tmp_path / "burns.py").write_text(PROGRAM)
    (tmp_path / "burns.yaml").write_text(SCENARIO)
    (tmp_path / "agents" / "agent-01").mkdir(parents=True)
    for stream in ("commands", "command_results"):
        (tmp_path / "agents" / "agent-01" / f"{stream}.jsonl").write_text(
            f'{{"schema":1,"stream":"{stream}","shape":"array","fields":[]}}\n'
        )
    cosmos = CosmosCommand(tmp_path)

    ticks = []
    for settings in ([f"parameters.recorded_agents={tmp_path / 'agents'}"], []):
        _, document = cosmos.run(tmp_path / "burns.yaml", *settings)
        assert document["status"] == "complete", document["verdict"]
        path = cosmos.directory(document) / "agents" / "agent-01" / "commands.jsonl"
        rows = [json.loads(line) for line in path.read_text().splitlines()]
        ticks.append([row[0] for row in rows if isinstance(row, list)])

    assert ticks == [[1, 6, 11], [0, 5, 10]]
