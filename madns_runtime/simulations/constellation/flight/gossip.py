"""
Gossip of a ring's members: each one's newest phase and height, and how old they are.

Each exchange, a member enters its own and tells its neighbours what they do not have: news travels one
neighbour an exchange, either way round, and past a gap by whatever way there is. No sum is passed on, only
entries with the round in which they were measured, so that nothing is counted twice, a lost message only delays,
and whoever falls silent is forgotten by all in the same round. Pure.

Neighbours are the nearest one ahead and the nearest one behind who can be heard. Where one of them is silent a
member asks those behind it, one each exchange, until somebody answers: so it finds the other side of a gap.
Whoever is asked answers, near or not.

Source: Demers et al., Epidemic algorithms for replicated database maintenance, PODC 1987 (anti-entropy).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from madns_runtime.simulations.constellation.flight.entry_screening import EntryGate

ENTRY = np.dtype(
    [("member", "<u2"), ("age", "<u2"), ("phase_rad", "<f4"), ("sma_m", "<f4"), ("first_m", "<f4")]
)
"""On the air: 16 bytes. Age in rounds; semi-major axes, now and at the start, above the design orbit's."""
ENTRIES_MAX = 80
"""Of one message, 1280 bytes, which fit into one datagram; who has more to tell goes on next time."""
MEMBERS_MAX = 1 << 16
"""Largest number of members that an entry can name."""
ANGLE_RAD_MAX = 3.2
"""pi, with the rounding of a short float."""
UNKNOWN = -1
"""Round of a member of which nothing was heard."""

Floats = NDArray[np.float64]
Rounds = NDArray[np.int64]

SILENT_ROUNDS = 5
"""Without a word, after which a neighbour is silent: one of ten messages lost makes one of 100,000 such cases."""
CANDIDATES_MAX = 16
"""On each side: nobody farther away is asked."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Known:
    """Knowledge of the members, oneself included; shape (K,) each."""

    phases_rad: Floats
    smas_m: Floats
    """Semi-major axes above the design orbit's."""
    first_smas_m: Floats
    """The same, of the start."""
    ages: Rounds
    """In rounds."""
    change_m: float
    """Of semi-major axes in a round, the mean of all that was heard in this one: how fast all fall together."""


class Gossip:
    """
    One member's entries of all.

    Args:
        count: Members, at most MEMBERS_MAX.
        index: One's own number.
        rounds_max: Age from which an entry is forgotten; more than news takes all the way.
        gate: Judges entries that follow another; none for all are believed.
    """

    def __init__(
        self, count: int, index: int, *, rounds_max: int, gate: EntryGate | None = None
    ) -> None:
        self.refused = 0
        """Entries that the gate did not believe."""
        self._gate = gate
        self._index = index
        self._rounds_max = rounds_max
        self._rounds: Rounds = np.full(count, UNKNOWN, dtype=np.int64)
        self._phase_rad, self._sma_m, self._first_m = np.zeros((3, count))
        self._change_m, self._changed_rounds = 0.0, 0
        # By neighbour: the newest round of each member that it is known to have, and when it was last told.
        self._theirs: dict[str, Rounds] = {}
        self._told: dict[str, Rounds] = {}

    def enter(self, now: int, phase_rad: float, sma_m: float) -> None:
        """Begin a round with one's own phase, within [-pi, pi), and semi-major axis above the design orbit's."""
        index = self._index
        if self._rounds[index] == UNKNOWN:
            self._first_m[index] = sma_m
        self._change_m, self._changed_rounds = 0.0, 0
        self._note_change(np.array([index]), np.array([now]), np.array([sma_m]))
        self._rounds[index], self._phase_rad[index], self._sma_m[index] = now, phase_rad, sma_m

    def hear(self, sender: str, said: int, entries: bytes, now: int) -> None:
        """
        Take what is newer than what one has.

        Args:
            sender: A neighbour.
            said: The round in which it said so.
            entries: As `tell` returned them; what is no such thing, or not yet measured, is left alone.
            now: One's own round.
        """
        is_whole = (
            not len(entries) % ENTRY.itemsize and len(entries) <= ENTRIES_MAX * ENTRY.itemsize
        )
        # Nobody's clock is ahead by more than the round that has just begun elsewhere.
        if not is_whole or not 0 <= said <= now + 1:
            return
        heard = np.frombuffer(entries, dtype=ENTRY)
        is_finite = np.isfinite(heard["sma_m"]) & np.isfinite(heard["first_m"])
        is_angle = np.abs(heard["phase_rad"]) <= ANGLE_RAD_MAX
        heard = heard[is_finite & is_angle & (heard["member"] < len(self._rounds))]
        members, rounds = heard["member"], said - heard["age"].astype(np.int64)
        known = self._of(self._theirs, sender)
        known[members] = np.maximum(known[members], rounds)
        # Nobody knows better than oneself where one is.
        is_news = (rounds > self._rounds[members]) & (members != self._index)
        if self._gate is not None:
            is_news &= self._believed(self._gate, heard, rounds, is_news)
        news, members = heard[is_news], members[is_news]
        self._note_change(members, rounds[is_news], news["sma_m"])
        self._rounds[members] = rounds[is_news]
        self._phase_rad[members], self._sma_m[members] = news["phase_rad"], news["sma_m"]
        self._first_m[members] = news["first_m"]

    def tell(self, receiver: str, now: int) -> bytes:
        """Return one's own entry and those that a neighbour is not known to have; longest untold first."""
        told = self._of(self._told, receiver)
        wanted = self._is_known(now) & (self._rounds > self._of(self._theirs, receiver))
        wanted[self._index] = False
        members = np.flatnonzero(wanted)
        members = members[np.argsort(told[members], kind="stable")][: ENTRIES_MAX - 1]
        members = np.append(members, self._index)
        told[members] = now
        entries = np.empty(len(members), dtype=ENTRY)
        entries["member"], entries["age"] = members, np.maximum(now - self._rounds[members], 0)
        entries["phase_rad"], entries["sma_m"] = self._phase_rad[members], self._sma_m[members]
        entries["first_m"] = self._first_m[members]
        return entries.tobytes()

    def known(self, now: int) -> Known:
        """Return what is not forgotten."""
        members = self._is_known(now)
        return Known(
            phases_rad=self._phase_rad[members],
            smas_m=self._sma_m[members],
            first_smas_m=self._first_m[members],
            ages=np.maximum(now - self._rounds[members], 0),
            change_m=self._change_m / max(self._changed_rounds, 1),
        )

    def _believed(
        self, gate: EntryGate, heard: NDArray[np.void], rounds: Rounds, is_news: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Return which entries follow what is known of their members, or are the first; count the others."""
        members = heard["member"]
        before = self._rounds[members]
        follows = gate.accepts(
            phases_rad=(self._phase_rad[members], heard["phase_rad"].astype(np.float64)),
            smas_m=(self._sma_m[members], heard["sma_m"].astype(np.float64)),
            rounds=rounds - before,
        )
        believed: NDArray[np.bool_] = follows | (before == UNKNOWN)
        self.refused += int((is_news & ~believed).sum())
        return believed

    def _note_change(self, members: Rounds, rounds: Rounds, smas_m: Floats) -> None:
        """Add how far members that were known before have moved up, and in how many rounds."""
        before = self._rounds[members]
        was_known = before > UNKNOWN
        self._change_m += float((smas_m - self._sma_m[members])[was_known].sum())
        self._changed_rounds += int((rounds - before)[was_known].sum())

    def _is_known(self, now: int) -> NDArray[np.bool_]:
        return (self._rounds > UNKNOWN) & (now - self._rounds <= self._rounds_max)

    def _of(self, rounds: dict[str, Rounds], name: str) -> Rounds:
        if name not in rounds:
            rounds[name] = np.full(len(self._rounds), UNKNOWN, dtype=np.int64)
        return rounds[name]


class _Side:
    """
    Those on one side, nearest first.

    Args:
        names: The candidates.
        now: The round of the start; the nearest one has the benefit of the doubt.
        patience: Rounds without a word, after which one is silent.
    """

    def __init__(self, names: Sequence[str], now: int, patience: int) -> None:
        self._names = tuple(names[:CANDIDATES_MAX])
        self._start = now
        self._patience = patience
        self._asked = 0

    def choose(self, heard: Mapping[str, int], now: int) -> str | None:
        """Return whom to ask; None where there is nobody."""
        if not self._names:
            return None
        since = now - self._patience
        nearest = next((name for name in self._names if heard.get(name, since) > since), None)
        if nearest is not None or self._start > since:
            self._asked = 0
            return nearest or self._names[0]
        self._asked += 1
        return self._names[self._asked % len(self._names)]


class Neighbourhood:
    """
    Choice of the neighbours, and the reasons for it.

    Args:
        ahead: Those ahead, nearest first.
        behind: Those behind; in a small ring they may be the same.
        now: The round of the start.
        patience: Rounds without a word, after which one is silent.
        repairs: Whether others are asked in the place of one that is silent, and it is heard again when it speaks;
            else it is left for good.
    """

    def __init__(
        self,
        ahead: Sequence[str],
        behind: Sequence[str],
        *,
        now: int,
        patience: int = SILENT_ROUNDS,
        repairs: bool = True,
    ) -> None:
        self._patience = patience
        self._left: set[str] | None = None if repairs else set()
        if not repairs:
            ahead, behind = ahead[:1], behind[:1]
        self._nearest = frozenset((*ahead[:1], *behind[:1]))
        self._start = now
        self._sides = (_Side(behind, now, patience), _Side(ahead, now, patience))
        self._heard: dict[str, int] = {}
        self._asked_by: dict[str, int] = {}

    def listens_to(self, name: str) -> bool:
        """Tell whether what somebody says counts: everybody's does, where a ring is repaired."""
        return self._left is None or (name in self._nearest and name not in self._left)

    def hear(self, name: str, asks: bool, now: int) -> None:
        """Note that somebody spoke, and whether it wants to be answered."""
        self._heard[name] = now
        if asks:
            self._asked_by[name] = now

    def choose(self, now: int) -> dict[str, bool]:
        """Return whom to speak to in this round, and whether to ask for an answer."""
        since = now - self._patience
        if self._left is not None:
            if self._start <= since:
                self._left |= {n for n in self._nearest if self._heard.get(n, since) <= since}
            return {name: True for name in sorted(self._nearest - self._left)}
        chosen = (side.choose(self._heard, now) for side in self._sides)
        asked = {name: True for name in chosen if name is not None}
        return asked | {
            name: False
            for name, last in self._asked_by.items()
            if last > since and name not in asked
        }
