"""What did not go as it should: a sentence, whose machine it is about, and which step met it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

Step = Literal["run", "collect"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """One of them, as run.json holds it."""

    text: str
    """Names who and why."""
    machine: str | None = None
    """The machine that failed; None if it was none of them, such as the host's own process."""
    step: Step = "run"
    """What the run met stays for ever; what collecting met is found anew each time, or is mended."""

    def to_mapping(self) -> dict[str, Any]:
        """Return it as run.json holds it."""
        return {"machine": self.machine, "text": self.text, "step": self.step}


def problems_of_run(listed: object) -> tuple[Problem, ...]:
    """Return what the run itself met, of the problems in a run.json; what is no problem is left out."""
    items = listed if isinstance(listed, list) else []
    return tuple(
        Problem(text=str(item["text"]), machine=_name(item.get("machine")))
        for item in items
        if isinstance(item, Mapping) and "text" in item and item.get("step") == "run"
    )


def _name(value: object) -> str | None:
    return value if isinstance(value, str) else None
