"""Demands of the counting benchmark on host and network."""

from __future__ import annotations

from pathlib import Path

from madns_runtime.plugin.api import Demand, Flow
from madns_runtime.protocol.codec import encode_message
from madns_runtime.protocol.messages import SimulationData
from madns_runtime.simulations.counter.parameters import SAMPLE_BYTES, CounterParameters


def demand(
    parameters: CounterParameters, agents: int, tick_hz: float, base_directory: Path
) -> Demand:
    """
    Return the terms of inequalities 2.7-2.10: every tick is a synchronous exchange without work.

    Its packets are the planned flows, so no further synchronous rate is added to the bandwidth.
    """
    packet = [2**31, 2**32, bytes(parameters.payload_bytes)]
    size_bytes = len(encode_message(SimulationData(packet)))
    flows = [
        Flow(name="count up", message_bytes=size_bytes, rate_hz=tick_hz),
        Flow(name="count back", message_bytes=size_bytes, rate_hz=tick_hz),
    ]
    if parameters.send_device:
        flows.append(Flow(name="device samples", message_bytes=SAMPLE_BYTES, rate_hz=tick_hz))
    return Demand(
        flows=tuple(flows),
        buffer_s=float("inf"),
        batch_bytes=0,
        batch_compute_s=0.0,
        sync_bytes=size_bytes,
        sync_compute_s=0.0,
        sync_rate_hz=0.0,
        lead_s=1.0 / tick_hz,
        measured=False,
    )
