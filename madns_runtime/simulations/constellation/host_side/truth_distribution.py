"""
Distribution of truth: every vehicle's next segment is sent when it is due, what has changed at once, and all is recorded.

The record holds every vehicle's truth, also where its agent is gone: an agent records its state as well, but
that is written by the machine under test and is lost with it.

Few segments are sent a call, so that no call takes long and no instant sees a burst of all vehicles.
"""

from __future__ import annotations

import math
from dataclasses import replace

from madns_runtime.plugin.api import HostContext
from madns_runtime.protocol.messages import Service
from madns_runtime.simulations.constellation.host_side.model_health import (
    AttitudeSpacing,
    Conservation,
)
from madns_runtime.simulations.constellation.host_side.truth_propagation import TruthSupply
from madns_runtime.simulations.constellation.messages import Segment
from madns_runtime.simulations.constellation.streams import TRUTH
from madns_runtime.simulations.constellation.truth.segment_records import record_of
from madns_runtime.simulations.constellation.truth.segments import RefillSchedule

SENDS_PER_TIMER_MAX = 4
"""Segments sent in one call: about 0.1 ms, 0.4 with their records."""
TIMER_STEP_S = 0.001
"""Until the next call when more segments are due than one call sends."""
RETRY_S = 0.02
"""Until the next look for truth that is due but not computed yet."""
URGENT_KNOTS_MAX = 20
"""Knots of a change that travel as SYNC: one datagram; the others follow as RELIABLE."""
STREAM = "truth"
SENT_S_DIGITS = 6
SEGMENTS_GIVEN_MAX = 32
"""Given at once whatever their times; of more, those that are over are left out."""
LOOK_BACK_S = 1.0
"""Truth that is kept beyond a tick's time: messages name times that are over when they are heard."""


class Refills:
    """
    Segments on their way: which truth each vehicle has, and which it gets next.

    Args:
        context: Through which segments are sent.
        supply: Where they come from.
        conservation: Told of every window that is handed out.
        spacing: Shown all segments; None where no body turns.
        is_recorded: Whether truth is recorded.
    """

    def __init__(
        self,
        context: HostContext,
        supply: TruthSupply,
        *,
        conservation: Conservation,
        spacing: AttitudeSpacing | None,
        is_recorded: bool,
    ) -> None:
        count = len(context.agents)
        self.segments_sent = 0
        self._context = context
        self._supply = supply
        self._store = supply.store
        self._conservation = conservation
        self._spacing = spacing
        self._is_recorded = is_recorded
        if is_recorded:
            context.open_stream(STREAM, TRUTH)
        self._schedule = RefillSchedule(count, self._store.window_s)
        self.windows = max(1, math.ceil(context.duration_s / self._store.window_s - 1e-9))
        """Windows of the whole run."""
        self._active = [True] * count
        self._sent_until = [0] * count
        self._recorded_until = [0] * count
        """Of each vehicle the first window that is not on record yet."""
        self._revisions_given = [0] * count
        self._cursor = 0
        supply.remainders.followed = self.followed

    def initial(self, vehicle: int) -> list[Segment]:
        """Return a vehicle's truth from now on for a whole buffer, as far as it is computed."""
        self._supply.remainders.settle(vehicle)
        now = self._window_at(self._context.now_s())
        # What its turn has passed already will not come again.
        last = max(now + 1, self._turns_passed(vehicle) - 1)
        self._sent_until[vehicle] = min(last + 1, self._store.end)
        self._revisions_given[vehicle] = self._store.revisions[vehicle]
        return self._still_wanted(self._store.segments(vehicle, now, last))

    def timer(self, t_s: float) -> float | None:
        """Send what is due, have computed what will be, and return when to come back."""
        self._drop_what_is_over(t_s)
        self.submit_if_due(t_s)
        for _ in range(SENDS_PER_TIMER_MAX):
            window, vehicle = divmod(self._cursor, len(self._active))
            if window >= self.windows:
                return None
            due_s = self._schedule.send_s(window, vehicle)
            if due_s > t_s:
                return self._next_s(due_s)
            if window >= self._store.end:
                return t_s + RETRY_S
            self._cursor += 1
            self._supply.remainders.settle(vehicle)
            self._refill(vehicle, window)
            self._conservation.record(vehicle, window)
            self._record_window(vehicle, window)
        return t_s + TIMER_STEP_S

    def submit_if_due(self, t_s: float) -> None:
        """Have the next window computed if it is time and nothing else is under way."""
        wanted = not self._supply.is_busy and 0 < self._store.end < self.windows
        if wanted and t_s >= self._schedule.wanted_s(self._store.end):
            self._supply.submit(1, self._store.last_states(), self._store.last_attitude())

    def lateness_s(self, window: int, now_s: float) -> float:
        """Return how much after its first sending was due a window is known."""
        return now_s - self._schedule.send_s(window, 0)

    def changed(self, vehicle: int, change_s: float, deadline_s: float) -> None:
        """
        Send a vehicle what it has been sent already and what has changed since.

        The first knots go as SYNC, before anything else; they must be there by *deadline_s*. What is not
        propagated yet goes when it is (`followed`).
        """
        until_s = self._supply.remainders.known_until_s(vehicle)
        until = self._recorded_until[vehicle]
        self._record(vehicle, self._store.segments_from(vehicle, change_s, until, until_s))
        if not self._active[vehicle]:
            return
        until = self._sent_until[vehicle]
        segments = self._store.segments_from(vehicle, change_s, until, until_s)
        left = URGENT_KNOTS_MAX
        agent = self._context.agents[vehicle]
        for whole in segments:
            urgent, later = _cut(whole, left)
            if urgent is not None:
                left -= len(urgent.states)
                self._context.send(agent, urgent.to_message(), Service.SYNC, deadline_s=deadline_s)
            if later is not None:
                left = 0
                self._context.send(agent, later.to_message(), Service.RELIABLE)
            self.segments_sent += (urgent is not None) + (later is not None)

    def judge_anew(self, vehicle: int) -> None:
        """Compare a vehicle's truth with no time that was handed out before: it may have burnt since."""
        self._conservation.forget(vehicle)

    def followed(self, vehicle: int, from_s: float) -> None:
        """Send the rest of a change, and record it."""
        until = self._recorded_until[vehicle]
        self._record(vehicle, self._store.segments_from(vehicle, from_s, until))
        if not self._active[vehicle]:
            return
        segments = self._store.segments_from(vehicle, from_s, self._sent_until[vehicle])
        for segment in segments:
            message = segment.to_message()
            self._context.send(self._context.agents[vehicle], message, Service.RELIABLE)
        self.segments_sent += len(segments)

    def lost(self, vehicle: int) -> None:
        """Send a vehicle no more."""
        self._active[vehicle] = False

    def rejoined(self, vehicle: int) -> None:
        """Send a vehicle again, and at once what became due while it set itself up."""
        self._supply.remainders.settle(vehicle)
        self._active[vehicle] = True
        if self._store.revisions[vehicle] != self._revisions_given[vehicle]:
            # A maneuver came in between: what it was given to begin with holds no more.
            self._sent_until[vehicle] = self._window_at(self._context.now_s())
        self._refill(vehicle, self._turns_passed(vehicle) - 1)

    def _drop_what_is_over(self, t_s: float) -> None:
        """Forget truth that nobody will ask for any more, and whose turn to be recorded is over."""
        window = self._window_at(t_s - LOOK_BACK_S - 1.0 / self._context.tick_hz)
        self._store.drop_before(min(window, self._cursor // len(self._active)))

    def _window_at(self, t_s: float) -> int:
        return min(max(0, math.floor(t_s / self._store.window_s)), self.windows - 1)

    def _turns_passed(self, vehicle: int) -> int:
        """Return the number of windows whose turn to be sent to this vehicle is over."""
        window, at = divmod(self._cursor, len(self._active))
        return window + (vehicle < at)

    def _next_s(self, due_s: float) -> float:
        """Return when to come back: the next sending, or the next submission if that is sooner."""
        if not self._supply.is_busy and self._store.end < self.windows:
            return min(due_s, self._schedule.wanted_s(self._store.end))
        return due_s

    def _refill(self, vehicle: int, window: int) -> None:
        """Send a vehicle what it lacks up to and including *window*."""
        first = self._sent_until[vehicle]
        if not self._active[vehicle] or first > window:
            return
        segments = self._still_wanted(self._store.segments(vehicle, first, window))
        if not segments:
            return
        self._sent_until[vehicle] = min(window + 1, self._store.end)
        agent = self._context.agents[vehicle]
        for segment in segments:
            self._context.send(agent, segment.to_message(), Service.RELIABLE)
        self.segments_sent += len(segments)

    def _still_wanted(self, segments: list[Segment]) -> list[Segment]:
        """Return segments without those that are over, if a vehicle that is commanded often has left many."""
        if len(segments) <= SEGMENTS_GIVEN_MAX:
            return segments
        over_s = self._context.now_s() - LOOK_BACK_S
        return [segment for segment in segments if segment.end_s >= over_s]

    def _record_window(self, vehicle: int, window: int) -> None:
        """Record a vehicle's truth up to and including a window, as it is now."""
        first = self._recorded_until[vehicle]
        if window < first:
            return
        self._recorded_until[vehicle] = window + 1
        self._record(vehicle, self._store.segments(vehicle, first, window))

    def _record(self, vehicle: int, segments: list[Segment]) -> None:
        if self._spacing is not None:
            self._spacing.look(vehicle, segments)
        if not self._is_recorded:
            return
        agent = self._context.agents[vehicle]
        sent_s = round(self._context.now_s(), SENT_S_DIGITS)
        for segment in segments:
            self._context.record(STREAM, record_of(segment, agent, sent_s))


def _cut(segment: Segment, knots: int) -> tuple[Segment | None, Segment | None]:
    """Return a segment's first *knots* and the rest, which share a knot; None for a part that is empty."""
    count = len(segment.states)
    if count <= knots:
        return segment, None
    if knots < 2:
        return None, segment
    urgent, later = (
        replace(
            segment,
            t0_s=segment.t0_s + rows.start * segment.knot_s,
            states=segment.states[rows],
            attitude=None if segment.attitude is None else segment.attitude[rows],
        )
        for rows in (slice(0, knots), slice(knots - 1, count))
    )
    return urgent, later
