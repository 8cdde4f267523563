"""
COSMoS: the simulation of satellite constellations on MADNS.

This file names the parts and imports none of them, so that `cosmos validate` stays quick and an
agent's board needs neither scipy nor sgp4.
"""

from __future__ import annotations

from madns_runtime.plugin.api import Simulation
from madns_runtime.simulations.constellation.actions import ACTIONS
from madns_runtime.simulations.constellation.parameters import ConstellationParameters

_HERE = "madns_runtime.simulations.constellation"
_WORDS = ("name", "index", "satellite")
_PROGRAM_WORDS = (*_WORDS, "address", "pty")
"""Of agents, and of programs also where their transport is; `substitution` replaces them, and `check_flight` judges."""

simulation = Simulation(
    name="constellation",
    parameters=ConstellationParameters,
    host=f"{_HERE}.host:ConstellationHost",
    agent=f"{_HERE}.agent:ConstellationAgent",
    demand=f"{_HERE}.demand:estimate_demand",
    check=f"{_HERE}.check:find_faults",
    check_actions=f"{_HERE}.check_actions:find_action_faults",
    streams=f"{_HERE}.streams:declared_streams",
    labels=f"{_HERE}.check:name_satellites",
    device_uses=f"{_HERE}.check:device_uses",
    place_uses=f"{_HERE}.check:place_uses",
    rerun=f"{_HERE}.rerun:for_rerun",
    label_column="satellite",
    placeholders={
        "flight.command": _PROGRAM_WORDS,
        "flight.environment.*": _PROGRAM_WORDS,
        "flight.interface.transport.*": _WORDS,
    },
    agent_parameters=(),  # `vehicles` and `flight` are lists of rules; all else host and agents have in common
    actions=ACTIONS,
    columns=("elements.a_m", "elements.e", "elements.mean_anomaly_deg"),
    medium=f"{_HERE}.host:radio_of",
    tabulate=f"{_HERE}.tabulation:tabulate_truth",
    figures=f"{_HERE}.analysis.chapters:figures",
    document=f"{_HERE}.analysis.slots:document",
    compare=f"{_HERE}.analysis.chapters:compare",
)
