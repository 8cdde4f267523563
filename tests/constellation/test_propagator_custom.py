"""A propagator of one's own."""

import numpy as np
import pytest
from propagator_kinds import OWN, make_kind, orbits

from madns_runtime.errors import ConfigurationError, PluginError
from madns_runtime.simulations.constellation.parameters import CustomPropagator
from madns_runtime.simulations.constellation.truth.propagation import propagate


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    return tmp_path


@pytest.mark.parametrize(
    ("implementation", "error", "what"),
    [
        (
            "own.py:Flat",
            ConfigurationError,
            r"of shape \(4, 1, 6\) of float64, got \(4, 6\) of float64",
        ),
        ("own.py:Idle", PluginError, "expected a class with the method propagate"),
        ("own.py:Demanding", PluginError, "own.py:Demanding: TypeError: .*orbit"),
        ("own.py:Missing", PluginError, "Missing"),
        ("absent.py:Mine", PluginError, "no file .*absent.py"),
    ],
)
def test_a_propagator_of_ones_own_that_is_none_is_refused(folder, implementation, error, what):
    settings = CustomPropagator(kind="custom", implementation=implementation)
    kind = make_kind("custom", folder)._replace(settings=settings)

    with pytest.raises(error, match=what):
        propagate(orbits(), 0.0, np.array([1.0]), kind.parameters())


def test_a_propagator_of_ones_own_may_be_an_installed_module(folder):
    module = "madns_runtime.simulations.constellation.truth.sgp4_propagator:Sgp4"
    settings = CustomPropagator(kind="custom", implementation=module, can_maneuver=False)
    sgp4 = make_kind("sgp4", folder)

    found = propagate(orbits(), 0.0, np.array([1.0]), sgp4._replace(settings=settings).parameters())

    assert np.array_equal(found, propagate(orbits(), 0.0, np.array([1.0]), sgp4.parameters()))
