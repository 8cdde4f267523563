"""Checks of devices of one name that measure different things: each is judged in its own unit."""

import math

import pytest
from pydantic import TypeAdapter

from cosmos_cli.evidence.expectations.judge import judge_expectations
from cosmos_cli.evidence.expectations.of_run import recorded_devices
from cosmos_cli.evidence.tables import open_tables
from cosmos_cli.evidence.tabulate import gather
from cosmos_cli.models.agent_labels import NO_LABELS
from cosmos_cli.models.check_rules import CheckRule
from cosmos_cli.models.checks import Surroundings, resolve_checks
from cosmos_cli.models.known_streams import KnownDevice, KnownStreams
from madns_runtime.recording.records import Field, StreamSchema
from tests.harness.synthetic_run import SyntheticRun

VALUES = {"a": ("rad/s", math.pi), "b": ("V", 300.0), "c": ("deg/s", 90.0)}
FIELDS = {name: (Field("t_s", "s"), Field("rate", unit)) for name, (unit, _) in VALUES.items()}
ALL_UNITS = "in rad/s and in V and in deg/s"


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    made = SyntheticRun(tmp_path_factory.mktemp("run"))
    for agent, (_, value) in VALUES.items():
        schema = StreamSchema("gyro", FIELDS[agent])
        recorder = made.recorder(f"devices/{agent}/imu", f"{agent}/imu", schema)
        recorder.record("gyro", (1.0, value))
        recorder.close()
    assert gather(made.run, 10.0, lambda *_: None).faults == ()
    return open_tables(made.run.tables)


def declared():
    return tuple(
        KnownDevice(name="imu", sources=(f"{agent}/imu",), streams={"gyro": fields})
        for agent, fields in FIELDS.items()
    )


def resolve(devices, **words):
    around = Surroundings(
        agents=tuple(VALUES),
        labels=NO_LABELS,
        streams=KnownStreams((), devices),
        duration_s=5.0,
    )
    rule = TypeAdapter(CheckRule).validate_python(
        {"name": "x", "stream": "imu.gyro", "field": "rate", **words}
    )
    return resolve_checks([rule], around)


@pytest.mark.parametrize("is_before_the_run", [True, False])
@pytest.mark.parametrize(
    ("words", "got", "passed"),
    [
        ({"agents": ["a"], "below": 4.0}, math.pi, True),
        ({"agents": ["a"], "below": 4.0, "unit": "rad/s"}, math.pi, True),
        ({"agents": ["a"], "below": 170.0, "unit": "deg/s"}, 180.0, False),
        ({"agents": ["b"], "statistic": "max", "below": 299.0}, 300.0, False),
        ({"agents": ["b"], "below": 1.0, "unit": "kV"}, 0.3, True),
        ({"agents": ["c"], "below": 91.0}, 90.0, True),
        ({"agents": ["a", "c"], "statistic": "min", "above": 1.6}, math.pi / 2, False),
        ({"agents": ["a", "c"], "above": 89.0, "unit": "deg/s"}, 90.0, True),
        (
            {"agents": ["a"], "statistic": "first_time", "when": {"above": 179.0}, "unit": "deg/s"}
            | {"below": 2.0},
            1.0,
            True,
        ),
        ({"statistic": "count", "equals": 1}, 1.0, True),
        (
            {"agents": ["b"], "equals": 300.0}
            | {"while": {"stream": "imu.gyro", "field": "rate", "above": 0.2, "unit": "kV"}},
            300.0,
            True,
        ),
        (
            {"agents": ["a", "c"], "above": 1.6, "statistic": "last"}
            | {"while": {"stream": "imu.gyro", "field": "rate", "above": 1.6}},
            None,
            False,
        ),
    ],
)
def test_a_check_is_of_what_the_devices_measure_that_it_names(
    tables, is_before_the_run, words, got, passed
):
    resolved = resolve(declared() if is_before_the_run else recorded_devices(tables), **words)

    judged = judge_expectations(
        resolved.expectations, tables, agents=tuple(VALUES), is_lockstep=False, duration_s=5.0
    )

    assert resolved.faults == ()
    (result,) = judged.results
    assert result.got == (None if got is None else pytest.approx(got))
    assert result.passed is passed
    assert "(rate is in" not in result.expected


@pytest.mark.parametrize("is_before_the_run", [True, False])
@pytest.mark.parametrize(
    ("words", "place", "told"),
    [
        ({"below": 4.0}, ("field",), ALL_UNITS),
        ({"below": 4.0, "unit": "rad/s"}, ("field",), ALL_UNITS),
        ({"agents": ["b", "c"], "below": 4.0}, ("field",), "in V and in deg/s, which do not"),
        ({"agents": ["b"], "below": 4.0, "unit": "rad/s"}, ("unit",), "rate is in V, got 'rad/s'"),
        (
            {"statistic": "count", "equals": 1}
            | {"while": {"stream": "imu.gyro", "field": "rate", "above": 0.2}},
            ("while", "field"),
            ALL_UNITS,
        ),
    ],
)
def test_a_check_of_devices_that_measure_different_things_is_refused(
    tables, is_before_the_run, words, place, told
):
    devices = declared() if is_before_the_run else recorded_devices(tables)

    (fault,) = resolve(devices, **words).faults

    assert fault[0] == (0, *place)
    assert told in fault[1]
