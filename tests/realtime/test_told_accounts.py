"""An agent that has the key and tells what no agent tells: it is counted, and the run has its progress and its result."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import orjson
import pytest

from madns_runtime import __version__
from madns_runtime.config import Timeouts
from madns_runtime.faults.intended_losses import IntendedLosses
from madns_runtime.protocol.accounts import NUMBER_MAX, are_last_counts, is_report, is_summary
from madns_runtime.protocol.agent_session import AgentIdentity, AgentSession
from madns_runtime.protocol.codec import encode_message, pack, unpack
from madns_runtime.protocol.counters import LinkCounters
from madns_runtime.protocol.events import Phase
from madns_runtime.protocol.host_session import HostSession
from madns_runtime.protocol.link_settings import LinkSettings
from madns_runtime.protocol.messages import AgentStopped, Ping, Service, SimulationComplete
from madns_runtime.realtime.host_result import HostReport
from madns_runtime.recording.records import DEVICE_LOSSES

WIRE = LinkSettings(run_key=bytes(32), session=bytes(8))


def host_that_heard(message: Any, service: Service) -> HostSession:
    """Return a host to which a running agent said this."""
    host = HostSession(
        ("agent-01", "agent-02"),
        WIRE,
        timeouts=Timeouts(),
        on_agent_loss="continue",
        now_s=0.0,
    )
    agent = AgentSession(
        AgentIdentity(
            name="agent-01", index=1, incarnation_id=9, runtime_version=__version__, pid=7
        ),
        WIRE,
        timeouts=Timeouts(),
        report=dict,
        now_s=0.0,
    )

    def hand_in() -> None:
        for data in agent.datagrams_to_send(0.0):
            host.receive_data(data, ("here", 1), 0.0)

    hand_in()
    host._roster.move(host.peers["agent-01"], Phase.RUNNING)
    agent.link.send_urgent(encode_message(message), service, 0.0)
    hand_in()
    return host


def told_by(host: HostSession) -> bytes:
    """Return what the host tells of its run, as it writes it."""
    report = HostReport(10.0, ("state.x",))
    progress = report.progress(host, 1.0)
    troubles = list(report.new_troubles(host, None))
    result = report.result(host, network={}, carried={"sent": 1}, intended=IntendedLosses())
    return orjson.dumps([progress, troubles, result])


@pytest.mark.parametrize(
    "report",
    [
        {"ticks": "x"},
        {"ticks": math.nan},
        {"ticks": True},
        {"ticks": 2**64 - 1},
        {"missed": []},
        {"rtf": "fast"},
        {"rtf": math.inf},
        {"lost": None},
        {"late_p50_us": [1]},
        {"late_p99_us": "x"},
        {"dropped": b"1"},
        {"problem": ["x"]},
        {"columns": 1},
        {"lost_device": ["imu"]},
        {"lost_device": [[1], "x"]},
        {"fault_answers": [1]},
        {"fault_answers": [[[1], "x"]]},
    ],
    ids=str,
)
def test_report_that_is_none_is_counted_and_not_reckoned_with(report):
    host = host_that_heard(Ping(0.0, report), Service.BEST)

    assert host.malformed_count == 1
    assert host.peers["agent-01"].report == {}
    assert told_by(host)


@pytest.mark.parametrize(
    "records",
    [
        {"messages": 5},
        {"messages": None},
        {"messages": {"best": 5}},
        {"messages": {"best": {"sent": "x"}}},
        {"messages": {"sync": {"received": math.inf}}},
        {"messages": {"deadlines_broken": {}}},
        {"held_dropped": "x"},
        {"too_late": [1]},
        {"between_agents": 3},
        {"between_agents": {"received": "x"}},
        {DEVICE_LOSSES: [1]},
        {DEVICE_LOSSES: {"imu": 1}},
        {DEVICE_LOSSES: {"imu": {"frames_missed": "x"}}},
        {"written": b"7"},
        {"network": {"received": [np.zeros(3)]}},
    ],
    ids=str,
)
def test_last_counts_that_are_none_are_counted_and_not_reckoned_with(records):
    host = host_that_heard(AgentStopped(records), Service.SYNC)

    assert host.malformed_count == 1
    assert host.peers["agent-01"].records == {}
    assert told_by(host)


@pytest.mark.parametrize("summary", [{"rtf": "fast"}, {"simulation": {"n": [b"x"]}}], ids=str)
def test_summary_that_is_none_is_counted_and_completes_nobody(summary):
    host = host_that_heard(SimulationComplete(summary), Service.RELIABLE)

    assert host.malformed_count == 1
    assert host.peers["agent-01"].phase is Phase.RUNNING
    assert told_by(host)


def test_what_agents_do_tell_is_taken():
    report = {
        "dropped": 0,
        "problem": "No space left on device",
        "ticks": 100,
        "missed": 0,
        "late_p50_us": 12,
        "late_p99_us": 300,
        "rtf": 1.000000012,
        "lost": 0,
        "lost_device": ("pi22/imu", "it gives no samples"),
        "fault_answers": [(3, ""), (4, "it is no fault")],
        "columns": [1.5, "idle", None],
    }
    records = {
        "written": 7,
        "device_losses": {"pi22/imu": {"writes_lost": 1}},
        "messages": LinkCounters().to_mapping(),
        "network": {"received": 2**60, "receive_buffer_bytes": None},
        "between_agents": {"received": 1, "held": 0, "late": 0, "no_room": 0},
        "held_dropped": 0,
        "too_late": 0,
    }
    summary = {"ticks": {"margin_us_min": None}, "rtf": None, "clock": None, "simulation": {"n": 1}}

    assert is_report(unpack(pack(report)))
    assert is_report({"dropped": 0, "rtf": None})
    assert are_last_counts(unpack(pack(records)))
    assert are_last_counts({})
    assert is_summary(unpack(pack(summary)))
    assert is_summary({})


def test_the_largest_numbers_of_many_agents_have_a_sum_that_is_written():
    assert is_report({"ticks": NUMBER_MAX})
    assert orjson.dumps(NUMBER_MAX * 2**15)
