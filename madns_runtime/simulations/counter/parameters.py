"""What a person may set of the counting benchmark."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Le

from madns_runtime.config import FORBID_EXTRA


@dataclass(frozen=True, slots=True, kw_only=True)
class CounterParameters:
    """How the counting packets travel."""

    __pydantic_config__ = FORBID_EXTRA

    service: Literal["best", "reliable", "sync"] = "best"
    """Class of service: best as a bare datagram, reliable and sync with delivery guaranteed."""
    payload_bytes: Annotated[int, Ge(0), Le(1000)] = 0
    """Further bytes in every packet."""
