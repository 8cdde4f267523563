"""
What a stimulus costs an agent's tick: truth computed ahead, turned, and handed over to the device's process.

    python benchmarks/stimulus.py [--seconds 120]

Whole ticks are timed by the tick rate and the stimulus's rate, so that the messages, which carry a quarter of the lead
each, weigh in by their share. The other end of the socket is emptied outside of the time.
"""

from __future__ import annotations

import argparse
import time
from types import SimpleNamespace

import numpy as np

from madns_runtime.hardware import messages
from madns_runtime.hardware.contract import Channel
from madns_runtime.hardware.page import DevicePage
from madns_runtime.hardware.port import DevicePort
from madns_runtime.hardware.status import StatusLimits
from madns_runtime.simulations.constellation.messages import Initial, Segment
from madns_runtime.simulations.constellation.stimulus import SOURCES, Stimulus
from madns_runtime.simulations.constellation.vehicle.stimuli import Stimuli

EPOCH = "2026-03-20T12:00:00Z"
BUFFER_S = 20


def segment(t0_s: float) -> Segment:
    """Return truth of some seconds; what it is does not matter to the time that it takes."""
    times = t0_s + np.arange(BUFFER_S + 1)
    states = np.tile(np.array((7.158e6, 0.0, 0.0, 0.0, 1000.0, 7390.0)), (len(times), 1))
    angle = 0.005 * times
    turned = np.zeros((len(times), 7))
    turned[:, 2], turned[:, 3], turned[:, 6] = np.sin(angle), np.cos(angle), 0.01
    return Segment(revision=0, t0_s=t0_s, knot_s=1.0, states=states, attitude=turned)


def us_per_tick(source: str, tick_hz: float, rate_hz: float, seconds: float) -> tuple[float, float]:
    """Return mean and largest time of a tick, us."""
    stimulus = Stimulus(source=source, channel="coil.out", rate_hz=rate_hz, scale=2.0)
    channel = Channel(name="out", direction="out", shape=(SOURCES[stimulus.source].size,))
    agent_end, device_end = messages.make_pair()
    limits = StatusLimits.of(0.1, 15.0)
    port = DevicePort("coil", (channel,), shared=(DevicePage([]), agent_end), limits=limits)
    context = SimpleNamespace(
        hardware={"coil": port}, parameters=SimpleNamespace(gravity="EGM-96"), duration_s=seconds
    )
    first = Initial(satellite="S1", frame="TEME", epoch_utc=EPOCH, segment=segment(0.0))
    stimuli = Stimuli((stimulus,), context, first)  # type: ignore[arg-type]
    spent_ns, most_ns, known_s = 0, 0, float(BUFFER_S)
    for tick in range(round(seconds * tick_hz)):
        t_s = tick / tick_hz
        if t_s > known_s - BUFFER_S / 2:
            stimuli.take(segment(known_s), t_s)
            known_s += BUFFER_S
        began_ns = time.perf_counter_ns()
        stimuli.step(t_s)
        took_ns = time.perf_counter_ns() - began_ns
        spent_ns, most_ns = spent_ns + took_ns, max(most_ns, took_ns)
        for _ in messages.receive_all(device_end):
            pass
    return spent_ns / round(seconds * tick_hz) / 1e3, most_ns / 1e3


def main() -> None:
    """Print a line per source and pair of rates."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=120.0, help="simulated, of each line")
    seconds = parser.parse_args().seconds
    print(f"{'source':20} {'tick Hz':>8} {'rate Hz':>8} {'us per tick':>10} {'most us':>9}")
    for source in SOURCES:
        for tick_hz, rate_hz in ((10.0, 10.0), (100.0, 100.0), (10.0, 100.0)):
            mean_us, most_us = us_per_tick(source, tick_hz, rate_hz, seconds)
            print(f"{source:20} {tick_hz:8g} {rate_hz:8g} {mean_us:10.1f} {most_us:9.0f}")


if __name__ == "__main__":
    main()
