"""Rules of flight software as a scenario writes them: names in braces, and the faults that validate tells."""

import json
import random
import sys
from pathlib import Path

import pytest
from constellation_fakes import WALKER, parameters

from cosmos_cli.errors import InputError
from cosmos_cli.launch.place_plan import check_places, place_notes
from cosmos_cli.launch.plan import make_plan
from cosmos_cli.models.inventory.machine import Machine, Variables
from cosmos_cli.models.loading import load_scenario
from cosmos_cli.models.place_uses import shared_places
from madns_runtime.simulations.constellation.check import find_faults, place_uses
from madns_runtime.simulations.constellation.check_flight import (
    SETTING_BYTES_MAX,
    _setting_faults,
)
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
    return find_faults(parameters(WALKER, flight=flight), 2, tmp_path, names=AGENTS, **more)


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
        # Who would fly the last one do not fly.
        [program(agents=["agent-01"]), program(agents=["agent-02"]), program()],
        [program(agents=["agent-0[1-4]"]), program(agents=["agent-*"])],
    ],
)
def test_rules_without_fault_have_none(tmp_path, flight):
    assert faults(tmp_path, flight) == []


MCU = {"kind": "device", "device": "mcu"}
VALVE = {"channel": "valve.line", "command": "delta_v", "vector": [1, 0, 0]}


def write_scenario(tmp_path, change, **rest):
    """Write a scenario with other parameters, and sections."""
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
        **rest,
    }
    path.write_text(json.dumps(document))
    return path


def read_scenario_faults(tmp_path, change, **rest):
    """Return the faults of a scenario with other parameters, as `cosmos validate` tells them."""
    path = write_scenario(tmp_path, change, **rest)
    with pytest.raises(InputError) as refused:
        load_scenario(path)
    faults = refused.value.faults
    return list(dict.fromkeys(f"{fault.path}: {fault.text}" for fault in faults))


FAULTS_OF_FLIGHT = [
    (
        [{"software": "guidance.py:G", "agents": ["agent-01"]}, "none.py:G"],
        "parameters.flight[1]: no such file",
    ),
    ([program(), program(agents=["x*"])], "parameters.flight[1].agents: 'x*' fits no agent"),
    (program(agents=["x*"]), "parameters.flight.agents: 'x*' fits no agent"),
    (
        ["guidance.py:G", program(agents=["agent-01"])],
        "parameters.flight[1].agents: expected agents or satellites that no entry before it fits, "
        "got those of parameters.flight[0]: the first that fits holds",
    ),
    ([{"command": ["no-such"]}], "parameters.flight[0].command: no program 'no-such'"),
    (
        {"command": [sys.executable, "${nmae}"]},
        "parameters.flight.command[1]: expected one of ${name}, ${index}, ${satellite}, "
        "${address}, got ${nmae}; $${ stands for ${ itself",
    ),
    (program(environment={"A": "${pty}"}), "parameters.flight.environment.A: expected one of"),
    (
        program(environment={"A=B": "x"}),
        "parameters.flight.environment: expected the name of a variable, without '=' in it, got 'A=B'",
    ),
    (program(environment={"": "x"}), "parameters.flight.environment: expected the name of a var"),
    (
        program(environment={"A": "x\0y"}),
        "parameters.flight.environment.A: expected a text without null characters",
    ),
    (
        {"command": [sys.executable, "x\0y"]},
        "parameters.flight.command[1]: expected a text without null characters",
    ),
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
    (
        {"interface": {"transport": {"kind": "udp", "local": "127.0.0.1:4", "remote": "[::1]:5"}}},
        "parameters.flight.interface.transport.remote: expected an address of IPv4 as local, "
        "127.0.0.1:4, is, got [::1]:5 of IPv6",
    ),
    (
        [
            {
                "interface": {
                    "transport": {
                        "kind": "udp",
                        "local": "[::]:0",
                        "remote": "10.0.0.${index}:5",
                    }
                }
            }
        ],
        "parameters.flight[0].interface.transport.remote: expected an address of IPv6 as local",
    ),
    (
        {"interface": {"transport": {"kind": "unix", "path": "/" + "x" * 107}}},
        "parameters.flight.interface.transport.path: expected a path of at most 107 bytes",
    ),
    (
        {"interface": {"transport": {"kind": "unix", "path": "/" + "x" * 99 + "${name}"}}},
        "parameters.flight.interface.transport.path: expected a path of at most 107 bytes, which "
        "is all that a socket's may have, got 108: /",
    ),
    (
        {"interface": {"transport": {"kind": "tcp", "address": "mcu:7${index}999"}}},
        "parameters.flight.interface.transport.address: expected a port of at most 65535",
    ),
]


@pytest.mark.parametrize(
    ("flight", "words"),
    FAULTS_OF_FLIGHT,
)
def test_faults_name_their_rule(tmp_path, flight, words):
    (fault,) = faults(tmp_path, flight)

    assert fault.startswith(words)


@pytest.mark.parametrize(
    "transport",
    [
        {"kind": "udp", "local": "localhost:4", "remote": "[::1]:5"},
        {"kind": "udp", "local": "10.0.0.${index}:4", "remote": "10.0.1.${index}:5"},
        {"kind": "unix", "path": "/" + "x" * 98 + "${name}"},
    ],
)
def test_addresses_that_can_be_are_none(tmp_path, transport):
    assert faults(tmp_path, {"interface": {"transport": transport}}) == []


def shared(*transports):
    """Return how two agents would share a place, one rule for both or one each."""
    rules = [{"interface": {"transport": one}} for one in transports]
    rules = [{**rule, "agents": [name]} for rule, name in zip(rules, AGENTS, strict=False)]
    flight = rules if len(rules) > 1 else {"interface": {"transport": transports[0]}}
    uses = place_uses(parameters(WALKER, flight=flight), AGENTS, Path("/here"))
    return shared_places(uses, AGENTS)


FIELD = "parameters.flight.interface.transport"


@pytest.mark.parametrize(
    ("transports", "field", "place"),
    [
        ([{**TCP, "listen": True}], f"{FIELD}.address", "TCP port 127.0.0.1:4000"),
        ([{"kind": "udp", "local": "0.0.0.0:4001"}], f"{FIELD}.local", "UDP port 4001"),
        ([{"kind": "serial", "port": "/dev/ttyUSB0"}], f"{FIELD}.port", "serial port /dev/ttyUSB0"),
        (
            [{"kind": "unix", "path": "a.sock", "listen": True}],
            f"{FIELD}.path",
            "socket /here/a.sock",
        ),
        (
            [{"kind": "udp", "local": "[::1]:4001"}, {"kind": "udp", "local": "[0::1]:04001"}],
            "parameters.flight[0].interface.transport.local",
            "UDP port ::1:4001",
        ),
        (
            [
                {"kind": "tcp", "address": "0.0.0.0:4001", "listen": True},
                {"kind": "tcp", "address": "localhost:4001", "listen": True},
            ],
            "parameters.flight[0].interface.transport.address",
            "TCP port 4001",
        ),
    ],
)
def test_a_place_that_two_agents_would_have_is_found(transports, field, place):
    told = shared(*transports)

    assert told[0] == (field, f"{place}: agent-01, agent-02 cannot have it at once on one machine")
    assert len(told) == len(transports)


@pytest.mark.parametrize(
    "transports",
    [
        [TCP],  # software may take several connections
        [{"kind": "tcp", "address": "127.0.0.1:0", "listen": True}],
        [{"kind": "tcp", "address": "127.0.0.1:400${index}", "listen": True}],
        [{"kind": "udp", "local": "127.0.0.${index}:4000"}],
        [{"kind": "serial", "port": "/dev/tty-${satellite}"}],
        [{**TCP, "listen": True}, {"kind": "udp", "local": "127.0.0.1:4000"}],
        [{"kind": "pty"}],
    ],
)
def test_places_of_ones_own_are_shared_by_nobody(transports):
    assert shared(*transports) == []


def test_a_shared_place_is_a_fault_where_all_run_here_and_a_note_where_machines_decide(tmp_path):
    transport = {"kind": "serial", "port": "/dev/ttyUSB0"}
    flight = {"interface": {"transport": transport}}
    words = "transport.port: serial port /dev/ttyUSB0: agent-01, agent-02 cannot have it at once"
    lockstep = {"time": {"mode": "lockstep", "duration_s": 3}}
    (fault,) = read_scenario_faults(tmp_path, {"flight": flight}, **lockstep)
    assert words in fault and "${name} or ${index} in it tells them apart" in fault
    assert "machines of their own" not in fault  # which lockstep has not

    write_scenario(tmp_path, {"flight": flight})
    scenario_file = load_scenario(tmp_path / "scenario.yaml")
    (note,) = place_notes(scenario_file)
    assert words in note and "scenario.yaml:" in note
    assert "${name} or ${index} in it tells them apart; so do machines of their own" in note
    with pytest.raises(InputError, match=r"one machine \(here this computer\)"):
        check_places(scenario_file, make_plan(scenario_file.scenario))
    boards = [Machine(name=name, address=name, variables=Variables()) for name in ("pi01", "pi02")]
    check_places(scenario_file, make_plan(scenario_file.scenario, boards))


def test_settings_are_held_to_the_fields_of_their_struct():
    codes = {each.name: each.code for each in content.SETTING.fields}

    assert {name: f"{most}s" for name, most in SETTING_BYTES_MAX.items()} == {
        name: codes[name] for name in SETTING_BYTES_MAX
    }
    assert codes["value"] == "d"


def test_a_whole_number_that_its_struct_would_round_is_a_fault():
    given = {"id": 2**53 + 1, "ids": [1, -(2**63) + 1], "exact": 2**60, "share": 0.1}

    faults = list(_setting_faults("flight.settings", given))

    assert [fault.partition(":")[0] for fault in faults] == [
        "flight.settings.id",
        "flight.settings.ids",
    ]
    assert "float holds, got 9007199254740993: write it as a text" in faults[0]


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
    flight = [program(agents=["agent-01"]), {"interface": {"transport": TCP, "clock": "own"}}]

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


def test_what_a_transport_lacks_is_told_once_though_several_kinds_have_it(tmp_path):
    (tmp_path / "lacking.yaml").write_text(
        "name: lacking\nsimulation: constellation\nagents: {count: 1, tick_hz: 10}\n"
        "time: {mode: lockstep, duration_s: 3}\nparameters:\n"
        '  satellites: {walker: "56:1/1/0", altitude_km: 780}\n  epoch_utc: 2026-01-01T00:00:00Z\n'
        "  flight: {interface: {transport: {kind: tcp}, protocol: frames}}\n"
    )
    with pytest.raises(InputError) as caught:
        load_scenario(tmp_path / "lacking.yaml", ())

    (fault,) = caught.value.faults
    assert fault.path == "parameters.flight.interface.transport.address"
    assert fault.text == "missing; expected a text"
