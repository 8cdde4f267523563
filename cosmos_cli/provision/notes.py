"""What is worth a word about a machine that is ready all the same. Pure."""

from __future__ import annotations

from collections.abc import Iterator

from cosmos_cli.provision.facts import Facts
from cosmos_cli.provision.wanted import Wanted

CLOCK_OFFSET_S_MAX = 5.0
THROTTLED_NOW = {0: "its supply voltage is too low", 1: "its clock is capped", 2: "it is throttled"}
"""Bits of a Raspberry Pi's firmware that tell of this moment."""


def notes_of(facts: Facts, wanted: Wanted) -> tuple[str, ...]:
    """Return the notes, each with what to do."""
    return tuple([*_clock(facts), *_throttled(facts), *_priority(facts, wanted)])


def _clock(facts: Facts) -> Iterator[str]:
    offset_s = facts.clock_offset_s
    if abs(offset_s) > CLOCK_OFFSET_S_MAX:
        side = "ahead of" if offset_s > 0 else "behind"
        yield (
            f"its clock is {_duration_words(abs(offset_s))} {side} this computer's; runs do not mind,"
            " dates of its files and package sources do: let a time service set it"
        )


def _duration_words(seconds: float) -> str:
    for size_s, word in ((86_400, "days"), (3600, "h"), (60, "min")):
        if seconds >= 2 * size_s:
            return f"{seconds / size_s:.0f} {word}"
    return f"{seconds:.0f} s"


def _throttled(facts: Facts) -> Iterator[str]:
    bits = facts.throttled or 0
    found = [words for bit, words in THROTTLED_NOW.items() if bits & (1 << bit)]
    if found:
        yield f"{' and '.join(found)} at this moment; see `cosmos doctor`"


def _priority(facts: Facts, wanted: Wanted) -> Iterator[str]:
    """Yield a note if a login is not granted what the inventory asks for; root needs no grant."""
    priority, granted = wanted.settings.realtime_priority, facts.realtime_priority_max
    if priority is not None and facts.uid != 0 and granted is not None and granted < priority:
        yield (
            f"a login is granted real-time priority {granted}, not {priority}: perhaps its SSH server"
            " does not read /etc/security/limits.d; set `UsePAM yes` in /etc/ssh/sshd_config there"
        )
