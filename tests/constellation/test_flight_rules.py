"""Rules of flight software as a scenario writes them: names in braces, and the faults that validate tells."""

import json
import random
import sys

import pytest
from constellation_fakes import WALKER, parameters

from cosmos_cli.errors import InputError
from cosmos_cli.models.loading import load_scenario
from madns_runtime.simulations.constellation.check import find_faults
from madns_runtime.simulations.constellation.check_flight import SETTING_BYTES_MAX
from madns_runtime.simulations.constellation.flight.interface import content
from madns_runtime.simulations.constellation.flight.interface.json_lines import JsonLines
from madns_runtime.simulations.constellation.substitution import substitute, unknown_names

AGENTS = ("agent-01", "agent-02")
VALUES = {"name": "agent-01", "index": "0", "satellite": "SAT A"}
TCP = {"kind": "tcp", "address": "127.0.0.1:4000"}


@pytest.mark.parametrize(
    ("text", "got"),
    [
        ("plain $HOME {name}", "plain $HOME {name}"),
        ("${name}/${index}${index}", "agent-01/00"),
        ("${satellite}", "SAT A"),
        ("$${name} $$${name}", "${name} $${name}"),
        ("${other} ${name", "${other} ${name"),
    ],
)
def test_names_in_braces_are_replaced(text, got):
    assert substitute(text, VALUES) == got


def test_what_stands_for_nothing_is_found():
    assert unknown_names("${name} ${} ${x} $${y} ${z", ("name",)) == ["${}", "${x}", "${z"]


def faults(tmp_path, flight, **more):
    (tmp_path / "guidance.py").write_text("class G:\n    def step(self, t_s, readings): ...\n")
    return find_faults(parameters(WALKER, flight=flight), 2, tmp_path, AGENTS, 0.0, **more)


def program(**rest):
    return {"command": [sys.executable], **rest}


@pytest.mark.parametrize(
    "flight",
    [
        [],
        ["guidance.py:G"],
        [{"software": "guidance.py:G", "agents": ["agent-02"]}, program()],
        program(environment={"A": "$${x} ${satellite} ${address}"}),
        {"command": ["${name}/software"]},
        {"interface": {"transport": TCP, "protocol": "frames", "clock": "own"}},
        {"interface": {"transport": {"kind": "tcp", "address": "127.0.0.1:400${index}"}}},
        program(interface={"transport": {"kind": "pty"}, "protocol": "space_packets"}),
        program(interface={"protocol": "guidance.py:G"}),
    ],
)
def test_rules_without_fault_have_none(tmp_path, flight):
    assert faults(tmp_path, flight) == []


MCU = {"kind": "device", "device": "mcu"}
VALVE = {"channel": "valve.line", "command": "delta_v", "vector": [1, 0, 0]}


def read_scenario_faults(tmp_path, change):
    """Return the faults of a scenario with other parameters, as `cosmos validate` tells them."""
    path = tmp_path / "scenario.yaml"
    document = {
        "name": "rules",
        "simulation": "constellation",
        "agents": {"count": 2, "tick_hz": 10},
        "time": {"mode": "realtime", "duration_s": 3},
        "hardware": {"armed": True},
        "parameters": {
            "satellites": {"walker": "56:2/1/0", "altitude_km": 780},
            "epoch_utc": "2026-01-01T00:00:00Z",
            "propagator": {"kind": "scipy", "forces": ["two_body"]},
            **change,
        },
    }
    path.write_text(json.dumps(document))
    with pytest.raises(InputError) as refused:
        load_scenario(path)
    faults = refused.value.faults
    return list(dict.fromkeys(f"{fault.path}: {fault.text}" for fault in faults))


@pytest.mark.parametrize(
    ("flight", "words"),
    [
        (["guidance.py:G", "none.py:G"], "parameters.flight[1]: no such file"),
        ([program(), program(agents=["x*"])], "parameters.flight[1].agents: 'x*' fits no agent"),
        (program(agents=["x*"]), "parameters.flight.agents: 'x*' fits no agent"),
        ([{"command": ["no-such"]}], "parameters.flight[0].command: no program 'no-such'"),
        (
            {"command": [sys.executable, "${nmae}"]},
            "parameters.flight.command[1]: expected one of ${name}, ${index}, ${satellite}, "
            "${address}, got ${nmae}; $${ stands for ${ itself",
        ),
        (program(environment={"A": "${pty}"}), "parameters.flight.environment.A: expected one of"),
        ({"interface": {}}, "parameters.flight.interface.transport: stdio is that of a program"),
        (
            {"interface": {"transport": TCP, "protocol": "morse"}},
            "parameters.flight.interface.protocol: expected json_lines, frames, space_packets or "
            "file.py:Class, got 'morse'",
        ),
        (
            [{"interface": {"transport": {"kind": "unix", "path": "${pty}"}}}],
            "parameters.flight[0].interface.transport.path: expected one of ${name}",
        ),
        (
            {"interface": {"transport": {"kind": "udp", "local": "4000"}}},
            "parameters.flight.interface.transport.local: expected HOST:PORT, got '4000'",
        ),
        (
            {"interface": {"transport": {"kind": "tcp", "address": "mcu:99999"}}},
            "parameters.flight.interface.transport.address: expected a port of at most 65535",
        ),
        (
            {"interface": {"transport": {"kind": "tcp", "address": "mcu:0"}}},
            "parameters.flight.interface.transport.address: expected the port that the software",
        ),
        (
            program(interface={"protocol": "frames"}, settings={"a" * 33: 1.0}),
            "parameters.flight.settings: expected names of at most 32 bytes",
        ),
        (
            program(interface={"protocol": "space_packets"}, settings={"way": "x" * 49}),
            "parameters.flight.settings.way: expected a text of at most 48 bytes",
        ),
    ],
)
def test_faults_name_their_rule(tmp_path, flight, words):
    (fault,) = faults(tmp_path, flight)

    assert fault.startswith(words)


def test_settings_are_held_to_the_fields_of_their_struct():
    codes = {each.name: each.code for each in content.SETTING.fields}

    assert {name: f"{most}s" for name, most in SETTING_BYTES_MAX.items()} == {
        name: codes[name] for name in SETTING_BYTES_MAX
    }


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"flight": {"interface": {"transport": MCU}}}, "flight.interface.transport.device"),
        (
            {"vehicles": [{"actuation": [VALVE]}]},
            "vehicles[0].actuation[0].channel",
        ),
    ],
)
def test_devices_that_an_agent_does_not_use_are_found_before_a_run(tmp_path, change, field):
    found = read_scenario_faults(tmp_path, change)

    (fault,) = found
    assert f"parameters.{field}: expected a device that the agent uses (none)" in fault
    assert fault.endswith("(of agent-01, agent-02)")


def test_a_slip_in_a_transport_is_told_there(tmp_path):
    smoke = {"command": [sys.executable], "interface": {"transport": {"kind": "smoke"}}}

    (fault,) = read_scenario_faults(tmp_path, {"flight": [smoke]})

    assert "interface.transport.kind: expected stdio or pty" in fault


def test_a_clock_of_its_own_is_refused_in_lockstep(tmp_path):
    flight = [program(), {"interface": {"transport": TCP, "clock": "own"}}]

    (fault,) = faults(tmp_path, flight, is_lockstep=True)

    assert fault.startswith(
        "parameters.flight[1].interface.clock: software with a clock of its own"
    )
    assert faults(tmp_path, flight, is_lockstep=False) == []


def test_seeded_noise_in_lines_is_a_fault_in_words_and_raises_nothing():
    chance = random.Random(13)
    whole = b'{"t_s":0.1,"commands":[{"delta_v_m_s":[0,0.1,0],"at_s":3.1}],"estimate":{"a":1}}\n'
    protocol = JsonLines()
    answers = []
    for _ in range(500):
        data = bytearray(whole)
        for _ in range(chance.randrange(4)):
            data[chance.randrange(len(data))] = chance.randrange(256)
        answers += protocol.feed(bytes(data))

    assert len(answers) > 490
    assert sum(bool(one.fault) for one in answers) > 100
    assert all(one.fault.isprintable() for one in answers)
