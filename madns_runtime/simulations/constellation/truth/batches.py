"""
A stretch of truth in parts: what several workers compute at once, the same to the last digit however many.

scipy takes one step size for all vehicles of a call, so who is in a call shows in the last digits
(1e-9 m). Vehicles are therefore propagated in blocks that follow from their order alone: the first
BLOCK, the next BLOCK, and so on. A part is some blocks in a row, and cutting a part into blocks again
gives the same ones: neither the machine nor the number of workers is seen in the result. Pure but for
the propagation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    Stretch,
    StretchRequest,
    propagate_stretch,
)

BLOCK = 500
"""Vehicles that share a call where they see each other: fewer cost more overhead than workers save."""
INDEPENDENT_BLOCK = 50
"""Least vehicles in a part where each is computed by itself, and parts may be cut anywhere."""
INDEPENDENT = frozenset({"numba", "sgp4", "basilisk"})
"""Propagators for which a vehicle's neighbours change none of its digits."""

Part = tuple[StretchRequest, PropagationParameters]
"""Arguments of `propagate_part`."""


def split(request: StretchRequest, parameters: PropagationParameters, parts_max: int) -> list[Part]:
    """
    Cut a request into at most *parts_max* parts of nearly equal size, in the vehicles' order.

    Args:
        request: All vehicles.
        parameters: What is one a vehicle is in the order of the request.
        parts_max: Parts wanted, at least 1: the workers, N_p.
    """
    size = INDEPENDENT_BLOCK if parameters.settings.kind in INDEPENDENT else BLOCK
    count = len(request.states)
    blocks = max(1, -(-count // size))
    parts = min(max(1, parts_max), blocks)
    edges = [min(size * (blocks * n // parts), count) for n in range(parts + 1)]
    return [
        _cut(request, parameters, slice(first, last))
        for first, last in zip(edges[:-1], edges[1:], strict=True)
    ]


def propagate_part(request: StretchRequest, parameters: PropagationParameters) -> Stretch:
    """Compute a part, or the whole, block by block; runs in the executor."""
    count, kind = len(request.states), parameters.settings.kind
    if count <= BLOCK or kind in INDEPENDENT:
        return propagate_stretch(request, parameters)
    blocks = [slice(first, first + BLOCK) for first in range(0, count, BLOCK)]
    return merge([propagate_stretch(*_cut(request, parameters, block)) for block in blocks])


def merge(parts: Sequence[Stretch]) -> Stretch:
    """
    Put parts together again, in the order of `split`.

    Raises:
        ValueError: They are not of the same knots.
    """
    knots = {(part.first_knot, part.states.shape[1]) for part in parts}
    if len(knots) != 1:
        raise ValueError(f"parts: expected one stretch's, got first knots and lengths {knots}")
    if len(parts) == 1:
        return parts[0]
    return Stretch(
        first_knot=parts[0].first_knot,
        states=np.concatenate([part.states for part in parts]),
        invariants=np.concatenate([part.invariants for part in parts]),
    )


def _cut(request: StretchRequest, parameters: PropagationParameters, part: slice) -> Part:
    """Return the request and the parameters of some of the vehicles."""
    ballistic, thrust = parameters.ballistic_m2_kg, parameters.thrust_m_s2
    return (
        replace(request, states=request.states[part]),
        replace(
            parameters,
            element_sets=parameters.element_sets[part],
            ballistic_m2_kg=None if ballistic is None else ballistic[part],
            thrust_m_s2=None if thrust is None else thrust[part],
            names=parameters.names[part],
        ),
    )
