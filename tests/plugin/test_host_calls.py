"""The calls of a host's half: the page that outlives the process, and the account of long calls."""

import os
import subprocess
import sys

import pytest

from cosmos_cli.evidence.remarks import long_call_remarks
from madns_runtime.plugin import host_calls
from madns_runtime.plugin.host_calls import (
    SWEPT_AFTER_S,
    HostCalls,
    interrupted_call,
    page_path,
    take_page,
)
from madns_runtime.realtime.agent_calls import AGENT, METHOD, STEP, T_S, AgentCalls


@pytest.fixture
def session():
    name = os.urandom(8).hex()
    yield name
    page_path(name).unlink(missing_ok=True)


@pytest.mark.process
def test_the_call_under_way_outlives_its_process(session):
    script = (
        "import os\nfrom madns_runtime.plugin.host_calls import HostCalls\n"
        f"calls = HostCalls({session!r})\ncalls.name, calls.t_s = 'Fleet', lambda: 12.5\n"
        "calls.begin('timer')\nos._exit(3)\n"
    )
    subprocess.run([sys.executable, "-c", script], check=False)

    assert take_page(session) == " in Fleet.timer at t = 12.5 s"
    assert not page_path(session).exists()


def test_a_call_that_has_returned_is_not_blamed(session):
    calls = HostCalls(session)
    calls.end("setup", calls.begin("setup"))

    assert take_page(session) == ""


def test_a_call_before_there_is_time_is_told_without_one(session):
    calls = HostCalls(session)
    calls.name = "Fleet"
    calls.begin("setup")
    line = page_path(session).read_bytes()

    assert interrupted_call(line) == " in Fleet.setup"
    assert interrupted_call(line.rstrip(b"\n")) == " in Fleet.setup"
    calls.close()
    assert not page_path(session).exists()


@pytest.mark.parametrize("line", [b"", b">" * 10, b">" * 300, b"\xff" * 300])
def test_what_is_no_page_tells_nothing(line):
    assert interrupted_call(line) == ""


def test_a_page_is_never_made_through_a_link(session, tmp_path):
    target = tmp_path / "target"
    target.write_text("mine")
    page_path(session).symlink_to(target)
    HostCalls(session).begin("setup")

    assert target.read_text() == "mine"
    assert take_page(session) == ""


@pytest.mark.process
@pytest.mark.parametrize("age_s", [0.0, 2 * SWEPT_AFTER_S])
def test_pages_of_hosts_that_died_long_ago_are_swept_and_others_left_to_be_read(session, age_s):
    script = f"from madns_runtime.plugin.host_calls import HostCalls\nHostCalls({session!r}).begin('x')\n"
    subprocess.run([sys.executable, "-c", script], check=True)
    made_s = page_path(session).stat().st_mtime
    os.utime(page_path(session), (made_s - age_s, made_s - age_s))

    other = os.urandom(8).hex()
    HostCalls(other).close()

    assert page_path(session).exists() is (age_s == 0.0)


class Clock:
    now_s = 100.0

    def __call__(self):
        return self.now_s


def test_calls_that_hold_the_loop_are_counted_with_the_longest(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(host_calls, "monotonic", clock)
    calls, warned = HostCalls(), []
    calls.name, calls.t_s, calls.warn, calls.is_counting = "Fleet", clock, warned.append, True
    for method, took_s in (("receive", 0.009), ("timer", 0.3), ("timer", 0.02), ("receive", 0.7)):
        began_s = calls.begin(method)
        clock.now_s += took_s
        calls.end(method, began_s)

    account = calls.to_mapping()
    assert (account["calls"], account["long"], account["limit_s"]) == (4, 3, 0.01)
    assert account["methods"] == {
        "Fleet.timer": {"long": 2, "longest_s": 0.3, "longest_t_s": 100.009},
        "Fleet.receive": {"long": 1, "longest_s": 0.7, "longest_t_s": 100.329},
    }
    assert len(warned) == 1 and warned[0].startswith("Fleet.receive took 0.7 s, and the host stood")
    (remark,) = long_call_remarks(account)
    assert "3 calls of the plug-in held its loop for more than 10 ms" in remark
    assert "the longest Fleet.receive for 0.7 s at t = 100 s" in remark


def test_calls_before_simulated_time_do_not_count(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(host_calls, "monotonic", clock)
    calls = HostCalls()
    began_s = calls.begin("setup")
    clock.now_s += 5.0
    calls.end("setup", began_s)

    assert calls.to_mapping()["calls"] == 0
    assert long_call_remarks(calls.to_mapping()) == ()
    assert long_call_remarks({}) == ()


def test_an_agents_call_is_told_with_agent_and_time():
    calls = AgentCalls()
    names = ("agent-01", "agent-02")
    assert calls.interrupted(names) == ""

    calls.page[AGENT], calls.page[METHOD] = 1, STEP
    assert calls.interrupted(names) == " in the step of agent-02"

    calls.page[T_S] = 5.7
    assert calls.interrupted(names) == " in the step of agent-02 at t = 5.7 s"
