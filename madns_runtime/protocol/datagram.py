"""The layout of a datagram in the pieces that a link handles: what its header says, and one frame alone behind it."""

from __future__ import annotations

from struct import Struct
from typing import Final

from madns_runtime.protocol.delivery import FRAME, FRAME_BYTES
from madns_runtime.protocol.messages import Service
from madns_runtime.protocol.seal import HEADER_BYTES, MAC_BYTES, PREFIX_BYTES

PROBE: Final = 8
"""A header's contents are the bits 1 << service of its frames, and this one: tell me what you grant."""
ELICITING: Final = 1 << Service.RELIABLE | 1 << Service.SYNC | PROBE
"""Contents that want to be acknowledged ..."""
AT_ONCE: Final = 1 << Service.SYNC | PROBE
"""... and these without delay."""
BEST_ALONE: Final = 1 << Service.BEST

STREAMS: Final = Struct("<QQHH")
"""What a header says of the streams, RELIABLE then SYNC: how far they are, and what is granted."""
HEADER_REST: Final = Struct(f"<QQQ{STREAMS.size}sHBB")
"""`seal.REST` with STREAMS in one piece: from one datagram to the next it is the same, unless a stream moves."""
ALONE: Final = Struct(f"<{PREFIX_BYTES}s{HEADER_REST.format[1:]}{FRAME.format[1:]}")
"""A whole header and that of the one frame behind it."""
ALONE_AT: Final = HEADER_BYTES + FRAME_BYTES
ALONE_BYTES_MIN: Final = ALONE_AT + MAC_BYTES
