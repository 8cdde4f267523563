"""
Cars on a ring road.

The host holds the truth: where each car is. It moves cars by the acceleration that each commanded last, tells each
its own position and speed, and knows who is in reach of whose radio. What a car says to the car behind it goes through
the framework's medium, with delay, rate and loss. A car is one agent. It knows of the car ahead only what it heard, and follows by the Intelligent Driver Model
(`ring_cars.car_following`).
"""

from __future__ import annotations

from madns_runtime.plugin.api import Simulation
from ring_cars.actions import BRAKE
from ring_cars.parameters import RingParameters

simulation = Simulation(
    name="ring-cars",
    parameters=RingParameters,
    host="ring_cars.host:RingRoad",
    agent="ring_cars.agent:Car",
    streams="ring_cars.streams:declared_streams",
    labels="ring_cars.streams:name_cars",
    label_column="car",
    actions=(BRAKE,),
    columns=("drive.speed_m_s", "drive.heard_gap_m"),
    medium="ring_cars.host:v2v",
    figures="ring_cars.figures:figures",
    compare="ring_cars.figures:compare",
)
