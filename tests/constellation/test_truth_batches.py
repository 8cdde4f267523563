"""Truth in parts: nearly equal, in order, and the same to the last digit however many workers."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from constellation_fakes import SCENARIOS, parameters

from madns_runtime.config import from_mapping
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.parameters import (
    BasiliskPropagator,
    NumbaPropagator,
    ScipyPropagator,
    Sgp4Propagator,
)
from madns_runtime.simulations.constellation.truth import propagation
from madns_runtime.simulations.constellation.truth.initial_states import load_fleet
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    StretchRequest,
    merge,
    propagate_part,
    propagate_stretch,
    split,
)

SCIPY = ScipyPropagator(kind="scipy", forces=("two_body", "j2", "drag"))


def fleet(count, settings=SCIPY):
    """Vehicles between 500 and 1500 km, so that each would choose a step of its own."""
    rng = np.random.default_rng(5)
    r = rng.normal(size=(count, 3))
    r /= np.linalg.norm(r, axis=1)[:, None]
    v = np.cross(r, rng.normal(size=(count, 3)))
    v /= np.linalg.norm(v, axis=1)[:, None]
    radius = rng.uniform(6.88e6, 7.88e6, size=(count, 1))
    states = np.hstack((r * radius, v * np.sqrt(EGM_96.mu_m3_s2 / radius)))
    given = PropagationParameters(
        settings=settings,
        gravity=EGM_96,
        epoch_utc=datetime(2026, 1, 1, tzinfo=UTC),
        ballistic_m2_kg=rng.uniform(0.005, 0.02, size=count),
        names=tuple(f"SAT-{n}" for n in range(count)),
    )
    return StretchRequest(first_knot=30, knots=4, knot_s=1.0, states=states), given


def in_parts(request, given, workers):
    parts = split(request, given, workers)
    return merge([propagate_part(*part) for part in parts])


@pytest.mark.parametrize(
    ("count", "workers", "sizes"),
    [
        (1, 4, [1]),
        (500, 4, [500]),
        (501, 4, [500, 1]),
        (5000, 1, [5000]),
        (5000, 2, [2500, 2500]),
        (5000, 4, [1000, 1500, 1000, 1500]),
        (2100, 3, [500, 1000, 600]),
        (1000, 0, [1000]),
    ],
)
def test_parts_are_whole_blocks_in_order(count, workers, sizes):
    request, given = fleet(count)
    parts = split(request, given, workers)

    assert [len(part.states) for part, _ in parts] == sizes
    assert np.array_equal(np.concatenate([part.states for part, _ in parts]), request.states)
    assert sum((own.names for _, own in parts), ()) == given.names
    ballistic = np.concatenate([own.ballistic_m2_kg for _, own in parts])
    assert np.array_equal(ballistic, given.ballistic_m2_kg)


def test_the_number_of_workers_changes_no_digit(monkeypatch):
    monkeypatch.setattr(propagation, "BLOCK", 7)
    # Steps that the error bounds, not their limit: those differ with who is in a call, on any processor.
    request, given = fleet(45, replace(SCIPY, step_s_max=300.0))
    request = replace(request, knot_s=30.0)
    given = replace(given, thrust_m_s2=np.random.default_rng(1).normal(size=(45, 3)) * 1e-3)
    one = in_parts(request, given, 1)

    for workers in (2, 3, 7, 50):
        several = in_parts(request, given, workers)
        assert np.array_equal(one.states, several.states)
        assert np.array_equal(one.invariants, several.invariants)
    assert one.first_knot == 30
    # Were the blocks those of the workers, digits would differ: all vehicles in one call do.
    assert 1e-9 < np.abs(one.states - propagate_stretch(request, given).states).max() < 1e-6


@pytest.mark.parametrize("kind", ["sgp4", "numba", "basilisk"])
def test_propagators_of_single_vehicles_may_be_cut_anywhere(monkeypatch, kind):
    monkeypatch.setattr(propagation, "INDEPENDENT_BLOCK", 1)
    if kind == "numba":
        pytest.importorskip("numba", reason="the extra `fast` is not installed")
        request, given = fleet(7, NumbaPropagator(kind="numba"))
    elif kind == "basilisk":
        pytest.importorskip("Basilisk", reason="the extra `basilisk` is not installed")
        request, given = fleet(7, BasiliskPropagator(kind="basilisk", step_s=0.5))
    else:
        flown = load_fleet(parameters({"elements": "data/iridium10.tle"}), 7, SCENARIOS)
        request = StretchRequest(first_knot=0, knots=4, knot_s=1.0, states=flown.states)
        given = PropagationParameters(
            settings=from_mapping(Sgp4Propagator, {"kind": "sgp4"}),
            gravity=EGM_96,
            epoch_utc=flown.epoch_utc,
            element_sets=flown.element_sets,
        )
    one = in_parts(request, given, 1)

    for workers in (2, 3, 7):
        assert len(split(request, given, workers)) == workers
        assert np.array_equal(one.states, in_parts(request, given, workers).states)


def test_parts_of_different_stretches_are_not_put_together():
    request, given = fleet(3)
    one, other = (propagate_stretch(replace(request, knots=n), given) for n in (3, 4))

    with pytest.raises(ValueError, match="one stretch"):
        merge([one, other])
