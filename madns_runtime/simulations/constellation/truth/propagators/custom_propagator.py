"""A propagator of one's own: a class in a file beside the scenario, or in an installed module."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import BlamedError
from madns_runtime.plugin.context import describe_exception
from madns_runtime.plugin.isolation import is_from_outside
from madns_runtime.plugin.registry import load_function
from madns_runtime.simulations.constellation.parameters import CustomPropagator
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    Propagator,
)

GAIN_M_S_MIN = 1e-6
"""Less that a thrust gives may be lost in the digits of a velocity."""


class Custom:
    """Hands over to the class that the settings name."""

    def __init__(self) -> None:
        self._heeding: set[tuple[str, str]] = set()
        """Classes, with their folders, that were seen to follow a thrust."""

    def propagate(
        self,
        states: NDArray[np.float64],
        t0_s: float,
        knots_s: NDArray[np.float64],
        parameters: PropagationParameters,
    ) -> NDArray[np.float64]:
        """
        Return what the named class returns, see `Propagator.propagate`.

        It may do with the arrays what it wants.

        Raises:
            PluginError: The class cannot be found, made without arguments, or has no propagate; or that
                raised, or leaves out a thrust.
        """
        found = _call(states, t0_s, knots_s, parameters)
        thrust_m_s2 = parameters.thrust_m_s2
        if thrust_m_s2 is not None and len(thrust_m_s2):
            key = _implementation(parameters), parameters.base_directory
            most_m_s2 = float(np.abs(thrust_m_s2).max())
            if key not in self._heeding and most_m_s2 * (knots_s[-1] - t0_s) >= GAIN_M_S_MIN:
                coasting = replace(parameters, thrust_m_s2=None)
                _check_thrust(found, _call(states, t0_s, knots_s, coasting), key[0], most_m_s2)
                self._heeding.add(key)
        return found


def _check_thrust(
    found: NDArray[np.float64],
    coasting: NDArray[np.float64],
    implementation: str,
    thrust_m_s2: float,
) -> None:
    """
    See that a class follows a thrust: a burn that it leaves out would be booked, and not be in truth.

    Raises:
        BlamedError: It returns the same as without.
    """
    if np.array_equal(found, coasting):
        raise BlamedError(
            f"{implementation}.propagate returns the same with parameters.thrust_m_s2 of {thrust_m_s2:.3g} m/s^2"
            " as without: expected it to be added to the accelerations; or leave out thrust_n of thrusters, whose"
            " burns are impulses then, or say can_maneuver: false of the propagator"
        )


def _implementation(parameters: PropagationParameters) -> str:
    settings = parameters.settings
    assert isinstance(settings, CustomPropagator)
    return settings.implementation


def _call(
    states: NDArray[np.float64],
    t0_s: float,
    knots_s: NDArray[np.float64],
    parameters: PropagationParameters,
) -> NDArray[np.float64]:
    implementation = _implementation(parameters)
    propagator = load_custom(implementation, parameters.base_directory)
    try:
        return propagator.propagate(states.copy(), t0_s, knots_s.copy(), parameters)
    except BaseException as error:  # a class of one's own may raise anything
        if is_from_outside(error):
            raise
        doing = f"{implementation}.propagate at {t0_s:g} s"
        raise BlamedError(describe_exception(error, doing, propagator.propagate)) from error


@lru_cache(maxsize=4)
def load_custom(implementation: str, base_directory: str) -> Propagator:
    """
    Return an object of the named class, one per process, so that it may set much up.

    Args:
        implementation: file.py:Class, found from *base_directory*, or module:Class.
        base_directory: Folder of the scenario.

    Raises:
        PluginError: It cannot be found, made without arguments, or has no propagate.
    """
    made = load_function(implementation, Path(base_directory))
    try:
        propagator: Propagator = made()
    except BaseException as error:  # a class of one's own may raise anything
        if is_from_outside(error):
            raise
        raise BlamedError(describe_exception(error, implementation, made)) from error
    if not callable(getattr(propagator, "propagate", None)):
        raise BlamedError(
            f"{implementation}: expected a class with the method "
            "propagate(states, t0_s, knots_s, parameters), it has none"
        )
    return propagator
