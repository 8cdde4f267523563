"""Failures that a timeline orders: what weak thrusters give, what failed wheels refuse, what faulty sensors measure."""

import pytest

from madns_runtime.simulations.constellation.actions import SensorFault
from madns_runtime.simulations.constellation.truth.maneuvers.actuators import (
    WHEELS_FAILED,
    ActuatorFailures,
)
from madns_runtime.simulations.constellation.vehicle.sensors.sensor_failures import SensorFailures


def test_thrusters_give_their_share_until_the_failure_is_lifted():
    failures = ActuatorFailures()
    failures.weaken(1, {0: 0.5})
    failures.weaken(2, {0: 0.5, 1: 0.0})

    assert (failures.share(0), failures.share(1), failures.share(2)) == (0.25, 0.0, 1.0)
    failures.lift(2)
    assert (failures.share(0), failures.share(1)) == (0.5, 1.0)
    failures.lift(1)
    assert failures.share(0) == 1.0


def test_failed_wheels_refuse_torques_of_their_vehicle_alone():
    failures = ActuatorFailures()
    failures.fail_wheels(1, frozenset({2}))

    assert failures.refusal(2, "torque") == WHEELS_FAILED
    assert failures.refusal(2, "delta_v") == failures.refusal(1, "torque") == ""
    failures.lift(1)
    assert failures.refusal(2, "torque") == ""


def test_a_biased_sensor_adds_to_its_first_values_and_a_dead_one_gives_none():
    failures = SensorFailures()
    assert not failures
    failures.begin(1, SensorFault(sensor="gnss", fault="biased", bias=(500.0,)))

    assert failures.altered((1.0, 2.0)) == (501.0, 2.0)
    failures.begin(2, SensorFault(sensor="gnss", fault="dead"))
    assert failures.altered((1.0, 2.0)) is None
    failures.end(2)
    failures.end(1)
    assert not failures


def test_a_biased_direction_stays_one_and_none_is_left_where_the_bias_takes_all_of_it():
    failures = SensorFailures(is_unit=True)
    failures.begin(1, SensorFault(sensor="sun_sensor", fault="biased", bias=(0.0, 0.75)))

    assert failures.altered((1.0, 0.0, 0.0)) == pytest.approx((0.8, 0.6, 0.0))
    assert failures.altered((0.0, -0.75, 0.0)) is None


def test_a_sensor_that_sticks_again_does_so_where_it_is_though_another_failure_outlasts_the_first():
    failures = SensorFailures()
    failures.begin(1, SensorFault(sensor="gyro", fault="stuck"))
    failures.begin(2, SensorFault(sensor="gyro", fault="biased", bias=(100.0,)))
    assert failures.altered((1.0,)) == (101.0,)
    failures.end(1)
    assert failures.altered((2.0,)) == (102.0,)

    failures.begin(3, SensorFault(sensor="gyro", fault="stuck"))

    assert failures.altered((3.0,)) == failures.altered((4.0,)) == (103.0,)


def test_a_stuck_sensor_repeats_what_it_measured_when_it_stuck_and_forgets_it_afterwards():
    failures = SensorFailures()
    failures.begin(1, SensorFault(sensor="gyro", fault="stuck"))

    assert [failures.altered((float(n),)) for n in (1, 2, 3)] == [(1.0,)] * 3
    failures.end(1)
    failures.begin(2, SensorFault(sensor="gyro", fault="stuck"))
    assert failures.altered((7.0,)) == pytest.approx((7.0,))
