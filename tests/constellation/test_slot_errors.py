"""The host's record of slot errors by truth: of whoever lives, at equal times, by the slots that flight software keeps."""

import math
import re

import numpy as np
import pytest
from constellation_fakes import SCENARIOS, FakeContext, parameters

from madns_runtime.simulations.constellation.analysis.slots import even_errors_deg
from madns_runtime.simulations.constellation.check import find_faults
from madns_runtime.simulations.constellation.host_side.slot_errors import SlotErrors
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.mean_elements import mean_from_state
from madns_runtime.simulations.constellation.truth.tle_files import tle_checksum

KEEPER = {"software": "slots.py:Keeper", "settings": {"slots": "even"}}
RADIUS_M = 7.158e6


class Circles:
    """Truth in which vehicles stand still on a circle over the poles, at these arguments of latitude, deg."""

    def __init__(self, degrees):
        speed_m_s = math.sqrt(EGM_96.mu_m3_s2 / RADIUS_M)
        angles = np.radians(degrees)
        zeros = np.zeros(len(angles))
        r_m = RADIUS_M * np.stack((np.cos(angles), zeros, np.sin(angles)), axis=1)
        v_m_s = speed_m_s * np.stack((-np.sin(angles), zeros, np.cos(angles)), axis=1)
        self._states = np.concatenate((r_m, v_m_s), axis=1)

    def states(self, t_s):
        return self._states


def recorder(degrees, *, flight=KEEPER, slots_hz=0.01, duration_s=1000.0):
    """Return a host's context, and the recorder of a ring with these arguments of latitude, deg."""
    agents = tuple(f"agent-{number + 1}" for number in range(len(degrees)))
    context = FakeContext(
        "host",
        agents,
        parameters(flight=flight, record={"slots_hz": slots_hz}),
        duration_s=duration_s,
    )
    satellites = [f"SAT-{number + 1}" for number in range(len(degrees))]
    return context, SlotErrors(context, context.parameters, Circles(degrees), satellites)


def test_slot_errors_are_those_that_the_report_works_out_afterwards():
    degrees = [0.1, 90.0, 180.0, 270.3]
    context, slots = recorder(degrees)

    slots.timer(0.0)

    mean = np.full((4, 1, 5), np.nan)
    for vehicle, (x, y, z, vx, vy, vz) in enumerate(Circles(degrees).states(0.0).tolist()):
        mean[vehicle, 0, 0] = mean_from_state((x, y, z), (vx, vy, vz), EGM_96).lam_rad
    errors_deg = even_errors_deg(mean)[:, 0]
    told = [(agent, error) for _, agent, error in context.records["slot_errors"]]
    assert [agent for agent, _ in told] == list(context.agents)
    assert [error for _, error in told] == pytest.approx(errors_deg, abs=1e-6)
    ((t_s, satellites, rms_deg, max_deg, worst),) = context.records["slots"]
    assert (t_s, satellites, worst) == (0.0, 4, "agent-4")
    assert rms_deg == pytest.approx(np.sqrt(np.mean(errors_deg**2)), abs=1e-6)
    assert max_deg == pytest.approx(0.2, abs=0.02)


def test_who_is_lost_has_no_slot_until_it_is_back():
    context, slots = recorder([0.0, 90.0, 180.0, 270.0])
    slots.timer(0.0)
    slots.leave_out([2])
    slots.timer(100.0)
    slots.leave_out([])
    slots.timer(200.0)
    slots.leave_out(range(4))
    slots.timer(300.0)

    assert [row[1] for row in context.records["slots"]] == [4, 3, 4, 0]
    assert context.records["slots"][-1][2:] == (None, None, None)
    assert [row[1] for row in context.records["slot_errors"] if row[0] == 100.0] == [
        "agent-1",
        "agent-2",
        "agent-4",
    ]


def test_who_flies_no_slots_has_none():
    flight = [{"software": "other.py:Other", "agents": ["SAT-1"]}, KEEPER]
    context, slots = recorder([45.0, 90.0, 180.0, 270.0], flight=flight)

    slots.timer(0.0)

    # The others stand where they should to each other, whatever the first does.
    assert context.records["slots"][0][1:4] == (
        3,
        pytest.approx(0.0, abs=1e-6),
        pytest.approx(0.0, abs=1e-6),
    )


def test_chain_has_the_spacing_that_its_settings_say():
    flight = {"software": "slots.py:Keeper", "settings": {"slots": "even", "spacing_deg": 5}}
    context, slots = recorder([10.0, 15.0, 20.0], flight=flight)

    slots.timer(0.0)

    # Mean elements of these circles are no circles by some thousandths of a degree; all around would be 115 deg.
    assert context.records["slots"][0][3] == pytest.approx(0.0, abs=0.05)


def test_times_are_equal_and_a_late_call_makes_up_for_nothing():
    context, slots = recorder([0.0, 180.0], duration_s=500.0)

    following = [slots.timer(t_s) for t_s in (0.0, 50.0, 100.0, 340.0, 400.0, 500.0)]

    assert following == [100.0, 100.0, 200.0, 400.0, 500.0, 600.0]
    assert [row[0] for row in context.records["slots"]] == [0.0, 100.0, 200.0, 400.0, 500.0]
    assert slots.timer(600.0) is None


@pytest.mark.parametrize(
    ("flight", "expected"),
    [
        (None, "expected flight software with settings {slots: even}, got none"),
        ({"software": "f.py:F", "settings": {"slots": "kept"}}, "expected flight software with"),
        (
            [
                {**KEEPER, "agents": ["agent-1"]},
                {"software": "f.py:F", "settings": {"slots": "even", "spacing_deg": 2}},
            ],
            "expected one spacing_deg in all settings with slots: even, got 2, None",
        ),
        *(
            (
                {"software": "f.py:F", "settings": {"slots": "even", "spacing_deg": given}},
                f"expected a number of degrees as spacing_deg in settings with slots: even, got {given!r}",
            )
            for given in ([2.0, 3.0], "2", True)
        ),
    ],
)
def test_record_of_slots_that_nobody_has_is_refused(tmp_path, flight, expected):
    asked = parameters(flight=flight, record={"slots_hz": 0.01})

    found = find_faults(asked, 2, tmp_path, names=("agent-1", "agent-2"))

    assert [each for each in found if re.match(r"parameters\.record\.slots_hz: ", each)] == [
        each for each in found if expected in each
    ]
    assert any(expected in each for each in found)


def ring_of(*inclinations_deg, raan_deg=0.0):
    orbits = [
        {"name": f"S{number}", "altitude_km": 780.0, "i_deg": i_deg, "raan_deg": raan_deg * number}
        for number, i_deg in enumerate(inclinations_deg)
    ]
    return {"keplerian": orbits}


EQUATORIAL = (
    "expected inclinations of 0.1 to 179.9 deg with flight software whose settings say slots"
)


@pytest.mark.parametrize("slots", ["even", "kept"])
@pytest.mark.parametrize(
    ("satellites", "told"),
    [
        ({"walker": "0:4/1/0", "altitude_km": 35_786.0}, "got 0 of P1S1 and 3 more: "),
        (ring_of(0.02, 0.02, 0.02, 0.02, raan_deg=70.0), "got 0.02 of S0 and 3 more: "),
        (ring_of(50.0, 179.95, 50.0, 50.0), "got 179.95 of S1: "),
    ],
    ids=["no nodes", "nodes anywhere", "retrograde"],
)
def test_slots_in_the_equator_are_refused(tmp_path, satellites, slots, told):
    flight = {"software": "slots.py:Keeper", "settings": {"slots": slots}}
    names = tuple(f"agent-{number}" for number in range(1, 5))

    found = find_faults(parameters(satellites, flight=flight), 4, tmp_path, names=names)

    [fault] = [each for each in found if EQUATORIAL in each]
    assert fault.startswith("parameters.satellites: ")
    assert told in fault


def test_the_equator_is_refused_to_those_with_slots_alone(tmp_path):
    keeper = {**KEEPER, "agents": ["agent-1", "agent-2"]}
    others = {"software": "f.py:F", "agents": ["agent-3"]}
    asked = parameters(ring_of(0.1, 179.9, 0.0, 0.0), flight=[keeper, others])
    names = tuple(f"agent-{number}" for number in range(1, 5))

    assert EQUATORIAL not in "".join(find_faults(asked, 4, tmp_path, names=names))


@pytest.mark.parametrize("suffix", ["tle", "csv"])
def test_inclinations_of_element_sets_count(tmp_path, suffix):
    text = (SCENARIOS / "data" / f"iridium10.{suffix}").read_text()
    lines = text.splitlines()
    if suffix == "tle":
        line = lines[2].replace(lines[2][8:16], "  0.0500")[:68]
        lines[2] = line + str(tle_checksum(line))
    else:
        lines[1] = lines[1].replace("86.4004", "0.05")
    (tmp_path / f"sets.{suffix}").write_text("\n".join(lines))
    asked = parameters({"elements": f"sets.{suffix}"}, flight=KEEPER, propagator={"kind": "sgp4"})

    found = find_faults(asked, 2, tmp_path, names=("agent-1", "agent-2"))

    assert [each for each in found if EQUATORIAL in each and "got 0.05 of IRIDIUM 8: " in each]
