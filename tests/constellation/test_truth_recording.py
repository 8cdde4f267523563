"""The host records the truth that it sends: to the bit what agents fly along, whatever becomes of them."""

import numpy as np
import pytest
from constellation_fakes import Star, parameters

from madns_runtime.simulations.constellation.messages import Segment
from madns_runtime.simulations.constellation.streams import TRUTH
from madns_runtime.simulations.constellation.truth.segment_records import (
    TruthHistory,
    record_of,
)

SCRIPT = '''
from madns_runtime.simulations.constellation.flight.api import FlightSoftware


class Script(FlightSoftware):
    """Commands what the settings say: name, second, seconds ahead, numbers."""

    def setup(self, context):
        self.context = context

    def step(self, t_s, readings):
        for line in self.context.settings["lines"]:
            who, at_s, ahead_s, *numbers = line.split()
            if who == self.context.name and abs(t_s - float(at_s)) < 1e-6:
                self.context.delta_v([float(n) for n in numbers], at_s=t_s + float(ahead_s))
'''
LINES = [
    "agent-02 2 4.3 0 2 0",
    # The second is executed before the first, and known after it.
    "agent-01 20 14.333 0 -2 1",
    "agent-01 25 4.1 1 0 0",
    "agent-02 31 0.5 0 1 0",
    "agent-03 3 40 0 1 0",
]
BODY = {"inertia_kg_m2": [10.0, 24.0, 17.0], "rates_deg_s": [1.0, -2.0, 0.5]}
THRUSTER = {"isp_s": 220.0, "propellant_kg": 20.0}
BURNER = THRUSTER | {"thrust_n": 500.0}


@pytest.fixture
def star(tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)

    def start(count=3, **rest):
        vehicles = [
            {"agents": ["agent-02"], "mass_kg": 500, "thruster": BURNER, "attitude": BODY},
            {"thruster": THRUSTER},
        ]
        flight = {"software": "script.py:Script", "input": "truth", "settings": {"lines": LINES}}
        params = parameters(flight=flight, vehicles=vehicles, **rest)
        return Star(params, count, base_directory=tmp_path)

    return start


def watch(star):
    """Keep what each agent looks up, as it is: its records are rounded."""
    seen = {name: [] for name in star.agents}
    for name, agent in star.agents.items():

        def lookup(t_s, whole=agent._buffer.lookup, rows=seen[name]):
            state = whole(t_s)
            rows.append((t_s, state))
            return state

        agent._buffer.lookup = lookup
    return seen


def histories(star):
    found = {name: TruthHistory() for name in star.context.agents}
    for record in star.context.records["truth"]:
        found[record[1]].add(record)
    return found


def test_what_the_host_recorded_is_to_the_bit_what_agents_flew(star):
    star = star()
    seen = watch(star)
    star.run(58.0)

    recorded = histories(star)
    assert {name: found.revision for name, found in recorded.items()} == {
        "agent-01": 2,
        "agent-02": 2,
        "agent-03": 0,  # its burn was known before the windows that hold it
    }
    for name, rows in seen.items():
        times_s = np.array([t_s for t_s, _ in rows])
        flown = np.array([state for _, state in rows])
        found = recorded[name].tabulate(times_s)
        assert len(times_s) == 580
        if name == "agent-02":
            # A tick on a knot of its burns, which are no whole seconds: either interval may serve it.
            found, flown = found[times_s != 6.3], flown[times_s != 6.3]
        assert found.tobytes() == flown.tobytes()


@pytest.mark.parametrize("knot_s", [0.1, 0.7, 3.0])
def test_with_knots_of_any_distance_only_rounding_of_their_times_is_between_them(star, knot_s):
    star = star(segments={"knot_s": knot_s, "buffer_s": 84.0})
    seen = watch(star)
    star.run(30.0)

    for name, history in histories(star).items():
        flown = np.array([state[:6] for _, state in seen[name]])
        found = history.tabulate(np.array([t_s for t_s, _ in seen[name]]))[:, :6]
        # 1e-15 of 30 s at 7.5 km/s, and half a unit in the last place of 7e6 m.
        assert np.abs(found - flown)[:, :3].max() < 3e-9


@pytest.mark.slow
def test_the_truth_of_a_lost_agent_goes_on(star):
    whole, cut = star(), star()
    whole.run(58.0)
    cut.run(12.0)
    del cut.agents["agent-03"]
    cut.host.agent_lost("agent-03", "killed")
    cut.run(58.0, from_s=12.0)

    times_s = np.arange(580) / 10.0
    expected = histories(whole)["agent-03"].tabulate(times_s)
    found = histories(cut)["agent-03"].tabulate(times_s)
    assert np.isfinite(found).all()
    # It commanded its burn of 43 s before it was lost.
    assert found.tobytes() == expected.tobytes()


def test_who_wants_no_record_of_truth_gets_none(star):
    star = star(record={"truth": False})
    star.run(30.0)

    assert "truth" not in star.context.streams
    assert star.underruns() == 0


def test_a_host_that_was_held_up_records_what_was_over_meanwhile(star):
    star = star(segments={"knot_s": 0.1, "buffer_s": 0.2})
    star.host.start(0.0)
    star.context.clock_s = t_s = 1.5
    while t_s is not None and t_s < 1.6:
        star._run_jobs(all_now=True)
        t_s = star.host.timer(t_s)

    for history in histories(star).values():
        assert np.isfinite(history.tabulate(np.arange(16) / 10.0)).all()


def segment(t0_s, values, revision=0, knot_s=1.0):
    states = np.repeat(np.asarray(values, dtype=float)[:, None], 6, axis=1)
    states[:, 3:] = 0.0
    return Segment(revision=revision, t0_s=t0_s, knot_s=knot_s, states=states)


def history_of(*segments):
    history = TruthHistory()
    for each in segments:
        history.add(record_of(each, "agent-01", 0.0))
    return history


def test_later_records_hold_from_their_first_knot_on():
    history = history_of(
        segment(0.0, [1, 1, 1]), segment(2.0, [1, 1, 1]), segment(1.5, [7, 7], revision=1)
    )

    found = history.tabulate(np.array([1.4, 1.5, 2.4, 2.6]))[:, 0]
    assert found[:3].tolist() == [1.0, 7.0, 7.0]
    assert np.isnan(found[3])


def test_where_nothing_is_on_record_there_is_nothing():
    history = history_of(segment(1.0, [1, 1]), segment(3.0, [3, 3]))

    found = history.tabulate(np.array([0.5, 1.0, 2.0, 2.5, 3.0, 4.0, 4.1]))[:, 0]
    assert np.isfinite(found).tolist() == [False, True, True, False, True, True, False]
    assert np.isnan(TruthHistory().tabulate(np.array([0.0]))).all()


GOOD = record_of(segment(0.0, [1, 1]), "agent-01", 0.0)
PLACE = {field.name: place for place, field in enumerate(TRUTH)}


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("revision", -1),
        ("revision", "0"),
        ("t0_s", float("nan")),
        ("t0_s", None),
        ("knot_s", 0.0),
        ("knot_s", -1.0),
        ("knots", 1),
        ("knots", 10**12),
        ("knots", 3),
        ("knots", True),
        ("states", "AAAA"),
        ("states", None),
        ("attitude", "AAAA"),
    ],
)
def test_a_record_of_anything_else_is_refused(field, value):
    record = list(GOOD)
    record[PLACE[field]] = value

    with pytest.raises((TypeError, ValueError)):
        TruthHistory().add(record)
