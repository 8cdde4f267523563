"""What a timeline may do on the road."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Gt, Le

from madns_runtime.plugin.api import ActionKind


@dataclass(frozen=True, slots=True, kw_only=True)
class Brake:
    """Parameters of brake."""

    deceleration_m_s2: Annotated[float, Gt(0), Le(9)] = 6.0


BRAKE = ActionKind(
    word="brake",
    summary="Has cars brake, whatever their drivers want.",
    parameters=Brake,
    lasting="must",
)
