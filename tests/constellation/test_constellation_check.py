"""What `cosmos validate` finds in vehicles, flight software, sensors and the ground, before anything runs."""

import ast
import dataclasses
import importlib.util
import re
import sys
from dataclasses import dataclass
from typing import ClassVar

import pytest
from constellation_fakes import SCENARIOS, WALKER, parameters

from madns_runtime.simulations.constellation.check import find_faults
from madns_runtime.simulations.constellation.parameters import PropagatorProperties

AGENTS = ("agent-01", "agent-02")
GUIDANCE = """
import math
class Guidance:
    def step(self, t_s, readings): pass
class Other: pass
Alias = Guidance
raise SystemExit("validating runs nothing")
"""


PEEPING = """
from madns_runtime.simulations.constellation.flight.api import FlightSoftware
class G(FlightSoftware):
    from madns_runtime.simulations.constellation.vehicle import truth_buffer
"""


GROUNDED = [{"name": name, "altitude_km": 500} for name in ("ground", "ground:A")]
TWINS = """IRIDIUM 8
1 24792U 97020A   17066.30480103  .00000181  00000-0  57411-4 0  9993
2 24792  86.4004   1.2813 0002235  84.4150 275.7300 14.34220922 38595
IRIDIUM 8
1 24793U 97020B   17066.29844670  .00000177  00000-0  56085-4 0  9996
2 24793  86.4011   1.5611 0002185  85.6164 274.5281 14.34216531 38591
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "guidance.py").write_text(GUIDANCE)
    (tmp_path / "broken.py").write_text("x = 1\nclass G(:\n")
    (tmp_path / "peeping.py").write_text(PEEPING)
    (tmp_path / "program").write_text("#!/bin/sh\n")
    (tmp_path / "run.sh").write_text("#!/bin/sh\n")
    (tmp_path / "run.sh").chmod(0o755)
    return tmp_path


def faults(folder, **rest):
    satellites = rest.pop("satellites", WALKER)
    return find_faults(parameters(satellites, **rest), 2, folder, names=AGENTS)


@pytest.mark.parametrize(
    "rest",
    [
        {"flight": "guidance.py:Guidance"},
        {"flight": "./guidance.py:Alias"},
        {"flight": {"software": "json:JSONDecoder", "agents": ["agent-02", "P1S*", "*"]}},
        {"flight": {"command": ["run.sh"]}},
        {"flight": {"command": ["./run.sh", "x"]}},
        {"flight": {"command": [sys.executable]}},
        {"flight": {"command": ["sh"]}},
        {"flight": {"command": ["/opt/on/the/board/alone"]}},
        {"propagator": {"kind": "custom", "implementation": "guidance.py:Guidance"}},
        {"stations": [{"name": "A", "latitude_deg": 0, "longitude_deg": 0}]},
        {
            "stations": [{"name": "A", "latitude_deg": 0, "longitude_deg": 0}],
            "uplinks": [{"at_s": 0, "to": "agent-02", "text": "x"}],
        },
        {"vehicles": [{"sensors": {"gnss": {}, "clock": {}, "sun_sensor": {}}}]},
        {
            "vehicles": [
                {
                    "sensors": {"gyro": {}, "star_tracker": {}},
                    "attitude": {"inertia_kg_m2": [1, 1, 2]},
                }
            ]
        },
        {"vehicles": [{"attitude": {"inertia_kg_m2": [0.1, 0.7, 0.8]}}]},
        {
            "propagator": {"kind": "scipy", "forces": ["two_body", "drag"]},
            "vehicles": [{"ballistic_m2_kg_range": [0.01, 0.02]}],
        },
    ],
    ids=str,
)
def test_what_fits_together_has_no_faults(folder, rest):
    assert faults(folder, **rest) == []


FAULTS_OF_THE_BOARD = [
    ({"flight": "guidance.py"}, "flight: expected file.py:Class or module:Class"),
    ({"flight": "missing.py:G"}, "flight: no such file: .*missing.py"),
    (
        {"flight": "guidance.py:guidance"},
        "flight: .*guidance.py has no class 'guidance'; it has Guidance, Other",
    ),
    ({"flight": {"software": "broken.py:G"}}, "flight.software: .*broken.py:2: "),
    (
        {"flight": "peeping.py:G"},
        r"flight: .*peeping.py:4: expected no import of madns_runtime\..*\.vehicle.truth_buffer:",
    ),
    ({"flight": {"software": "no_such_module:G"}}, r"flight.software: no module .*\.py:G"),
    (
        {"flight": {"software": "guidance.py:Guidance", "agents": ["agent-03"]}},
        "flight.agents: 'agent-03' fits no agent and no satellite, such as agent-01",
    ),
    ({"flight": {"command": ["program"]}}, "flight.command: .*program is not executable"),
    ({"flight": {"command": ["bin/no"]}}, "flight.command: no program 'bin/no' in"),
    ({"flight": {"command": ["no-such-prg"]}}, "flight.command: no program .* or on PATH"),
    (
        {"propagator": {"kind": "custom", "implementation": "missing.py:P"}},
        "propagator.implementation: no such file",
    ),
    (
        {"propagator": {"kind": "numba", "forces": ["j2"]}},
        "propagator.forces: expected two_body among them",
    ),
    (
        {
            "propagator": {"kind": "basilisk"},
            "vehicles": [
                {"agents": ["agent-01"], "attitude": {"inertia_kg_m2": [1, 1, 1]}},
                {
                    "attitude": {
                        "inertia_kg_m2": [1, 1, 1],
                        "wheels": {"torque_n_m_max": 0.1, "momentum_n_m_s_max": 1},
                    }
                },
            ],
        },
        r"vehicles\[1\].attitude.wheels: basilisk does rigid bodies without wheels only",
    ),
    (
        {
            "segments": {"knot_s": 2},
            "vehicles": [{"attitude": {"inertia_kg_m2": [1, 1, 1], "rates_deg_s": [0, 90, 1]}}],
        },
        r"vehicles\[0\].attitude.rates_deg_s: expected less than half a turn .* got 180.0\d* deg",
    ),
    ({"vehicles": [{}, {"agents": ["X*"]}]}, r"vehicles\[1\].agents: 'X\*' fits no agent"),
    (
        {"vehicles": [{"agents": ["*-01"]}, {}, {"agents": ["agent-02"]}]},
        r"vehicles\[2\].agents: expected .* that no entry before it fits, got those of parameters.vehicles\[1\]",
    ),
    (
        {"vehicles": [{"sensors": {"gyro": {}}}]},
        r"vehicles\[0\].sensors.gyro: needs a vehicle with attitude",
    ),
    (
        {"vehicles": [{"sensors": {"star_tracker": {}}}]},
        r"vehicles\[0\].sensors.star_tracker: needs a vehicle with attitude",
    ),
    (
        {"vehicles": [{"sensors": {"clock": {"rate_hz": 100, "latency_s": 1000}}}]},
        r"vehicles\[0\].sensors.clock.latency_s: expected at most 10000 measurements",
    ),
    (
        {"vehicles": [{"mass_kg": 5, "thruster": {"isp_s": 220, "propellant_kg": 5}}]},
        r"vehicles\[0\].thruster.propellant_kg: expected less than",
    ),
    (
        {
            "propagator": {"kind": "scipy", "forces": ["two_body", "drag"]},
            "vehicles": [{"ballistic_m2_kg_range": [0.02, 0.03]}],
        },
        r"vehicles\[0\].ballistic_m2_kg_range: expected smallest and largest",
    ),
    (
        {"vehicles": [{"attitude": {"inertia_kg_m2": [1, 1, 2.1]}}]},
        r"vehicles\[0\].attitude.inertia_kg_m2: no body",
    ),
    (
        {"stations": [{"name": "A", "latitude_deg": 0, "longitude_deg": 0}] * 2},
        r"stations\[1\].name: expected every name once, got 'A' again",
    ),
    (
        {"uplinks": [{"at_s": 0, "to": "agent-01", "text": "x"}]},
        "uplinks: need parameters.stations",
    ),
    (
        {
            "stations": [{"name": "A", "latitude_deg": 0, "longitude_deg": 0}],
            "uplinks": [{"at_s": 0, "to": "agent-1", "text": "x"}],
        },
        r"uplinks\[0\].to: no agent and no satellite is called 'agent-1'",
    ),
    (
        {"stations": [{"name": "A\x1b[31m", "latitude_deg": 0, "longitude_deg": 0}]},
        r"stations\[0\].name: expected a name of at most \d+ printable characters, got ",
    ),
    (
        {"satellites": {"keplerian": GROUNDED}, "crosslinks": {}},
        r"satellites: no message reaches the satellite named 'ground' \(nor 1 more\): ",
    ),
]


@pytest.mark.parametrize(
    ("rest", "fault"),
    FAULTS_OF_THE_BOARD,
)
def test_faults_of_the_board_are_named_by_parameter(folder, rest, fault):
    found = faults(folder, **rest)

    assert len(found) == 1
    assert re.match(f"parameters.{fault}", found[0]), found[0]


@pytest.mark.parametrize(
    ("radio", "field"), [("crosslinks", "crosslinks"), ("stations", "stations")]
)
def test_an_agent_of_a_name_that_means_stations_is_refused_where_there_is_a_radio(
    folder, radio, field
):
    stations = [{"name": "A", "latitude_deg": 0, "longitude_deg": 0}]
    given = {"crosslinks": {"crosslinks": {}}, "stations": {"stations": stations}}[radio]
    names = ("ground", "grounded")

    (fault,) = find_faults(parameters(**given), 2, folder, names=names)

    assert fault.startswith(f"parameters.{field}: no message reaches the agent named 'ground': ")
    assert find_faults(parameters(), 2, folder, names=names) == []


def test_an_uplink_to_a_name_of_two_satellites_is_refused(folder):
    (folder / "twins.tle").write_text(TWINS)
    stations = [{"name": "A", "latitude_deg": 0, "longitude_deg": 0}]
    uplinks = [{"at_s": 0, "to": to, "text": "x"} for to in ("agent-01", "IRIDIUM 8")]

    found = faults(folder, satellites={"elements": "twins.tle"}, stations=stations, uplinks=uplinks)

    assert found == [
        "parameters.uplinks[1].to: 2 satellites are called 'IRIDIUM 8': name the agent"
    ]


@pytest.mark.parametrize(
    ("rest", "module", "extra"),
    [
        ({"propagator": {"kind": "numba"}}, "numba", "fast"),
        ({"propagator": {"kind": "basilisk"}}, "Basilisk", "basilisk"),
        ({"vehicles": [{"sensors": {"magnetometer": {"field": "igrf"}}}]}, "ppigrf", "igrf"),
    ],
)
def test_a_missing_extra_is_named_with_the_command_that_installs_it(
    folder, monkeypatch, rest, module, extra
):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == module else find_spec(name)
    )

    (found,) = faults(folder, **rest)

    assert f"{module} is not installed here" in found
    assert f"pip install 'cosmos-madns[{extra}]'" in found


@pytest.mark.parametrize(
    ("duration_s", "times_s", "told"),
    [
        (100.0, (0, 99.9), None),
        (0.0, (0, 1e6), None),
        (100.0, (0, 100), "remark: parameters.uplinks[1].at_s: 100 s is no time before the end"),
        (100.0, (300, 0, 200, 400), "it never leaves, and 2 more"),
    ],
)
def test_an_uplink_whose_time_never_comes_is_remarked(folder, duration_s, times_s, told):
    given = parameters(
        stations=[{"name": "A", "latitude_deg": 0, "longitude_deg": 0}],
        uplinks=[{"at_s": at_s, "to": "agent-01", "text": "x"} for at_s in times_s],
    )
    found = find_faults(given, 2, folder, names=AGENTS, duration_s=duration_s)

    assert len(found) == (told is not None)
    assert all(told in text for text in found)


@pytest.mark.parametrize(
    ("propagator", "vehicle", "told"),
    [
        (
            {"kind": "scipy"},
            {"ballistic_m2_kg": 0.5},
            "].ballistic_m2_kg: changes nothing: drag is not",
        ),
        (
            {"kind": "scipy"},
            {"ballistic_m2_kg_range": [0.01, 0.1]},
            "].ballistic_m2_kg_range: changes",
        ),
        ({"kind": "scipy"}, {"mass_kg": 5}, None),
        ({"kind": "scipy", "forces": ["two_body", "drag"]}, {"ballistic_m2_kg": 0.5}, None),
        ({"kind": "basilisk"}, {"ballistic_m2_kg": 0.5}, "basilisk knows no drag by it"),
        ({"kind": "custom", "implementation": "json:loads"}, {"ballistic_m2_kg": 0.5}, None),
    ],
)
def test_a_ballistic_coefficient_that_no_drag_heeds_is_remarked(folder, propagator, vehicle, told):
    given = parameters(propagator=propagator, vehicles=[vehicle])

    found = [fault for fault in find_faults(given, 2, folder) if fault.startswith("remark: ")]

    assert len(found) == (told is not None)
    assert all(told in text for text in found)


@dataclass(frozen=True)
class Own:
    """Settings of a propagator that is none of the shipped ones."""

    PROPERTIES: ClassVar = PropagatorProperties(engine="own:Own", knows_drag=True)
    can_maneuver: ClassVar = True
    kind: str = "own"
    forces: tuple = ("two_body",)


@pytest.mark.parametrize("forces", [("two_body",), ("two_body", "drag")])
def test_what_a_propagator_knows_is_asked_of_its_properties(folder, forces):
    given = parameters(vehicles=[{"ballistic_m2_kg": 0.5}])
    given = dataclasses.replace(given, propagator=Own(forces=forces))

    found = [fault for fault in find_faults(given, 2, folder) if fault.startswith("remark: ")]

    told = "changes nothing: drag is not among parameters.propagator.forces"
    assert [fault.endswith(told) for fault in found] == [True] * ("drag" not in forces)


@pytest.mark.parametrize(
    ("epoch_utc", "vehicle", "told"),
    [
        ("2029-12-31T00:00:00Z", {"sensors": {"magnetometer": {}}}, None),
        ("2031-07-01T00:00:00Z", {}, None),
        (
            "2031-07-01T00:00:00Z",
            {"sensors": {"magnetometer": {}}},
            "is that of 2030, not of the epoch",
        ),
        (
            "1975-07-01T00:00:00Z",
            {"sensors": {"magnetometer": {}}},
            "is that of 1980, not of the epoch",
        ),
        (
            "2031-07-01T00:00:00Z",
            {"stimuli": [{"source": "magnetic_field", "channel": "mcu.field"}]},
            "parameters.vehicles[0].stimuli[0].field: the Earth's field is that of 2030",
        ),
    ],
)
def test_a_field_of_the_earth_beyond_its_coefficients_is_remarked(folder, epoch_utc, vehicle, told):
    given = parameters(vehicles=[vehicle], epoch_utc=epoch_utc)

    found = [fault for fault in find_faults(given, 2, folder) if fault.startswith("remark: ")]

    assert len(found) == (told is not None)
    assert all(told in text for text in found)


def test_without_names_globs_are_not_judged(folder):
    params = parameters(vehicles=[{"agents": ["X*"]}])

    assert find_faults(params, 2, folder) == []


def test_code_is_read_again_when_the_interpreter_lost_count_in_it(folder, monkeypatch):
    """As CPython 3.11 may where another thread parses meanwhile; it comes without warning."""
    tries = []

    def parse(code, name, parse=ast.parse):
        tries.append(name)
        if len(tries) == 1:
            raise SystemError("AST constructor recursion depth mismatch (before=198, after=214)")
        return parse(code, name)

    monkeypatch.setattr(ast, "parse", parse)

    assert faults(folder, flight="guidance.py:Guidance") == []
    assert len(tries) == 2


def test_the_shipped_example_in_c_has_no_faults():
    assert find_faults(parameters(flight={"command": ["flight/hold.sh"]}), 2, SCENARIOS) == []
