"""A receiver that jumps is found out by the vehicle's own dynamics, and corrected; burns and noise are no jumps."""

import numpy as np
import pytest
from control_harness import SCENARIOS

from madns_runtime.plugin.registry import load_object
from madns_runtime.simulations.constellation.flight.api import Reading
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.frames import rtn_to_inertial

FIX_S, RADIUS_M = 60.0, 7.158e6
SUBSTEPS = 60


@pytest.fixture
def software():
    """scenarios/flight/guarded_slot_keeping.py, imported as a run does: its neighbours are found."""
    module, _ = load_object("flight/guarded_slot_keeping.py:GuardedSlotKeeping", SCENARIOS)
    return module


def orbit(gravity, count, *, burn_at=None, burn_m_s=1.0):
    """Return true states at each fix, by small steps of Runge and Kutta; a burn along the track half-way to one."""
    speed_m_s = np.sqrt(EGM_96.mu_m3_s2 / RADIUS_M)
    state = np.array([RADIUS_M, 0.0, 0.0, 0.0, 0.1 * speed_m_s, 0.995 * speed_m_s])
    states = [state]
    step_s = FIX_S / SUBSTEPS

    def rate(y):
        return np.concatenate((y[3:], gravity(y[:3])))

    for fix in range(1, count):
        for substep in range(SUBSTEPS):
            k1 = rate(state)
            k2 = rate(state + 0.5 * step_s * k1)
            k3 = rate(state + 0.5 * step_s * k2)
            k4 = rate(state + step_s * k3)
            state = state + step_s / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
            if fix == burn_at and substep == SUBSTEPS // 2:
                state[3:] += rtn_to_inertial(state[:3], state[3:]) @ (0.0, burn_m_s, 0.0)
        states.append(state)
    return states


def readings(states, *, biased=range(0), bias_m=(500.0, 0.0, 0.0), noise_m=0.0):
    random = np.random.default_rng(1)
    for number, state in enumerate(states):
        measured = state.copy()
        measured[:3] += random.normal(0.0, noise_m, 3) if noise_m else 0.0
        if number in biased:
            measured[:3] += bias_m
        yield Reading(number * FIX_S, tuple(measured.tolist()))


def test_bias_is_found_at_its_first_fix_and_gone_when_it_goes(software):
    states = orbit(software.gravity, 30)
    guard = software.GnssGuard(jump_m_max=150.0, gap_s_max=600.0)

    fixed = [guard.corrected(fix) for fix in readings(states, biased=range(10, 20))]

    assert guard.jumps == 2
    assert np.linalg.norm(guard.bias_m) < 0.5
    for state, fix in zip(states, fixed, strict=True):
        assert fix.values[:3] == pytest.approx(state[:3], abs=0.5)
        assert fix.values[3:] == tuple(state[3:])


def test_burn_of_a_metre_per_second_and_noise_are_no_jumps(software):
    states = orbit(software.gravity, 20, burn_at=8)
    guard = software.GnssGuard(jump_m_max=150.0, gap_s_max=600.0)

    fixed = [guard.corrected(fix) for fix in readings(states, noise_m=5.0)]

    assert guard.jumps == 0
    assert np.linalg.norm(np.subtract(fixed[-1].values[:3], states[-1][:3])) < 30.0


def test_fixes_too_far_apart_are_not_compared(software):
    states = orbit(software.gravity, 20)
    guard = software.GnssGuard(jump_m_max=150.0, gap_s_max=600.0)
    given = list(readings(states, biased=range(15, 20)))

    for fix in (*given[:3], *given[15:]):
        guard.corrected(fix)

    assert guard.jumps == 0
