"""What the host half sends in lockstep: counted, and kept in a box for each worker until its next order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from madns_runtime.context import check_sending
from madns_runtime.lockstep.clock import SimulatedClock
from madns_runtime.lockstep.post import Allowance, encode
from madns_runtime.lockstep.recorder import LockstepRecorder
from madns_runtime.lockstep.result import RunAccount
from madns_runtime.protocol.messages import Service


class Outbox:
    """
    The host's messages on their way.

    Args:
        shares: Whom each worker runs.
        account: Where messages are counted.
        clock: Simulated time.
        recorder: Where broken deadlines are recorded.
    """

    def __init__(
        self,
        shares: Sequence[range],
        *,
        account: RunAccount,
        clock: SimulatedClock,
        recorder: LockstepRecorder,
    ) -> None:
        self.boxes: list[list[tuple[int, bytes]]] = [[] for _ in shares]
        """One a worker: whose it is, by index, and the body."""
        self._box_of = [self.boxes[number] for number, share in enumerate(shares) for _ in share]
        self._index = {name: number for number, name in enumerate(account.names)}
        self._allowances = [Allowance() for _ in account.names]
        self._account = account
        self._clock = clock
        self._recorder = recorder

    def send(
        self,
        to: str,
        message: Any,
        service: Service = Service.RELIABLE,
        *,
        deadline_s: float | None = None,
    ) -> None:
        """Send to an agent's half; see `plugin.api.Context.send`."""
        is_running = self._account.began_s is not None
        check_sending(to, self._index, service, deadline_s, is_running=is_running)
        number, t_s = self._index[to], self._clock.t_s
        body = encode(message, service)
        self._allowances[number].take(len(body), t_s)
        account = self._account.agents[number]
        if deadline_s is not None and deadline_s < t_s:  # it arrives when it is sent
            account.deadlines_broken += 1
            self._recorder.event("sync_deadline_broken", agent=to, late_s=t_s - deadline_s)
        account.down[int(service)] += 1
        self._box_of[number].append((number, body))

    def give_up(self) -> None:
        """Count what nobody is to receive any more."""
        for box in self.boxes:
            for number, _ in box:
                self._account.agents[number].too_late += 1
            box.clear()
