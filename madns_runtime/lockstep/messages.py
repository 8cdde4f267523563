"""
Messages in lockstep: their bounds, those of messages between machines with the same refusals, and the host's outbox.

Pure.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from madns_runtime.errors import MessageTooLarge
from madns_runtime.faults.message_faults import MessageFaults
from madns_runtime.lockstep.clock import SimulatedClock
from madns_runtime.lockstep.result import RunAccount
from madns_runtime.plugin.context import check_sending
from madns_runtime.protocol.codec import (
    NO_DATA,
    decode_data,
    decode_message,
    encode_data,
    encode_message,
)
from madns_runtime.protocol.datagram import BEST_BYTES_MAX, MESSAGE_BYTES_MAX
from madns_runtime.protocol.link_settings import LinkLimits, SendQueueFull
from madns_runtime.protocol.messages import (
    ActionOrder,
    Delivery,
    Service,
    SimulationData,
    TransmissionRefusal,
)
from madns_runtime.protocol.sending import MESSAGES_QUEUED_MAX
from madns_runtime.recording.run_journal import RunJournal

BEST: Final = Service.BEST
QUEUE_BYTES_MAX: Final = LinkLimits().send_queue_bytes_max
LARGEST_BYTES: Final = min(QUEUE_BYTES_MAX, MESSAGE_BYTES_MAX)
"""Bytes of one message, as between machines."""


def encode(message: Any, service: Service) -> bytes:
    """
    Return what travels.

    Raises:
        UnencodableValue: A message cannot carry it.
        MessageTooLarge: It does not fit its class of service.
    """
    body = encode_data(message)
    if service is BEST and len(body) > BEST_BYTES_MAX:
        raise MessageTooLarge(
            f"a BEST message must fit one datagram: expected at most {BEST_BYTES_MAX} bytes, "
            f"got {len(body)}; send it RELIABLE or make it smaller"
        )
    return body


def decode(body: bytes) -> Any:
    """
    Return what was sent: a half's message, or one of the three kinds that messages between agents travel in.

    Raises:
        MalformedMessage: It is no message.
    """
    payload = decode_data(body)
    if payload is not NO_DATA:
        return payload
    message = decode_message(body)
    return message.payload if isinstance(message, SimulationData) else message


class Allowance:
    """Bytes that one sender may have under way to one receiver before simulated time goes on."""

    __slots__ = ("_bytes", "_count", "_t_s")

    def __init__(self) -> None:
        self._t_s = -float("inf")
        self._bytes = 0
        self._count = 0

    def take(self, size: int, t_s: float) -> None:
        """
        Count a message of *size* bytes, sent at simulated time *t_s*.

        Raises:
            MessageTooLarge: It alone is too much.
            SendQueueFull: All that was sent since simulated time stands there is.
        """
        if t_s != self._t_s:
            self._t_s, self._bytes, self._count = t_s, 0, 0
        self._bytes += size
        self._count += 1
        if size > LARGEST_BYTES:
            raise MessageTooLarge(
                f"expected a message of at most {LARGEST_BYTES} bytes, got {size}; send it in parts"
            )
        if self._bytes > QUEUE_BYTES_MAX or self._count > MESSAGES_QUEUED_MAX:
            raise SendQueueFull(
                f"{self._count} messages of {self._bytes} bytes were sent at t = {t_s:g} s (at most"
                f" {MESSAGES_QUEUED_MAX} messages and {QUEUE_BYTES_MAX} bytes may); send less"
            )


class Outbox:
    """
    The host's messages on their way.

    Args:
        shares: Whom each worker runs.
        account: Where messages are counted.
        clock: Simulated time.
        journal: Where broken deadlines are recorded.
    """

    def __init__(
        self,
        shares: Sequence[range],
        *,
        account: RunAccount,
        clock: SimulatedClock,
        journal: RunJournal,
    ) -> None:
        self.boxes: list[list[tuple[int, bytes]]] = [[] for _ in shares]
        """One per worker: the receiver, by index, and the body."""
        self._box_of = [self.boxes[number] for number, share in enumerate(shares) for _ in share]
        self.faults: MessageFaults | None = None
        """Sees what the host's half sends, while faults are in force."""
        self._index = {name: number for number, name in enumerate(account.names)}
        self._allowances = [Allowance() for _ in account.names]
        self._account = account
        self._clock = clock
        self._journal = journal

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
        if self.faults is not None and self.faults.send(to, message, service, deadline_s):
            return
        number, t_s = self._index[to], self._clock.t_s
        if self._account.agents[number].is_lost:
            self._account.agents[number].not_sent += 1
            return
        body = encode(message, service)
        self._allowances[number].take(len(body), t_s)
        account = self._account.agents[number]
        if deadline_s is not None and deadline_s < t_s:  # it arrives when it is sent
            account.deadlines_broken += 1
            self._journal.event("sync_deadline_broken", agent=to, late_s=t_s - deadline_s)
        account.down[int(service)] += 1
        self._box_of[number].append((number, body))

    def post(self, to: str, message: Delivery | TransmissionRefusal | ActionOrder) -> bool:
        """Send an agent what came of messages between agents, or an order of the timeline."""
        number, body = self._index[to], encode_message(message)
        if self._account.agents[number].is_lost:
            return False
        self._allowances[number].take(len(body), self._clock.t_s)
        self._account.agents[number].down[int(Service.RELIABLE)] += 1
        self._box_of[number].append((number, body))
        return True

    def lose(self, number: int) -> None:
        """Count what waits for an agent that is lost, and forget it."""
        box = self._box_of[number]
        kept = [entry for entry in box if entry[0] != number]
        self._account.agents[number].too_late += len(box) - len(kept)
        box[:] = kept

    def move(self, number: int, worker: int) -> None:
        """Give what is sent to an agent from now on to another worker."""
        self._box_of[number] = self.boxes[worker]

    def give_up(self) -> None:
        """Count what nobody is to receive any more."""
        for box in self.boxes:
            for number, _ in box:
                self._account.agents[number].too_late += 1
            box.clear()
