"""What may be sent in lockstep: what may be sent between machines, with the same bounds and the same refusals. Pure."""

from __future__ import annotations

from typing import Any, Final

from madns_runtime.errors import MessageTooLarge
from madns_runtime.protocol.best import BEST_BYTES_MAX
from madns_runtime.protocol.codec import NO_DATA, decode_data, decode_message, encode_data
from madns_runtime.protocol.limits import LinkLimits, SendQueueFull
from madns_runtime.protocol.messages import Service, SimulationData
from madns_runtime.protocol.sending import MESSAGES_QUEUED_MAX

BEST: Final = Service.BEST
QUEUE_BYTES_MAX: Final = LinkLimits().send_queue_bytes_max
SERVICES: Final = ("best", "reliable", "sync")
"""By the number of the class of service."""


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
    Return what was sent.

    Raises:
        MalformedMessage: It is no message.
    """
    payload = decode_data(body)
    if payload is not NO_DATA:
        return payload
    message = decode_message(body)
    assert isinstance(message, SimulationData), "only plug-ins' messages travel here"
    return message.payload


class Allowance:
    """How much one sender may have under way to one receiver before simulated time goes on."""

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
        if size > QUEUE_BYTES_MAX:
            raise MessageTooLarge(
                f"expected a message of at most {QUEUE_BYTES_MAX} bytes, got {size}; send it in parts"
            )
        if self._bytes > QUEUE_BYTES_MAX or self._count > MESSAGES_QUEUED_MAX:
            raise SendQueueFull(
                f"{self._count} messages of {self._bytes} bytes were sent at t = {t_s:g} s (at most"
                f" {MESSAGES_QUEUED_MAX} messages and {QUEUE_BYTES_MAX} bytes may); send less"
            )
