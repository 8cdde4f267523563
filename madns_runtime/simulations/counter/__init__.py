"""The counting benchmark (thesis, section 6.1): how long a packet takes to the host and back."""

from __future__ import annotations

from madns_runtime.plugin.api import Simulation
from madns_runtime.simulations.counter.parameters import CounterParameters

simulation = Simulation(
    name="counter",
    parameters=CounterParameters,
    host="madns_runtime.simulations.counter.host:CounterHost",
    agent="madns_runtime.simulations.counter.agent:CounterAgent",
    demand="madns_runtime.simulations.counter.demand:demand",
    streams="madns_runtime.simulations.counter.parameters:declared_streams",
    agent_parameters=("service", "payload_bytes", "read_on_tick"),
    columns=("round_trips.round_trip_us",),
    figures="madns_runtime.simulations.counter.analysis:figures",
    rerun="madns_runtime.simulations.counter.rerun:for_rerun",
    document="madns_runtime.simulations.counter.analysis:document",
)
