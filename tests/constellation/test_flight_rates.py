"""Flight software at a rate of its own: steps within a tick or once in several, and sensors faster than the tick."""

import json
import sys
from pathlib import Path

import pytest
from constellation_fakes import Star, parameters

from madns_runtime.errors import BlamedError
from madns_runtime.simulations.constellation.check import find_faults
from madns_runtime.simulations.constellation.flight.api import Reading, StepReadings
from madns_runtime.simulations.constellation.flight_rates import FlightRate, flight_rate
from madns_runtime.simulations.constellation.messages import GroundText

LOGGER = """
import json

class Logger:
    def setup(self, context):
        self.context, self.steps, self.heard, self.results = context, [], [], []
        self.now_s = None

    def step(self, t_s, readings):
        self.now_s = t_s
        self.steps.append([t_s, {name: [[r.t_s, *r.values] for r in readings.since(name)] for name in readings}])
        if self.context.settings.get("talks") and self.context.index == 0:
            self.context.broadcast(t_s)
        if self.context.settings.get("burns") and 0.9 < t_s < 1.05:
            self.context.delta_v((0.0, 0.1, 0.0), at_s=t_s + 0.5)

    def receive(self, message):
        self.heard.append((len(self.steps), message.arrives_s))

    def command_result(self, result):
        self.results.append((len(self.steps), result.status))

    def finish(self):
        return {"rate_hz": self.context.rate_hz, "steps": json.dumps(self.steps), "heard": json.dumps(self.heard), "results": json.dumps(self.results)}
"""
BODY = {"inertia_kg_m2": [1.0, 1.2, 0.9], "rates_deg_s": [1.0, 2.0, 0.5]}


@pytest.fixture
def fly(tmp_path):
    (tmp_path / "logger.py").write_text(LOGGER)

    def start(
        rate_hz=None, *, until_s=3.0, gyro=None, count=1, tick_hz=10.0, settings=None, **rest
    ):
        flight = {"software": "logger.py:Logger", "settings": settings or {}}
        if rate_hz is not None:
            flight["rate_hz"] = rate_hz
        params = parameters(
            vehicles=[
                {
                    "attitude": BODY,
                    "sensors": {"gyro": gyro or {"rate_hz": 10.0}},
                    "thruster": {"isp_s": 220.0, "propellant_kg": 5.0},
                }
            ],
            flight=flight,
            **rest,
        )
        star = Star(params, count, base_directory=tmp_path, tick_hz=tick_hz)
        star.run(until_s)
        return star

    return start


def told(star, what="steps", name="agent-01"):
    return json.loads(star.summaries()[name]["flight"][what])


@pytest.mark.parametrize(
    ("rate_hz", "expected"),
    [
        (None, FlightRate(hz=10.0)),
        (10.0, FlightRate(hz=10.0)),
        (1.0, FlightRate(hz=1.0, ticks_per_step=10)),
        (0.1, FlightRate(hz=0.1, ticks_per_step=100)),
        (100.0, FlightRate(hz=100.0, steps_per_tick=10)),
    ],
)
def test_a_rate_divides_the_ticks_or_is_a_multiple_of_theirs(rate_hz, expected):
    assert flight_rate(rate_hz, 10.0) == expected


@pytest.mark.parametrize(
    ("rate_hz", "words"),
    [
        (3.0, "a rate that divides agents.tick_hz, 10 Hz, or is a whole multiple of it, got 3"),
        (25.0, "a whole multiple of it, got 25"),
        (1000.0, "at most 50 times agents.tick_hz, 10 Hz, got 1000"),
        (1e-5, "one step in at most 100000 ticks, 10 Hz"),
        (1e-309, "one step in at most 100000 ticks, 10 Hz, got 1e-309"),
    ],
)
def test_a_rate_without_a_whole_ratio_is_refused(tmp_path, fly, rate_hz, words):
    (tmp_path / "logger.py").write_text(LOGGER)
    given = parameters(flight={"software": "logger.py:Logger", "rate_hz": rate_hz})
    faults = find_faults(
        given, 1, tmp_path, names=("a",), duration_s=10.0, is_lockstep=True, tick_hz=10.0
    )

    assert [fault for fault in faults if fault.startswith("parameters.flight.rate_hz: ")]
    assert any(words in fault for fault in faults)
    with pytest.raises(BlamedError, match="parameters.flight.rate_hz"):
        fly(rate_hz, until_s=0.1)


@pytest.mark.parametrize(("rate_hz", "expected"), [(None, 10.0), (2.0, 2.0), (50.0, 50.0)])
def test_flight_software_is_told_its_own_rate(fly, rate_hz, expected):
    star = fly(rate_hz, until_s=0.1)

    assert star.summaries()["agent-01"]["flight"]["rate_hz"] == expected


def test_slow_flight_software_steps_at_its_own_times_and_is_given_all_it_missed(fly):
    steps = told(fly(1.0, until_s=3.05))

    assert [t_s for t_s, _ in steps] == [0.0, 1.0, 2.0, 3.0]
    assert [len(readings["gyro"]) for _, readings in steps] == [1, 10, 10, 10]
    assert [row[0] for row in steps[2][1]["gyro"]] == pytest.approx(
        [1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.7, 1.8, 1.9, 2.0]
    )


def test_fast_flight_software_steps_within_the_tick_with_sensors_as_fast(fly):
    gyro = {"rate_hz": 50.0, "noise": 1e-4, "bias_walk": 1e-5}
    fast, ticked = fly(50.0, gyro=gyro), fly(gyro=gyro, tick_hz=50.0)

    steps = told(fast)
    assert [t_s for t_s, _ in steps] == pytest.approx([n / 50.0 for n in range(146)], abs=1e-12)
    assert all(len(readings["gyro"]) == 1 for _, readings in steps)
    # The same numbers as of a vehicle that ticks so often: truth and error are those of the time.
    measured = [row[2:] for row in fast.contexts["agent-01"].records["gyro"]]
    assert measured == [row[2:] for row in ticked.contexts["agent-01"].records["gyro"]][:146]
    assert fast.underruns() == 0


def test_without_a_rate_a_sensor_is_no_faster_than_the_tick(fly):
    steps = told(fly(gyro={"rate_hz": 50.0}, until_s=1.0))

    assert [t_s for t_s, _ in steps] == pytest.approx([n / 10.0 for n in range(10)])
    assert all(len(readings["gyro"]) == 1 for _, readings in steps)


def test_fast_flight_software_hears_nothing_before_it_has_arrived(fly):
    star = fly(50.0, count=2, settings={"talks": True}, crosslinks={"range_km_max": 40_000.0})
    times_s = [t_s for t_s, _ in told(star, name="agent-02")]
    heard = told(star, "heard", "agent-02")

    assert len(heard) > 50
    assert all(arrives_s <= times_s[step] + 1e-9 for step, arrives_s in heard)


def test_messages_of_fast_flight_software_are_on_record_with_the_time_at_which_they_leave(fly):
    star = fly(50.0, count=2, settings={"talks": True}, crosslinks={"range_km_max": 40_000.0})
    sent = [row for row in star.contexts["agent-01"].records["messages"] if row[1] == "sent"]
    of_links_s = [row[0] for row in star.context.records["links"]]

    assert len(of_links_s) > 50
    assert [row[3] for row in sent][: len(of_links_s)] == of_links_s
    assert {row[4] - row[3] for row in sent} == {0.0}


def test_a_message_that_waits_for_a_step_at_the_end_of_the_run_is_held_and_not_received(fly):
    radio = {"range_km_max": 40_000.0}
    star = fly(0.4, count=2, until_s=6.0, settings={"talks": True}, crosslinks=radio)
    # A text by no radio, which waits as well, is no message of the radio's account.
    star.agents["agent-02"].receive(GroundText(t_s=6.0, text="report").to_message())
    counts = star.summaries()["agent-02"]

    assert len(told(star, "heard", "agent-02")) == 2
    assert [counts[f"messages_{name}"] for name in ("received", "held", "refused")] == [2, 1, 0]
    assert star.context.account("links").handed_over == 3


def test_fast_flight_software_commands_in_its_own_time_and_hears_the_result_at_a_tick(fly):
    star = fly(50.0, settings={"burns": True})
    commanded = [row[0] for row in star.context.records["maneuvers"]]
    steps, results = [t_s for t_s, _ in told(star)], told(star, "results")

    assert commanded == pytest.approx([0.92, 0.94, 0.96, 0.98, 1.0, 1.02, 1.04])
    assert [status for _, status in results].count("executed") == 7
    assert all(
        steps[step] * 10.0 == pytest.approx(round(steps[step] * 10.0)) for step, _ in results
    )


def test_who_begins_late_takes_no_steps_of_before(fly):
    star = fly(50.0, until_s=1.0)
    star.contexts["agent-01"].records.clear()
    star.join("agent-01")
    star.run(1.2, from_s=1.0)

    assert [t_s for t_s, _ in told(star)][:2] == pytest.approx([1.0, 1.02])
    assert star.underruns() == 0


def test_readings_are_a_mapping_of_the_newest_with_all_behind_it():
    one, two = Reading(1.0, (1.0,)), Reading(2.0, (2.0,))
    readings = StepReadings({"gyro": two, "gnss": one}, {"gyro": [one, two], "gnss": [one]})

    assert readings == {"gyro": two, "gnss": one}
    assert readings.since("gyro") == (one, two)
    assert readings.since("gnss") == (one,)
    assert readings.since("clock") == ()
    assert readings.samples == {"gyro": (one, two)}


PROGRAM = """
import json, sys
for line in sys.stdin:
    told = json.loads(line)
    if "setup" in told:
        continue
    counts = {name: len(all) for name, all in told.get("samples", {}).items()}
    print(json.dumps({"t_s": told["t_s"], "estimate": {"readings": counts.get("gyro", -1)}}), flush=True)
"""


@pytest.mark.process
def test_a_program_is_given_samples_where_there_are_several(tmp_path):
    (tmp_path / "program.py").write_text(PROGRAM)
    params = parameters(
        vehicles=[{"attitude": BODY, "sensors": {"gyro": {"rate_hz": 10.0}}}],
        flight={"command": [sys.executable, "program.py"], "rate_hz": 2.0, "answer_s": 60.0},
    )
    star = Star(params, 1, base_directory=tmp_path, is_lockstep=True)
    star.run(1.25)
    star.summaries()

    assert star.contexts["agent-01"].records["estimates"] == [(0, -1.0), (5, 5.0), (10, 5.0)]


@pytest.mark.process
@pytest.mark.parametrize("protocol", ["json_lines", "frames", "space_packets"])
@pytest.mark.parametrize(("rate_hz", "steps"), [(2.0, 5), (10.0, 21), (50.0, 101)])
def test_by_every_protocol_each_step_is_one_report_and_one_answer(
    tmp_path, protocol, rate_hz, steps
):
    program = Path(__file__).with_name("guided_program.py")
    params = parameters(
        vehicles=[{"sensors": {"gnss": {"rate_hz": rate_hz}}}],
        flight={
            "command": [sys.executable, str(program), protocol, "stdio"],
            "interface": {"protocol": protocol},
            "rate_hz": rate_hz,
            "answer_s": 60.0,
            "settings": {"a_m": 0.0, "tolerance_m": 1e12, "lead_s": 1.0},
        },
    )
    star = Star(params, 1, base_directory=tmp_path, is_lockstep=True)
    star.run(2.05)
    flight = star.summaries()["agent-01"]["flight"]

    counts = {
        name: flight[name] for name in ("ticks_sent", "answers", "unanswered", "ticks_skipped")
    }
    assert counts == {"ticks_sent": steps, "answers": steps, "unanswered": 0, "ticks_skipped": 0}
    assert not any(flight["interface"]["faults"].values())
    records = star.contexts["agent-01"].records
    # Each step had a measurement, and what was believed at it is on record.
    assert len(records["gnss"]) == len(records["estimates"]) == steps
