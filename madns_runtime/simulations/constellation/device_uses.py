"""
Channels of devices that vehicles use: their sensors, stimuli, actuation, and the way to their flight software.

As in `check`, for which it answers: nothing of it is run.
"""

from __future__ import annotations

from collections.abc import Iterator

from madns_runtime.plugin.api import DeviceUse
from madns_runtime.simulations.constellation.actuation import VECTOR_SIZE
from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.flight_settings import FlightClass, FlightRule
from madns_runtime.simulations.constellation.interface_settings import DeviceTransport
from madns_runtime.simulations.constellation.parameters import ConstellationParameters
from madns_runtime.simulations.constellation.sensor_channels import (
    channels_of,
    sensors_from_devices,
)
from madns_runtime.simulations.constellation.stimulus import SOURCES
from madns_runtime.simulations.constellation.substitution import substitute
from madns_runtime.simulations.constellation.vehicles import flight_of, flight_rules, vehicle_of


def uses_devices(parameters: ConstellationParameters) -> bool:
    """Tell whether any vehicle may use a channel: most scenarios have none, and need not choose their satellites."""
    return any(map(_transport_of, flight_rules(parameters))) or any(
        vehicle.stimuli or vehicle.actuation or any(True for _ in sensors_from_devices(vehicle))
        for vehicle in parameters.vehicles
    )


def uses_of(
    parameters: ConstellationParameters, agent: str, index: int, satellite: str
) -> Iterator[DeviceUse]:
    """
    Yield the channels that one vehicle uses.

    Args:
        parameters: Of the scenario.
        agent: Its name.
        index: Its place among the agents, from 0.
        satellite: Its satellite's name.
    """
    vehicle = vehicle_of(parameters, agent, satellite)
    place = next((n for n, each in enumerate(parameters.vehicles) if each is vehicle), 0)
    field = f"parameters.vehicles[{place}]"
    yield from _sensor_uses(agent, field, vehicle)
    yield from _stimulus_uses(agent, field, vehicle)
    yield from _actuation_uses(agent, field, vehicle)
    rule = flight_of(parameters, agent, satellite)
    if rule is not None:
        values = {"name": agent, "index": str(index), "satellite": satellite}
        yield from _flight_uses(agent, _flight_field(parameters, rule), rule, values)


def _sensor_uses(agent: str, field: str, vehicle: Vehicle) -> Iterator[DeviceUse]:
    for sensor, settings in sensors_from_devices(vehicle):
        for channel in channels_of(sensor, settings):
            yield DeviceUse(
                agent=agent,
                field=f"{field}.sensors.{sensor}.{channel.key}",
                device=channel.device,
                channel=channel.name,
                size=channel.size,
                unit=channel.unit,
            )


def _stimulus_uses(agent: str, field: str, vehicle: Vehicle) -> Iterator[DeviceUse]:
    for number, stimulus in enumerate(vehicle.stimuli):
        yield DeviceUse(
            agent=agent,
            field=f"{field}.stimuli[{number}].channel",
            device=stimulus.device,
            channel=stimulus.output,
            direction="out",
            size=SOURCES[stimulus.source].size,
        )


def _actuation_uses(agent: str, field: str, vehicle: Vehicle) -> Iterator[DeviceUse]:
    for number, actuation in enumerate(vehicle.actuation):
        device, _, channel = actuation.channel.rpartition(".")
        yield DeviceUse(
            agent=agent,
            field=f"{field}.actuation[{number}].channel",
            device=device,
            channel=channel,
            size=VECTOR_SIZE if actuation.vector is None else 1,
        )


def _flight_uses(
    agent: str, field: str, rule: FlightRule, values: dict[str, str]
) -> Iterator[DeviceUse]:
    transport = _transport_of(rule)
    if transport is None:
        return
    device = substitute(transport.device, values)
    where = f"{field}.interface.transport.device"
    yield DeviceUse(agent=agent, field=where, device=device, channel="received")
    yield DeviceUse(agent=agent, field=where, device=device, channel="sent", direction="out")


def _transport_of(rule: FlightRule) -> DeviceTransport | None:
    """Return the device by which flight software is reached; None for another way."""
    interface = None if isinstance(rule, FlightClass) else rule.interface
    transport = None if interface is None else interface.transport
    return transport if isinstance(transport, DeviceTransport) else None


def _flight_field(parameters: ConstellationParameters, rule: FlightRule) -> str:
    if not isinstance(parameters.flight, tuple):
        return "parameters.flight"
    return f"parameters.flight[{flight_rules(parameters).index(rule)}]"
