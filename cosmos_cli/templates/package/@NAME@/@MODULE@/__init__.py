"""Rovers drive to their marks. This file names the parts and imports neither half: `cosmos validate` stays quick."""

from __future__ import annotations

from madns_runtime.plugin.api import Simulation

from @MODULE@.parameters import RoverParameters

simulation = Simulation(
    name="@NAME@",
    parameters=RoverParameters,
    host="@MODULE@.host:RoverHost",
    agent="@MODULE@.agent:RoverAgent",
    demand="@MODULE@.demand:demand",
    streams="@MODULE@.streams:declared_streams",
    figures="@MODULE@.figures:figures",
)
