"""When a command was over, from the host's record of it: a finite burn is centred on its time. Pure numpy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from madns_runtime.analysis.sampling import as_array
from madns_runtime.analysis.values import Floats

EXECUTED: Final = "executed_s"
TIMES: Final = (EXECUTED, "commanded_s", "at_s", "propagation_s", "network_s", "slack_s")
"""Fields of the host's stream that tell it; without the others a command is over at its time."""
HALF_S_MIN: Final = 1e-3
"""Less is the rounding of times: no burn is so short."""


def ends_s(columns: Mapping[str, Any]) -> Floats:
    """
    Return until when commands acted, s; NaN for those that were refused.

    Args:
        columns: Of the host's record of maneuvers, those of TIMES that there are, shape (N,).

    The record has no length of a burn, but the slack of its inequality counts from its beginning as commanded:
    slack_s = begin - commanded_s - (propagation_s + 2 network_s).
    """
    executed_s = as_array(columns[EXECUTED])
    if not columns.keys() >= set(TIMES):
        return executed_s
    commanded_s, at_s, propagation_s, network_s, slack_s = (
        as_array(columns[name]) for name in TIMES[1:]
    )
    half_s = at_s - (commanded_s + slack_s + propagation_s + 2.0 * network_s)
    return executed_s + np.where(half_s > HALF_S_MIN, half_s, 0.0)
