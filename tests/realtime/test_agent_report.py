"""What a ping tells of an agent, which has to fit a datagram whatever disks, plug-ins and devices have said."""

from types import SimpleNamespace

import pytest

from madns_runtime import __version__
from madns_runtime.config import Timeouts
from madns_runtime.plugin.columns import COLUMNS_MAX
from madns_runtime.protocol.agent_session import AgentIdentity, AgentSession
from madns_runtime.protocol.host_session import HostSession
from madns_runtime.protocol.link_settings import LinkSettings
from madns_runtime.realtime.agent_report import AgentReport
from madns_runtime.realtime.process_records import PROBLEM_CHARACTERS_MAX
from madns_runtime.recording.newest_values import TEXT_CHARACTERS_MAX

WIRE = LinkSettings(run_key=bytes(32), session=bytes(8))
TICKS = {
    "run": 2**40,
    "missed": 2**40,
    "lateness_us_p50": 2**36,
    "lateness_us_p99": 2**36,
}
REFUSED = "bias is added to numbers, and the device has no input of numbers (inputs: received)"


def made(devices, *, problem="", text=""):
    return AgentReport(
        port=SimpleNamespace(
            t0_host_s=0.0,
            session=SimpleNamespace(
                link=SimpleNamespace(counters=SimpleNamespace(best=SimpleNamespace(lost=2**40)))
            ),
        ),
        records=SimpleNamespace(
            report=lambda: {"dropped": 2**40, "problem": problem[:PROBLEM_CHARACTERS_MAX]}
        ),
        ticks=SimpleNamespace(
            pacer=SimpleNamespace(summary=lambda: TICKS),
            factor=SimpleNamespace(value=lambda: 0.123456789),
        ),
        columns=SimpleNamespace(read=lambda: [text] * COLUMNS_MAX),
        devices=SimpleNamespace(report=lambda: devices),
    )


def heard_by_the_host(report):
    """Return what the host has of an agent once it has pinged."""
    host = HostSession(["a"], WIRE, timeouts=Timeouts(), on_agent_loss="abort", now_s=0.0)
    identity = AgentIdentity(
        name="a", index=1, incarnation_id=1, runtime_version=__version__, pid=1
    )
    session = AgentSession(identity, WIRE, timeouts=Timeouts(), report=report.ping, now_s=0.0)
    session.handle_timer(0.0)
    for datagram in session.datagrams_to_send(0.0):
        host.receive_datagram(datagram, ("a",), 0.0)
    assert session.link.counters.best.sent == 1
    assert host.peers["a"].link.counters.best.received == 1
    return host.peers["a"].report


@pytest.mark.parametrize("text", ["", "x" * TEXT_CHARACTERS_MAX, "\U0001f6f0" * 16])
@pytest.mark.parametrize("problem", ["", "x" * 1000, "\u4e2d" * 1000])
@pytest.mark.parametrize(
    "devices",
    [
        {},
        {"lost_device": ("agent-02/tank", "x" * 200)},
        {"fault_answers": [(number, REFUSED * 3) for number in range(32)]},
    ],
    ids=["none", "lost", "refusing"],
)
def test_a_ping_is_sent_whatever_is_told_in_it(devices, problem, text):
    told = heard_by_the_host(made(devices, problem=problem, text=text))

    assert told["ticks"] == told["dropped"] == 2**40
    if problem.isascii() and text.isascii() and "fault_answers" not in devices:
        assert told["columns"] == [text] * COLUMNS_MAX
