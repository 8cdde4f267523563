"""A propagator of one's own."""

from dataclasses import replace

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
            r"^own.py:Demanding raised TypeError: .*orbit.* \(own.py:\d+\)$",
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


PUSHED = """import numpy as np


class Mine:
    def propagate(self, states, t0_s, knots_s, parameters):
        after_s = (knots_s - t0_s)[None, :, None]
        push = parameters.thrust_m_s2 if {heeds} else None
        v = states[:, None, 3:] + (0.0 if push is None else push[:, None] * after_s)
        return np.concatenate((states[:, None, :3] + v * after_s, v + 0.0 * after_s), axis=2)
"""


@pytest.mark.parametrize("heeds", [True, False])
def test_a_propagator_of_ones_own_that_leaves_out_a_thrust_is_refused(tmp_path, heeds):
    (tmp_path / "own.py").write_text(PUSHED.format(heeds=heeds))
    parameters = make_kind("custom", tmp_path).parameters()
    pushed = replace(parameters, thrust_m_s2=np.full((4, 3), 0.01))
    knots_s = np.array([8.0, 9.0])

    assert propagate(orbits(), 7.0, knots_s, parameters).shape == (4, 2, 6)
    if heeds:
        gained = propagate(orbits(), 7.0, knots_s, pushed)[:, -1, 3:] - orbits()[:, 3:]
        assert gained == pytest.approx(0.02)
        return
    with pytest.raises(BlamedError, match=r"^own.py:Mine.propagate returns the same .* 0.01 m/s"):
        propagate(orbits(), 7.0, knots_s, pushed)


def test_a_thrust_too_small_to_be_seen_is_no_fault_of_a_propagator(tmp_path):
    (tmp_path / "own.py").write_text(PUSHED.format(heeds=False))
    parameters = make_kind("custom", tmp_path).parameters()
    pushed = replace(parameters, thrust_m_s2=np.full((4, 3), 1e-9))

    assert propagate(orbits(), 7.0, np.array([8.0]), pushed).shape == (4, 1, 6)
