"""Propagators of every kind with settings to choose, and orbits to fly."""

import importlib.util
import math
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np
import pytest
from constellation_fakes import SCENARIOS

from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.parameters import (
    BasiliskPropagator,
    CustomPropagator,
    NumbaPropagator,
    ScipyPropagator,
    Sgp4Propagator,
)
from madns_runtime.simulations.constellation.truth.element_sets import read_element_sets
from madns_runtime.simulations.constellation.truth.propagation import PropagationParameters

EXTRAS = {"numba": "numba", "basilisk": "Basilisk"}
OWN = """
from madns_runtime.simulations.constellation.parameters import ScipyPropagator
from madns_runtime.simulations.constellation.truth.propagators.scipy_propagator import ScipyDop853
from dataclasses import replace

class Mine:
    def propagate(self, states, t0_s, knots_s, parameters):
        forces = tuple(parameters.settings.settings["forces"])
        settings = ScipyPropagator(kind="scipy", forces=forces)
        return ScipyDop853().propagate(states, t0_s, knots_s, replace(parameters, settings=settings))

class Flat:
    def propagate(self, states, t0_s, knots_s, parameters):
        return states

class Demanding:
    def __init__(self, orbit):
        pass

class Idle:
    pass
"""


class Kind(NamedTuple):
    settings: object
    base_directory: str
    element_sets: tuple

    def parameters(self, **rest):
        return PropagationParameters(
            settings=self.settings,
            gravity=EGM_96,
            epoch_utc=datetime(2017, 3, 7, 12, tzinfo=UTC),
            element_sets=self.element_sets,
            base_directory=self.base_directory,
            **rest,
        )

    @property
    def is_numerical(self):
        return not isinstance(self.settings, Sgp4Propagator)


def make_kind(name, folder, forces=("two_body", "j2"), **settings):
    if name in EXTRAS and importlib.util.find_spec(EXTRAS[name]) is None:
        pytest.skip(f"{EXTRAS[name]} is not installed")
    if name == "sgp4":
        sets = read_element_sets(SCENARIOS / "data/iridium10.tle")[:4]
        return Kind(Sgp4Propagator(kind="sgp4"), str(folder), sets)
    if name == "custom":
        own = CustomPropagator(
            kind="custom", implementation="own.py:Mine", settings={"forces": list(forces)}
        )
        return Kind(own, str(folder), ())
    classes = {
        "scipy": ScipyPropagator,
        "numba": NumbaPropagator,
        "basilisk": BasiliskPropagator,
    }
    return Kind(classes[name](kind=name, forces=forces, **settings), str(folder), ())


def orbits(count=4, radius_m=6.9e6):
    """Circular orbits, as different as can be."""
    rng = np.random.default_rng(5)
    r = rng.normal(size=(count, 3))
    r /= np.linalg.norm(r, axis=1, keepdims=True)
    v = np.cross(r, rng.normal(size=(count, 3)))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    return np.hstack((r * radius_m, v * math.sqrt(EGM_96.mu_m3_s2 / radius_m)))


def distance_m(a, b):
    return float(np.linalg.norm((a - b)[..., :3], axis=-1).max())
