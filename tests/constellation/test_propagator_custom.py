"""A propagator of one's own."""

import numpy as np
import pytest
from propagator_kinds import OWN, make_kind, orbits

from madns_runtime.errors import BlamedError, ConfigurationError, PluginError
from madns_runtime.plugin import isolation
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
        (
            "own.py:Demanding",
            PluginError,
            r"^own.py:Demanding raised TypeError: .*orbit.* \(custom_propagator.py:\d+\)$",
        ),
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
    module = "madns_runtime.simulations.constellation.truth.propagators.sgp4_propagator:Sgp4"
    settings = CustomPropagator(kind="custom", implementation=module, can_maneuver=False)
    sgp4 = make_kind("sgp4", folder)

    found = propagate(orbits(), 0.0, np.array([1.0]), sgp4._replace(settings=settings).parameters())

    assert np.array_equal(found, propagate(orbits(), 0.0, np.array([1.0]), sgp4.parameters()))


@pytest.mark.parametrize("kind", ["SystemExit", "KeyboardInterrupt", "ValueError"])
def test_what_a_propagator_of_ones_own_raises_is_told_with_its_line(folder, kind, monkeypatch):
    monkeypatch.setattr(isolation, "is_interruption", lambda error: False)  # as in its process
    (folder / "own.py").write_text(
        "class Mine:\n"
        "    def propagate(self, states, t0_s, knots_s, parameters):\n"
        "        states[:] = 0.0\n"
        f"        raise {kind}('no thrust')\n"
    )
    states = orbits()

    with pytest.raises(
        BlamedError,
        match=rf"^own.py:Mine.propagate at 7 s raised {kind}: no thrust \(own.py:4\)$",
    ):
        propagate(states, 7.0, np.array([8.0]), make_kind("custom", folder).parameters())

    assert np.array_equal(states, orbits())


@pytest.mark.parametrize(
    ("made", "got"),
    [
        ("found.tolist()", "list"),
        ("found.astype('f4')", r"\(4, 1, 6\) of float32"),
        ("found[:, :0]", r"\(4, 0, 6\) of float64"),
        ("None", "NoneType"),
    ],
)
def test_what_is_no_array_of_states_is_refused(folder, made, got):
    (folder / "own.py").write_text(
        "class Mine:\n"
        "    def propagate(self, states, t0_s, knots_s, parameters):\n"
        "        found = states[:, None]\n"
        f"        return {made}\n"
    )

    with pytest.raises(ConfigurationError, match=rf"shape \(4, 1, 6\) of float64, got {got}$"):
        propagate(orbits(), 0.0, np.array([1.0]), make_kind("custom", folder).parameters())
