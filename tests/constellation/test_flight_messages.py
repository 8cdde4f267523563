"""The schema of the lines between vehicle and flight program: generated, and held by real programs in both directions."""

import functools
import json
import shutil
import sys
from pathlib import Path

import jsonschema
import pytest
from harness.cosmos_command import CosmosCommand

from madns_runtime.errors import BlamedError
from madns_runtime.simulations.constellation.flight.interface.answers import carry_out
from madns_runtime.simulations.constellation.flight.interface.json_lines import (
    message_schema,
    read_answer,
)

ROOT = Path(__file__).resolve().parents[2]
SCHEMA = json.loads((ROOT / "docs/flight-messages.schema.json").read_text("utf-8"))

SCENARIO = """
name: spoken
simulation: constellation
agents: {{count: {count}, tick_hz: 10}}
time: {{mode: lockstep, duration_s: 12}}
parameters:
  satellites: {{walker: "56:{count}/1/0", altitude_km: 780}}
  epoch_utc: "2026-01-01T00:00:00Z"
  propagator: {{kind: scipy, forces: [two_body]}}
  crosslinks: {{range_km_max: 20000}}
  vehicles:
    - thruster: {{isp_s: 220, propellant_kg: 5}}
      sensors: {{gnss: {{rate_hz: 10, noise: 1.0, velocity_noise_m_s: 0.001}}}}
  flight:
    command: [./spied.sh]
    answer_s: 60
    settings: {{a_m: 7160000, tolerance_m: 50, lead_s: 3}}
"""
SPY = """#!/bin/sh
# Runs the program, and keeps what is said in both directions.
tee "said/$$.in" | {command} | tee "said/$$.out"
"""
TALKER = """
import json, sys
for line in sys.stdin:
    told = json.loads(line)
    if "setup" in told:
        continue
    answer = {"t_s": told["t_s"], "estimate": {"heard_1": len(told["messages"])}}
    number = round(told["t_s"] * 10)
    if number == 10:
        answer["send"] = [{"to": "*", "payload": {"x": [1, None, "y"]}}, {"to": "agent-02", "payload": 7}]
        answer["send"].append({"to": "ground:nowhere", "payload": "lost"})
        answer["log"] = [{"level": "info", "text": "sending"}]
    if number == 20:
        answer["commands"] = [{"delta_v_m_s": [0, 0.1, 0], "at_s": told["t_s"] + 3, "frame": "rtn"}]
        answer["commands"].append({"delta_v_m_s": [0, 9000, 0], "at_s": told["t_s"] + 4})
    print(json.dumps(answer), flush=True)
"""


@functools.cache
def validator(name):
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    return jsonschema.Draft202012Validator({**SCHEMA, "anyOf": [{"$ref": f"#/$defs/{name}"}]})


def fly(folder, command, count):
    """Fly a program in a real run, and return what was said to it and by it."""
    (folder / "said").mkdir()
    (folder / "spied.sh").write_text(SPY.format(command=command))
    (folder / "spied.sh").chmod(0o755)
    (folder / "spoken.yaml").write_text(SCENARIO.format(count=count))
    done = CosmosCommand(folder)("run", "spoken.yaml", "--quiet", "--no-report")
    assert done.returncode == 0, done.stderr
    return [
        [
            json.loads(line)
            for path in (folder / "said").glob(f"*.{end}")
            for line in path.read_text().splitlines()
        ]
        for end in ("in", "out")
    ]


def hold(lines, name):
    """Hold lines against the schema of a direction."""
    check = validator(name)
    for line in lines:
        check.validate(line)


@pytest.mark.process
def test_the_example_in_c_says_and_hears_what_the_schema_holds(tmp_path):
    if shutil.which("cc") is None:
        pytest.skip("no C compiler")
    for name in ("hold.c", "hold.sh"):
        shutil.copy(ROOT / "scenarios/flight" / name, tmp_path / name)

    told, said = fly(tmp_path, "./hold.sh", 2)

    assert len(told) == 2 * 121 and len(said) == 2 * 120
    hold(told, "to_program")
    hold(said, "from_program")
    assert any(line.get("commands") for line in said)
    assert {result["status"] for line in told for result in line.get("results", ())} >= {"accepted"}


@pytest.mark.process
def test_messages_results_and_refusals_of_a_real_run_are_in_the_schema(tmp_path):
    (tmp_path / "talker.py").write_text(TALKER)

    told, said = fly(tmp_path, f"{sys.executable} talker.py", 9)

    hold(told, "to_program")
    hold(said, "from_program")
    for part in ("messages", "results", "refusals"):
        assert any(line.get(part) for line in told), part
    assert any("send" in line for line in said) and any("log" in line for line in said)


def test_the_file_is_what_the_code_says():
    assert message_schema() == SCHEMA


class Deaf:
    """A context that takes whatever it is told."""

    def __getattr__(self, name):
        return lambda *_, **__: 0


@pytest.mark.parametrize(
    "answer",
    [
        {},
        {"t_s": 1.0},
        {"commands": [], "send": [], "log": [], "estimate": None},
        {"estimate": {"a_m": None}},
        {"commands": [{"delta_v_m_s": [0, 1, 0], "at_s": 3}], "estimate": {"a_m": 7e6}},
        {"commands": [{"torque_n_m": [0, 1, 0], "at_s": 3, "duration_s": 1}]},
        {"commands": [{"ballistic_m2_kg": 0.01, "at_s": 3}]},
        {"send": [{"to": "*", "payload": None}], "log": [{"level": "debug", "text": ""}]},
    ],
)
def test_what_the_code_takes_the_schema_takes(answer):
    carry_out(read_answer(json.dumps(answer).encode()), Deaf(), "x", t_s=1.0)

    assert validator("from_program").is_valid(answer)


@pytest.mark.parametrize(
    "answer",
    [
        [],
        {"word": 1},
        {"commands": {}},
        {"commands": None},
        {"commands": [{"at_s": 1.0}]},
        {"commands": [{"delta_v_m_s": [0, 0, 1]}]},
        {"commands": [{"delta_v_m_s": [0, 0, 1], "at_s": 1, "duration_s": 2}]},
        {"commands": [{"torque_n_m": [0, 0, 1], "ballistic_m2_kg": 1, "at_s": 1}]},
        {"send": [{"to": "agent-02"}]},
        {"send": ["hello"]},
        {"log": [{"text": "x"}]},
    ],
)
def test_what_the_code_refuses_the_schema_refuses(answer):
    with pytest.raises(BlamedError):
        carry_out(read_answer(json.dumps(answer).encode()), Deaf(), "x", t_s=1.0)

    assert not validator("from_program").is_valid(answer)


@pytest.mark.parametrize(
    "answer", [{"{}": 1}, {"log": [{"{}": ""}]}, {"commands": [{"delta_v_m_s": 0, "{}": 1}]}]
)
@pytest.mark.parametrize("key", ["A\nPASSED: 9 checks hold", "A\x1b[2J", "A" * 10_000])
def test_a_key_that_a_program_made_up_is_told_in_one_line(answer, key):
    line = json.dumps(answer).replace("{}", json.dumps(key)[1:-1]).encode()

    fault = read_answer(line).fault

    assert "got" in fault and "A" in fault
    assert fault.isprintable()
    assert len(fault) < 400
