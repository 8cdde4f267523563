"""Entries of a scenario's timeline as a person writes them, and what is wrong with one by itself."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final

from annotated_types import Ge, Gt, Le

from cosmos_cli.models.text_forms import NonBlank
from cosmos_cli.models.value_rules import AwaitedRule
from madns_runtime.plain_values import FORBID_EXTRA

ENTRIES_MAX: Final = 1000
RATE_PER_H_MAX: Final = 3600
WHEN_WORDS: Final = ("at_s", "every_s", "when", "rate_per_h")
NO_TIME: Final = "expected a time beside it"
RuleFault = tuple[tuple[str | int, ...], str]
"""The path within the entry, and what is wrong there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TimelineRule:
    """One entry: an action, and when it is to happen. Further keys are the action's own parameters."""

    __pydantic_config__ = FORBID_EXTRA

    action: NonBlank
    """Word of the action: annotate, stop, stress, device_fault, a fault, or one that the simulation declares."""
    agents: tuple[NonBlank, ...] = ()
    """Names, labels or globs of the agents that it acts on."""
    at_s: Annotated[float, Ge(0)] | None = None
    """Simulated time, s: once."""
    every_s: Annotated[float, Gt(0)] | None = None
    """Period, s: at from_s, and again and again until to_s."""
    when: AwaitedRule | None = None
    """Once, when this first holds: of the first agent, or of the host's half."""
    rate_per_h: Annotated[float, Gt(0), Le(RATE_PER_H_MAX)] | None = None
    """By chance under the seed, so often an hour on average: each agent for itself, or the run."""
    from_s: Annotated[float, Ge(0)] | None = None
    """Of every_s and rate_per_h: the first simulated time, s; 0 if not given."""
    to_s: Annotated[float, Ge(0)] | None = None
    """Of every_s and rate_per_h: the last simulated time, s; the end of the run if not given."""
    for_s: Annotated[float, Gt(0)] | None = None
    """How long it lasts, s; not given: until the end of the run, for an action that lasts."""

    def own_faults(self) -> Iterator[RuleFault]:
        """Yield what is wrong with the entry by itself."""
        given = [word for word in WHEN_WORDS if getattr(self, word) is not None]
        listed = ", ".join(WHEN_WORDS)
        if not given:
            yield ("action",), f"{NO_TIME}: one of {listed}"
        for word in given[1:]:
            yield (word,), f"expected one of {listed}, got {given[0]} as well: write two entries"
        if given[:1] not in (["every_s"], ["rate_per_h"]):
            for word in ("from_s", "to_s"):
                if getattr(self, word) is not None:
                    yield (word,), "goes with every_s or rate_per_h: leave it out"
        elif self.to_s is not None and self.to_s < (self.from_s or 0.0):
            yield ("to_s",), f"expected >= from_s ({self.from_s or 0.0:g}), got {self.to_s:g}"


RULE_KEYS: Final = tuple(field.name for field in dataclasses.fields(TimelineRule))


def parameters_in(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return what of an entry as it is written is its action's own."""
    return {key: value for key, value in entry.items() if key not in RULE_KEYS}
