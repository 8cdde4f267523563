"""Predicted capacity, by values."""

import dataclasses
import math

import pytest

from cosmos_cli.launch.capacity import ComputerFacts, TickCosts, kernel_bytes, predict_capacity
from cosmos_cli.launch.feasibility import Resources
from cosmos_cli.models.planning import NOTHING
from cosmos_cli.models.scenario import Scenario
from madns_runtime.plugin.api import Flow

HERE = ComputerFacts(name="here", processors=2, is_host=True)
NETWORK = Resources(workers=1, bandwidth_bytes_s=1e9, latency_s=0.0)
COSTS = TickCosts(tick_s=100e-6, wake_up_s=100e-6, exchange_s=50e-6)


def predicted(computers=(HERE,), *, hz=100, per_process=1, buffer=None, demand=NOTHING, **changes):
    agents = {"count": max(1, per_process), "tick_hz": hz, "per_process": per_process}
    scenario = Scenario(name="x", simulation="counter", agents=agents)
    resources = dataclasses.replace(NETWORK, **changes)
    return predict_capacity(
        scenario, demand, computers, resources, receive_buffer_bytes=buffer, costs=COSTS
    )  # fmt: skip


def limit(capacity, name):
    return next(each.agents for each in capacity.limits if each.name == name)


def test_one_computer_bears_host_and_agents():
    # 1.6 s per second; an agent's ticks take 100 x (100 + 100) us, its host 100 x 50 us.
    assert limit(predicted(), "processors of here") == 1.6 // (0.02 + 0.005)
    assert limit(predicted(), "host's loop") == 160
    assert predicted().binding.name == "processors of here"


def test_packs_share_a_wake_up():
    assert limit(predicted(per_process=8), "processors of here") == 1.6 // (0.01125 + 0.005)


def test_a_process_is_one_thread():
    # 0.8 s: 100 x (n x 100 us + a pack of 8's 100 us).
    assert limit(predicted(per_process=71), "process of agents") == math.inf
    assert limit(predicted(per_process=72), "process of agents") == 71


def test_agents_are_spread_over_machines_and_the_slowest_counts():
    boards = [ComputerFacts(name=f"pi{n}", processors=4, speed=0.5) for n in range(3)]
    host = ComputerFacts(name="here", processors=2, is_host=True, has_agents=False)

    found = predicted([host, *boards])

    assert limit(found, "processors of pi1") == 3 * (1.6 // 0.02)
    assert limit(found, "processors of here") == 1.6 // 0.005
    assert limit(found, "host's loop") == found.agents == 160


def test_the_limits_of_the_inequalities_are_the_agents_that_still_fit():
    asked = dataclasses.replace(
        NOTHING, flows=(Flow(name="x", message_bytes=100, rate_hz=100),), lead_s=3.0,
        sync_bytes=100, sync_compute_s=0.04, sync_rate_hz=1.0, buffer_s=10.0, batch_bytes=100, batch_compute_s=0.04,
    )  # fmt: skip

    found = predicted(demand=asked, latency_s=0.001)

    assert (limit(found, "inequality 2.7"), limit(found, "inequality 2.8")) == (249, 74)
    assert limit(found, "inequality 2.9") == math.inf


def test_workers_have_batches_and_every_maneuver_to_compute():
    asked = dataclasses.replace(
        NOTHING, batch_compute_s=0.04, buffer_s=10.0, sync_compute_s=0.04, sync_rate_hz=1.0, lead_s=3.0
    )  # fmt: skip
    idle = dataclasses.replace(asked, sync_rate_hz=0.0)

    assert limit(predicted(demand=asked), "host's workers") == 22  # 0.044 of a worker each
    assert limit(predicted(demand=asked, workers=2), "host's workers") == 45
    assert limit(predicted(demand=idle), "host's workers") == 250
    assert limit(predicted(), "host's workers") == math.inf
    # The host's computer has ticks of 100 Hz besides: 25 ms of 1.6 s each.
    assert limit(predicted(demand=asked), "processors of here") == 1.6 // (0.025 + 0.044)


def test_maneuvers_of_one_instant_have_what_ticks_leave_of_the_hosts_processors():
    asked = dataclasses.replace(NOTHING, sync_bytes=100, sync_compute_s=0.01, lead_s=10.0)
    name = "maneuvers of one instant"

    # 25 ms per second are an agent's ticks: n x 10 ms within 10 s x (2 - n x 25 ms).
    assert limit(predicted(demand=asked, workers=2), name) == 20.0 // 0.26
    # One worker computes on one processor, as long as ticks leave it one: up to 40 agents.
    assert limit(predicted(demand=asked, hz=1), name) == 1000
    assert limit(predicted(demand=asked, workers=2, maneuvers_at_once=10), name) == 79
    assert limit(predicted(), name) == math.inf
    assert [each.why for each in predicted().limits if each.name == name] == ["none is commanded"]


def test_a_burst_must_fit_the_granted_buffer():
    # Linux' default of 208 KiB holds 277 small datagrams and 92 of 1400 bytes.
    assert limit(predicted(buffer=212_992), "receive buffer of the host") == 277
    assert (kernel_bytes(64), kernel_bytes(1400), 212_992 // kernel_bytes(1400)) == (768, 2304, 92)


def test_a_computer_without_host_or_agents_is_refused():
    for computers in ([], [dataclasses.replace(HERE, is_host=False)], [HERE, HERE]):
        with pytest.raises(ValueError, match="one of them or another as the host"):
            predicted(computers)


def test_values_become_plain():
    told = predicted(hz=10).to_mapping()

    assert told["agents"] == limit(predicted(hz=10), told["binding"])
    assert {each["name"]: each["agents"] for each in told["limits"]}["inequality 2.9"] is None
