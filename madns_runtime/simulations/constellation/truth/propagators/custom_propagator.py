"""A propagator of one's own: a class in a file beside the scenario, or in an installed module."""

from __future__ import annotations

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


class Custom:
    """Hands over to the class that the settings name."""

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
                raised.
        """
        settings = parameters.settings
        assert isinstance(settings, CustomPropagator)
        propagator = load_custom(settings.implementation, parameters.base_directory)
        try:
            return propagator.propagate(states.copy(), t0_s, knots_s.copy(), parameters)
        except BaseException as error:  # a class of one's own may raise anything
            if is_from_outside(error):
                raise
            doing = f"{settings.implementation}.propagate at {t0_s:g} s"
            raise BlamedError(describe_exception(error, doing)) from error


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
        raise BlamedError(describe_exception(error, implementation)) from error
    if not callable(getattr(propagator, "propagate", None)):
        raise BlamedError(
            f"{implementation}: expected a class with the method "
            "propagate(states, t0_s, knots_s, parameters), it has none"
        )
    return propagator
