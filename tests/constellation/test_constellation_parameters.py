"""What a person may write, and how it is told what is wrong."""

import numpy as np
import pytest
from constellation_fakes import IRIDIUM, SCENARIOS, WALKER, parameters
from pydantic import ValidationError

from cosmos_cli.errors import InputError
from cosmos_cli.models.loading import load_scenario
from cosmos_cli.models.parameters import adapter_of
from madns_runtime.config import from_mapping, to_mapping
from madns_runtime.errors import ConfigurationError
from madns_runtime.protocol.codec import pack
from madns_runtime.simulations.constellation import simulation
from madns_runtime.simulations.constellation.check import find_faults
from madns_runtime.simulations.constellation.demand import estimate_demand, shortest_lead_s
from madns_runtime.simulations.constellation.messages import Initial, Segment
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.elements import elements_from_state
from madns_runtime.simulations.constellation.parameters import ConstellationParameters, Maneuvers
from madns_runtime.simulations.constellation.truth.initial_states import load_fleet
from madns_runtime.simulations.constellation.truth.propagation import TruthStretch
from madns_runtime.simulations.constellation.truth.satellite_selection import parse_walker
from madns_runtime.simulations.constellation.truth.segments import RefillSchedule, TruthStore

KEPLERIAN = {
    "keplerian": [
        {"name": "LEO", "altitude_km": 780, "i_deg": 86.4},
        {"name": "GEO", "a_km": 42164.17, "mean_anomaly_deg": 30.0},
    ]
}
VALID = {
    "iridium": {"satellites": IRIDIUM},
    "named": {"satellites": {**IRIDIUM, "names": ["IRIDIUM 16", "IRIDIUM 8"]}},
    "walker": {"satellites": WALKER, "propagator": {"kind": "scipy", "forces": ["two_body"]}},
    "star": {"satellites": {**WALKER, "raan_spread_deg": 180}},
    "keplerian": {"satellites": KEPLERIAN, "epoch_utc": "2020-01-01T00:00:00+00:00"},
    "sgp4": {"satellites": IRIDIUM, "propagator": {"kind": "sgp4"}},
}


@pytest.mark.parametrize("mapping", VALID.values(), ids=VALID)
def test_pydantic_and_the_runtime_read_the_same(mapping):
    validated = adapter_of(ConstellationParameters).validate_python(mapping)

    assert from_mapping(ConstellationParameters, to_mapping(validated)) == validated
    assert from_mapping(ConstellationParameters, mapping) == validated


@pytest.mark.parametrize("mapping", VALID.values(), ids=VALID)
def test_what_is_valid_has_no_faults(mapping):
    assert find_faults(parameters(**mapping), 2, SCENARIOS) == []


@pytest.mark.parametrize(
    "mapping",
    [
        {},
        {"satellites": {}},
        {"satellites": {**IRIDIUM, **WALKER}},
        {"satellites": {**WALKER, "altitude_km": -1}},
        {"satellites": {**WALKER, "raan_spread_deg": 90}},
        {"satellites": WALKER, "propagator": {}},
        {"satellites": WALKER, "propagator": {"kind": "magic"}},
        {"satellites": WALKER, "propagator": {"kind": "sgp4", "rtol": 1e-9}},
        {"satellites": WALKER, "propagator": {"kind": "scipy", "rtol": 1e-15}},
        {"satellites": WALKER, "propagator": {"kind": "scipy", "forces": ["magic"]}},
        {"satellites": WALKER, "propagator": {"kind": "scipy", "step_s_max": 1e-300}},
        {"satellites": WALKER, "propagator": {"kind": "numba", "step_s_max": 0}},
        {"satellites": WALKER, "maneuvers": {"propagation_s": 1e300}},
        {"satellites": WALKER, "maneuvers": {"network_s": -0.1}},
        {"satellites": WALKER, "maneuvers": {"late": "ignore"}},
        {"satellites": WALKER, "crosslinks": {"rate_bit_s": 1e-300}},
        {"satellites": WALKER, "vehicles": [{"thruster": {"isp_s": 1e6, "propellant_kg": 1}}]},
        {"satellites": WALKER, "vehicles": [{"thruster": {"isp_s": 220}}]},
        {"satellites": WALKER, "vehicles": [{"attitude": {"inertia_kg_m2": [1, 1]}}]},
        {"satellites": WALKER, "frame": "ITRF"},
        {"satellites": WALKER, "speed": 1},
        {"satellites": {"keplerian": []}},
        {"satellites": {"keplerian": [{"name": "x", "a_km": 7000, "e": 1.0}]}},
    ],
)
def test_what_is_out_of_bounds_is_refused_where_it_is_read(mapping):
    with pytest.raises(ValidationError):
        adapter_of(ConstellationParameters).validate_python(mapping)


@pytest.mark.parametrize("given", [[1, 2**53 + 1], [1, 0.5], [2.0], ["a"], []])
def test_lists_of_settings_reach_flight_software_as_written(given):
    mapping = {**VALID["walker"], "flight": {"software": "a.py:A", "settings": {"ids": given}}}

    read = adapter_of(ConstellationParameters).validate_python(mapping)
    flown = from_mapping(ConstellationParameters, to_mapping(read))

    assert read.flight.settings["ids"] == flown.flight.settings["ids"] == given
    kind = type(given[-1]) if given else None
    assert [type(item) for item in flown.flight.settings["ids"]] == [kind] * len(given)


def orbit(**values):
    return {"keplerian": [{"name": "A", "a_km": 7000.0} | values]}


FAULTS_OF_PARAMETERS = [
    ({"satellites": {"elements": "data/no.tle"}}, 1, "satellites.elements: .*no such file"),
    ({"satellites": IRIDIUM}, 11, "satellites.elements: .*each of 11 agents, got 10"),
    (
        {"satellites": {**IRIDIUM, "names": ["IRIDIUM 99"]}},
        1,
        "satellites.names: 'IRIDIUM 99' is not in the file",
    ),
    (
        {"satellites": {**IRIDIUM, "names": ["iridium 8"]}},
        1,
        "satellites.names: 'iridium 8' is not in the file; it has IRIDIUM 8$",
    ),
    (
        {"satellites": {**IRIDIUM, "names": ["IRIDIUM 8", "IRIDIUM 8"]}},
        1,
        "satellites.names: expected every name once",
    ),
    ({"satellites": {**IRIDIUM, "names": ["IRIDIUM 8"]}}, 2, "satellites.names: .*got 1"),
    (
        {"satellites": {**WALKER, "walker": "86.4:66-6-2"}},
        1,
        "satellites.walker: .*86.4:66/6/2",
    ),
    ({"satellites": {**WALKER, "walker": "86.4:66/5/2"}}, 1, "satellites.walker: .*evenly"),
    ({"satellites": {**WALKER, "walker": "86.4:66/6/6"}}, 1, "satellites.walker: .*phasing"),
    ({"satellites": {**WALKER, "walker": "200:66/6/2"}}, 1, "satellites.walker: .*inclination"),
    ({"satellites": WALKER}, 67, "satellites.walker: .*67 agents, got 66"),
    ({"satellites": KEPLERIAN}, 3, "satellites.keplerian: .*3 agents, got 2"),
    ({"satellites": orbit(altitude_km=500.0)}, 1, r"keplerian\[0\]: .*either"),
    ({"satellites": orbit(a_km=None)}, 1, r"keplerian\[0\]: .*either"),
    ({"satellites": orbit(e=0.5)}, 1, r"keplerian\[0\]: perigee lies 2878\.1 km below"),
    (
        {"satellites": {"keplerian": KEPLERIAN["keplerian"] * 2}},
        1,
        "satellites.keplerian: expected every name once",
    ),
    ({"satellites": WALKER, "propagator": {"kind": "sgp4"}}, 1, "propagator.kind: sgp4 needs"),
    (
        {"satellites": WALKER, "propagator": {"kind": "scipy", "forces": ["j2"]}},
        1,
        "propagator.forces: expected two_body",
    ),
    (
        {"satellites": WALKER, "propagator": {"kind": "scipy", "forces": ["two_body"] * 2}},
        1,
        "propagator.forces: expected every force once",
    ),
    ({"satellites": WALKER, "segments": {"knot_s": 3.0}}, 1, "segments.knot_s: .*whole number"),
    (
        {"satellites": WALKER, "segments": {"knot_s": 30.0}},
        1,
        "segments.knot_s: .*whole number",
    ),
    (
        {"satellites": WALKER, "segments": {"knot_s": 0.01, "buffer_s": 3600.0}},
        1,
        "segments.buffer_s: .*at most",
    ),
    ({"satellites": WALKER, "epoch_utc": "2017-03-07 12:00"}, 1, "epoch_utc: .*12:00:00Z"),
    ({"satellites": WALKER, "epoch_utc": "noon"}, 1, "epoch_utc: .*'noon'"),
]


@pytest.mark.parametrize(
    ("mapping", "agents", "fault"),
    FAULTS_OF_PARAMETERS,
)
def test_faults_are_named_by_parameter(mapping, agents, fault):
    faults = find_faults(parameters(**mapping), agents, SCENARIOS)

    assert len(faults) == 1
    assert faults[0].startswith("parameters.")
    with pytest.raises(ConfigurationError, match=fault):
        raise ConfigurationError(faults[0])


@pytest.mark.parametrize(
    ("segments", "tick_hz", "duration_s", "fault"),
    [
        ({}, 1e-4, 45_000.0, "segments.buffer_s: expected at least 39.68 s, got 20 s: .*longer"),
        ({"buffer_s": 40.0}, 1e-4, 45_000.0, None),
        ({}, 1e-4, 4_000.0, None),  # the only tick is that of time 0
        ({}, 0.0, 45_000.0, None),
        (
            {"buffer_s": 2000.0, "knot_s": 0.05},
            1e-4,
            45_000.0,
            "segments.knot_s: expected at most 200000 knots .*got 270014 every 0.05 s",
        ),
        ({"buffer_s": 3600.0, "knot_s": 1800.0 / 49_999}, 0.05, 45_000.0, None),
    ],
)
def test_an_agent_has_room_for_the_truth_between_two_ticks(segments, tick_hz, duration_s, fault):
    faults = find_faults(
        parameters(WALKER, segments=segments), 1, SCENARIOS, duration_s=duration_s, tick_hz=tick_hz
    )

    assert len(faults) == (fault is not None)
    if fault is not None:
        with pytest.raises(ConfigurationError, match=fault):
            raise ConfigurationError(faults[0])


def test_all_faults_come_at_once():
    faults = find_faults(
        parameters(
            {"elements": "data/no.tle"},
            epoch_utc="noon",
            propagator={"kind": "scipy", "forces": ["j2"]},
            segments={"knot_s": 3.0},
        ),
        1,
        SCENARIOS,
    )

    assert [fault.split(":")[0] for fault in faults] == [
        "parameters.epoch_utc",
        "parameters.satellites.elements",
        "parameters.propagator.forces",
        "parameters.segments.knot_s",
    ]


def test_a_damaged_file_is_reported_line_by_line(tmp_path):
    text = (SCENARIOS / "data/iridium10.tle").read_text().replace("17066", "17067")
    (tmp_path / "bad.tle").write_text(text)

    faults = find_faults(parameters({"elements": "bad.tle"}), 10, tmp_path)

    assert len(faults) == 10
    assert faults[0].startswith(f"parameters.satellites.elements: {tmp_path}/bad.tle:2: checksum")


def test_named_satellites_fly_in_the_order_of_their_names():
    params = parameters({**IRIDIUM, "names": ["IRIDIUM 16", "IRIDIUM 8"]})

    fleet = load_fleet(params, 2, SCENARIOS)

    assert fleet.names == ("IRIDIUM 16", "IRIDIUM 8")
    # Set of IRIDIUM 16: 10:41:15.29; of IRIDIUM 8: 07:18:54.81.
    assert fleet.epoch_utc.isoformat() == "2017-03-07T10:41:16+00:00"


def test_a_named_epoch_moves_the_satellites():
    early = load_fleet(parameters(IRIDIUM, epoch_utc="2017-03-07T13:00:00Z"), 1, SCENARIOS)
    late = load_fleet(parameters(IRIDIUM, epoch_utc="2017-03-07T13:00:01Z"), 1, SCENARIOS)

    moved_m = np.linalg.norm((late.states - early.states)[0, :3])
    assert moved_m == pytest.approx(np.linalg.norm(early.states[0, 3:]), rel=1e-3)


def test_a_walker_pattern_has_its_spacing():
    fleet = load_fleet(parameters(WALKER), 66, SCENARIOS)
    elements = [
        elements_from_state(tuple(s[:3]), tuple(s[3:]), EGM_96.mu_m3_s2)
        for s in fleet.states.tolist()
    ]

    raan = np.degrees([e.raan_rad for e in elements]).reshape(6, 11)
    u = np.degrees([e.mean_anomaly_rad for e in elements]).reshape(6, 11)
    assert raan == pytest.approx(np.repeat(np.arange(6)[:, None] * 60.0, 11, axis=1), abs=1e-9)
    assert np.diff(u, axis=1) % 360.0 == pytest.approx(np.full((6, 10), 360.0 / 11), abs=1e-9)
    shift = np.diff(u, axis=0) % 360.0
    assert shift == pytest.approx(np.full((5, 11), 360.0 * 2 / 66), abs=1e-9)
    assert np.linalg.norm(fleet.states[:, :3], axis=1) == pytest.approx(EGM_96.radius_m + 780e3)
    assert len(set(fleet.names)) == 66


def test_of_a_pattern_of_millions_those_are_made_that_fly():
    fleet = load_fleet(parameters({**WALKER, "walker": "53:900000000/9/1"}), 2, SCENARIOS)

    assert fleet.names == ("P1S000000001", "P1S000000002")


def test_a_star_pattern_spreads_its_nodes_over_half_the_equator():
    fleet = load_fleet(parameters({**WALKER, "raan_spread_deg": 180}), 66, SCENARIOS)
    last = fleet.states[-1].tolist()

    raan_rad = elements_from_state(tuple(last[:3]), tuple(last[3:]), EGM_96.mu_m3_s2).raan_rad

    assert np.degrees(raan_rad) == pytest.approx(150.0)


def test_walker_notation_is_read_with_and_without_blanks():
    assert parse_walker(" 56 : 24 / 3 / 1 ") == parse_walker("56.:24/3/1")


def test_segments_and_initial_data_survive_their_messages():
    segment = Segment(revision=3, t0_s=20.0, knot_s=0.5, states=np.arange(18.0).reshape(3, 6))
    initial = Initial(satellite="X", frame="TEME", epoch_utc="2017", segment=segment)

    again = Initial.from_message(initial.to_message())

    assert (again.segment.states == segment.states).all()
    assert again.segment.end_s == 21.0
    assert Initial.from_message({**initial.to_message(), "segment": None}).segment is None


def stretch(first_knot, knots, vehicles=2):
    states = np.zeros((vehicles, knots, 6))
    states[..., 0] = np.arange(first_knot, first_knot + knots)
    return TruthStretch(
        first_knot=first_knot, states=states, invariants=np.ones((vehicles, knots, 3))
    )


def test_the_store_cuts_windows_that_share_their_joints():
    store = TruthStore(2, knots_per_window=5, knot_s=2.0)
    store.add(stretch(0, 16))

    (segment,) = store.segments(1, 1, 2)

    assert segment.t0_s == 10.0
    assert segment.end_s == 30.0
    assert segment.states[:, 0].tolist() == list(range(5, 16))
    assert store.segments(1, 3, 5) == []


def test_the_store_refuses_a_stretch_that_does_not_follow():
    store = TruthStore(2, knots_per_window=5, knot_s=2.0)
    store.add(stretch(0, 6))

    for wrong in (stretch(0, 6), stretch(10, 6), stretch(5, 5), stretch(5, 1)):
        with pytest.raises(ValueError, match="whole windows"):
            store.add(wrong)


def test_the_store_drops_old_windows_but_never_the_last():
    store = TruthStore(2, knots_per_window=5, knot_s=2.0)
    store.add(stretch(0, 16))

    store.drop_before(2)
    assert (store.oldest, store.end) == (2, 3)
    assert store.segments(0, 0, 2)[0].t0_s == 20.0

    store.drop_before(9)
    assert store.last_states()[0, 0] == 15.0


def test_every_refill_is_due_before_half_of_the_buffer_is_left():
    schedule = RefillSchedule(93, 10.0)
    for window in range(2, 6):
        due_s = [schedule.send_s(window, vehicle) for vehicle in range(93)]
        assert due_s == sorted(due_s)
        assert due_s[-1] == pytest.approx((window - 1) * 10.0)
        assert due_s[0] > schedule.wanted_s(window) + 10.0
        assert due_s[0] > schedule.send_s(window - 1, 92)


def test_demand_is_encoded_and_timed():
    params = parameters(IRIDIUM)

    demand = estimate_demand(params, 10, 10.0, SCENARIOS)

    states = np.ones((11, 6))
    message = Segment(revision=0, t0_s=0.0, knot_s=1.0, states=states).to_message()
    assert demand.batch_bytes == len(pack(message))
    assert demand.flows[0].rate_hz == 0.1
    assert demand.buffer_s == 10.0
    assert demand.batch_compute_s > 0.0
    assert demand.measured


def test_flight_software_adds_maneuvers_to_the_demand():
    flight = {"flight": "guidance.py:Guidance"}

    demand = estimate_demand(parameters(**flight), 3, 10.0, SCENARIOS)
    fixed = estimate_demand(
        parameters(IRIDIUM, propagator={"kind": "sgp4"}, **flight), 3, 10.0, SCENARIOS
    )

    # The urgent knots, the interval of the maneuver, and the command; the rest of three windows of ten follows.
    assert 22 * 48 < demand.sync_bytes < 22 * 48 + 400
    rest = next(flow for flow in demand.flows if flow.name == "rest of a maneuver's truth")
    assert rest.message_bytes // 48 in (10, 11)
    assert demand.sync_compute_s > 0.0
    assert (demand.lead_s, demand.sync_rate_hz) == (0.1, 1.0)
    assert (fixed.sync_bytes, fixed.lead_s) == (0, np.inf)


@pytest.mark.parametrize(
    ("tick_hz", "lead_s"), [(1.0, 1.0), (10.0, 0.1), (50.0, 0.06), (100.0, 0.06)]
)
def test_the_shortest_lead_is_a_whole_number_of_ticks(tick_hz, lead_s):
    assert shortest_lead_s(Maneuvers(), tick_hz) == pytest.approx(lead_s)


def test_the_descriptor_names_what_exists():
    assert simulation.parameters is ConstellationParameters
    for path in (simulation.host, simulation.agent, simulation.demand, simulation.check):
        module, _, name = path.partition(":")
        assert hasattr(__import__(module, fromlist=[name]), name)


@pytest.mark.parametrize("name", ["iridium10", "walker24"])
def test_the_shipped_scenarios_load_without_faults(name):
    scenario = load_scenario(SCENARIOS / f"{name}.yaml")

    assert scenario is not None


def test_a_force_that_a_propagator_lacks_is_told_at_the_force(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text(
        "name: a\nsimulation: constellation\nagents: {count: 1}\nparameters:\n"
        "  satellites: {walker: '86.4:66/6/2', altitude_km: 780}\n"
        "  propagator: {kind: basilisk, forces: [two_body, drag]}\n"
    )

    with pytest.raises(InputError) as error:
        load_scenario(path)

    assert ":6:51: parameters.propagator.forces[1]: expected two_body or j2" in str(error.value)
