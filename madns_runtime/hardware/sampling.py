"""
Drives devices for a while without a run, and tells what they gave: `python -m madns_runtime.hardware.sampling`.

The first line of standard input says what to do (`SamplingOrder`), one line of standard output what came of it.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from time import monotonic
from typing import Annotated, Any, Final

from annotated_types import Gt, Le

from madns_runtime.config import AgentLaunch, Agents, DeviceLaunch, RunConfig
from madns_runtime.declared_bounds import bound_faults
from madns_runtime.errors import ConfigurationError, MadnsError, PluginError
from madns_runtime.hardware.contract import Channel
from madns_runtime.hardware.manager import DeviceManager
from madns_runtime.hardware.port import Hardware
from madns_runtime.hardware.values import from_numbers
from madns_runtime.plain_values import from_mapping
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.recording.reader import read_stream
from madns_runtime.recording.stream_file import files_of

USER: Final = "cosmos-devices"
"""Stands for the agent that uses the devices."""
WRITE_PERIOD_S: Final = 0.5
EVENTS_SHOWN_MAX: Final = 100
ORDER_BYTES_MAX: Final = 4 * 1024 * 1024


@dataclass(frozen=True, slots=True, kw_only=True)
class SamplingOrder:
    """A device to drive, how long, and where it is recorded."""

    devices: tuple[DeviceLaunch, ...]
    seconds: Annotated[float, Gt(0), Le(3600)]
    directory: str
    """Records go to devices/<place>/<name> below it."""
    writes: bool = False
    """Whether the safe value of each output that may move is put out, twice per second."""
    ends_with_input: bool = False
    """Whether the end of standard input ends it before its time: who gave the order is gone."""
    lifeline: int | None = None
    """Descriptor whose end does the same, where standard input is closed behind the order."""


def main() -> None:
    """Do what standard input says."""
    answer_fd = os.dup(1)
    os.dup2(2, 1)  # what a driver prints must not mix with the answer
    told: Mapping[str, Any]
    try:
        line = sys.stdin.buffer.readline(ORDER_BYTES_MAX)
        told = {"devices": sample(order_of(json.loads(line)))}
    except MadnsError as error:
        told = {"error": str(error)}
    with open(answer_fd, "w", encoding="utf-8") as file:
        json.dump(told, file)
        file.write("\n")


def order_of(given: Any) -> SamplingOrder:
    """
    Return an order.

    Raises:
        ConfigurationError: It is none, or beyond its bounds.
    """
    order = from_mapping(SamplingOrder, given)
    if beyond := bound_faults(order, SamplingOrder.__name__):
        raise ConfigurationError("; ".join(beyond))
    return order


def sample(order: SamplingOrder) -> dict[str, Any]:
    """
    Drive devices, and return what they gave, by full name.

    Raises:
        MadnsError: A kind cannot be found, or no process can be started.
    """
    launch = AgentLaunch(
        config=RunConfig(
            run="devices",
            scenario="devices",
            simulation="",
            base_directory=order.directory,
            agents=Agents(count=1),
        ),
        run_key_hex="0" * 64,
        session_hex="0" * 16,
        machine="",
        agents=(USER,),
        host_address="",
        host_port=0,
        directory=order.directory,
        devices=order.devices,
    )
    manager = DeviceManager(launch, tell=lambda doing: None)
    manager.start()
    reactor = Reactor()
    events: list[Mapping[str, Any]] = []
    manager.watch(reactor, events.append)
    reactor.on_signal(signal.SIGCHLD, manager.reap)
    manager.reap()  # who has ended before that was listened to
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        reactor.on_signal(number, reactor.stop)
    hardware = manager.hardware_of(USER)
    hardware.tell_time(monotonic(), 0.0, 1.0)
    reactor.call_at(monotonic() + order.seconds, reactor.stop)
    if order.ends_with_input:
        reactor.add_reader(0, reactor.stop)  # nothing but its end comes after the order
    if order.lifeline is not None:
        reactor.add_reader(order.lifeline, reactor.stop)
    if order.writes:
        _write_again(reactor, hardware, order.devices)
    try:
        reactor.run()
    finally:
        results = manager.close()
        reactor.close()
    return {
        device.full_name: {
            **results[device.full_name],
            **figures_of(Path(order.directory, "devices", device.place, device.name)),
            "told": [each for each in events if each.get("device") == device.full_name][
                -EVENTS_SHOWN_MAX:
            ],
        }
        for device in order.devices
    }


def _write_again(reactor: Reactor, hardware: Hardware, devices: tuple[DeviceLaunch, ...]) -> None:
    """Put out the safe value of each output that has one and may move, now and after each period."""
    for device in devices:
        port = hardware[device.name]
        for channel in port.channels.values():
            value = _safe_value(channel)
            if device.may_move and value is not None:
                port.write(channel.name, value)
    reactor.call_at(monotonic() + WRITE_PERIOD_S, lambda: _write_again(reactor, hardware, devices))


def _safe_value(channel: Channel) -> Any:
    if channel.direction == "in" or channel.is_frame or channel.safe is None:
        return None
    if isinstance(channel.safe, tuple):
        return from_numbers(channel, channel.safe)
    return from_numbers(channel, (channel.safe,) * channel.size)


def figures_of(folder: Path) -> dict[str, Any]:
    """Return what a device's records say: its identity, what befell it, and figures of each input."""
    identity, why = "", ""
    channels: dict[str, Any] = {}
    for name in sorted({path.name.partition(".")[0] for path in folder.glob("*.jsonl")}):
        # A process that was started anew has begun files of its own.
        streams = [read_stream(path) for path in files_of(folder, name)]
        records = (record for stream in streams for record in stream.records())
        fields = next((stream.field_names for stream in streams if stream.field_names), ())
        if name == "events":
            for event in records:
                values = event if isinstance(event, dict) else {}
                identity = str(values.get("identity") or identity)
                why = str(values.get("why") or why) if values.get("event") == "error" else why
        elif fields[:3] == ("t_s", "number", "age_us"):
            channels[name] = _input_figures([record[:3] for record in records])
        elif fields[:2] == ("t_s", "lateness_us"):
            lateness = sorted(record[1] for record in records)
            channels[name] = {"written": len(lateness), "lateness_us": _share(lateness, 0.99)}
    return {"identity": identity, "error": why, "channels": channels}


def _input_figures(records: list[Any]) -> dict[str, Any]:
    """Return the figures of one input: of [t_s, number, age_us] per sample, but for one from before the beginning."""
    records = [record for record in records if record[0] >= 0.0]
    times = [record[0] for record in records]
    gaps = sorted(later - earlier for earlier, later in pairwise(times))
    ages = sorted(record[2] for record in records)
    span_s = times[-1] - times[0] if times else 0.0
    period_s = span_s / len(gaps) if gaps else 0.0
    offsets = sorted(abs(gap - period_s) for gap in gaps)
    return {
        "samples": len(records),
        "rate_hz": len(gaps) / span_s if span_s > 0 else None,
        "jitter_us": _share([offset * 1e6 for offset in offsets], 0.99),
        "age_us": _share(ages, 0.5),
        "age_us_max": ages[-1] if ages else None,
    }


def _share(ordered: list[Any], share: float) -> Any:
    """Return the value that *share* of the ordered values do not exceed; None of none."""
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else None


if __name__ == "__main__":
    try:
        main()
    except PluginError as error:
        sys.exit(str(error))
