"""What a plug-in may not do: the verdict names the call, whatever it returns or however it ends."""

import json
import re
import signal

import pytest
from harness.cosmos_command import LOOSE, CosmosCommand
from harness.nights import by_night

from madns_runtime.plugin.host_calls import FOLDER, PREFIX

pytestmark = pytest.mark.process

PLUGIN = """
import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from madns_runtime.plugin.api import HOST, AgentSimulation, HostSimulation, Simulation
from madns_runtime.protocol.messages import Service

@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    evil: str = ""

class H(HostSimulation):
    def setup(self, context):
        self.context, self.evil = context, context.parameters.evil

    def initial_data(self, agent):
        if self.evil == "reused":
            self.data = getattr(self, "data", {})
            self.data["whose"] = agent
            return self.data
        return {1, 2} if self.evil == "initial_data" else {}

    def receive(self, agent, message):
        self.heard_s = self.context.now_s()
        self.context.wake(self.heard_s + 0.1)
        self.context.wake(9e9)

    def timer(self, t_s):
        if self.evil == "wake" and hasattr(self, "heard_s"):
            self.woken = 0.0 <= t_s - (self.heard_s + 0.1)
            return None
        if self.evil == "timer":
            return float("nan")
        if self.evil == "timer_again" and t_s >= 0.3:
            return t_s
        if self.evil == "timer_exit" and t_s >= 0.3:
            os._exit(3)
        if self.evil in ("timer_again", "timer_exit"):
            return 0.3
        if self.evil == "nominal":
            return self.note(t_s)
        if self.evil == "slow":
            time.sleep(0.3 if hasattr(self, "is_second") else 0)
            self.is_second = True
            return 0.3 if t_s < 0.3 else None
        if self.evil == "best_deadline" and t_s >= 0:
            self.context.send("agent-01", 1, Service.BEST, deadline_s=t_s + 1.0)
        if self.evil in ("deadline", "best_deadline"):
            for agent in self.context.agents:
                self.context.send(agent, "late", Service.SYNC, deadline_s=t_s - 1.0)
            return t_s + 0.2
        return None

    def note(self, t_s):
        self.times_s = [*getattr(self, "times_s", []), t_s]
        self.late_s = max(getattr(self, "late_s", 0.0), self.context.timer_lateness_s)
        if len(self.times_s) == 3:
            time.sleep(0.12)
        return t_s + 0.05

    def finish(self):
        if self.evil == "nominal":
            return {"times_s": self.times_s, "late_s": self.late_s}
        if self.evil == "wake":
            return {"woken": self.woken}
        return None if self.evil == "host_finish" else {}

class A(AgentSimulation):
    has_forked = has_sent = False

    def __init__(self):
        wanted = Path(__file__).with_name("fork_as_it_is_made")
        if wanted.exists():
            wanted.unlink()
            if os.fork():
                time.sleep(0.5)  # the other process is first

    def setup(self, context, initial):
        self.context, self.evil, self.pid = context, context.parameters.evil, os.getpid()
        self.initial = initial

    def step(self, tick):
        if os.getpid() != self.pid:
            Path(__file__).with_name("stepped_by_a_fork").touch()
        if self.evil == "exit" and self.context.name == "agent-01" and tick.index >= 3:
            os._exit(0)
        if self.evil == "crash" and self.context.name == "agent-01" and tick.index >= 3:
            os.kill(os.getpid(), signal.SIGSEGV)
        if self.evil == "nameless" and self.context.name == "agent-01" and tick.index >= 3:
            os.kill(os.getpid(), signal.SIGRTMIN + 1)
        is_forking = self.evil.startswith("fork") and not self.has_forked
        if is_forking and self.context.name == "agent-01":
            self.has_forked = True
            if not os.fork() and self.evil == "fork_exit":
                sys.exit(0)
        if self.evil == "text" and tick.index >= 3:
            raise ValueError("\\udcff" + "x" * 100_000)
        is_first = not self.has_sent and tick.index >= 3
        if self.evil == "wake" and self.context.name == "agent-01" and is_first:
            self.has_sent = True
            self.context.send(HOST, 1)
        if self.evil == "service":
            self.context.send(HOST, 1, "SYNC")

    def finish(self):
        if self.evil == "reused":
            return self.initial
        return {"set": {1, 2}} if self.evil == "agent_finish" else {}

simulation = Simulation(name="evil", parameters=Parameters, host=":H", agent=":A")
"""
SCENARIO = """
name: evil
simulation: ./evil.py:simulation
agents: {count: 2, tick_hz: 20}
time: {duration_s: 1, rtf_tolerance: 100}
deadline: {max_miss_ratio: 1}
"""
SOME = "time.duration_s=4"
"""For what is to end well: of a second a busy machine may let no agent have two ticks, and then there is no rate to judge."""
LONG = "time.duration_s=30"
"""For what ends a run in one of its first ticks, whichever of them a busy machine has missed."""


FAULTS = [
    ("initial_data", "host", "H.initial_data returned a set: expected a mapping"),
    ("timer", "host", "H.timer returned nan: expected a simulated time"),
    ("timer_again", "host", "H.timer returned 0.3, called for t = 0.3 s: expected a later time"),
    ("host_finish", "host", "H.finish returned None: expected a mapping; is a return"),
    ("agent_finish", "agent-0", "A.finish returned a summary without a JSON form"),
    ("text", "agent-0", "A.step raised ValueError: \\udcffxxx"),
    ("service", "agent-0", "expected a Service, such as Service.RELIABLE, got 'SYNC'"),
    ("best_deadline", "host", "deadline_s goes with Service.SYNC, not with <Service.BEST"),
]


MODES = ["realtime", "lockstep"]
REALTIME_BY_DAY = by_night(MODES, day=["realtime"])
LOCKSTEP_BY_DAY = by_night(MODES, day=["lockstep"])


def in_both_modes(faults):
    """Yield each fault in each mode: in one of them, by turns, every night alone."""
    for number, fault in enumerate(faults):
        for place, mode in enumerate(("realtime", "lockstep")):
            marks = (pytest.mark.nightly,) if number % 2 == place else ()
            yield pytest.param(*fault, mode, id=f"{fault[0]}-{mode}", marks=marks)


@pytest.mark.parametrize(("evil", "who", "expected", "mode"), list(in_both_modes(FAULTS)))
def test_the_verdict_names_the_call_in_both_modes(tmp_path, evil, who, expected, mode):
    length = (LONG,) if evil == "text" else ()
    result = run(tmp_path, evil, f"time.mode={mode}", *length)

    assert result["exit_code"] == 1
    assert result["who"].startswith(who)
    assert expected in result["reason"]
    assert len(result["reason"]) < 3000


def test_an_agent_that_ends_its_process_is_named(tmp_path):
    result = run(tmp_path, "exit", LONG)

    assert (result["exit_code"], result["who"]) == (1, "agent-01")
    # A busy machine may miss the tick at 0.15 s: then it ends in the next.
    told = r"its process ended by itself, exit code 0 in the step of agent-01 at t = \d+(\.\d+)? s"
    assert re.search(told, result["reason"])


@pytest.mark.parametrize("evil", ["fork_exit", "fork_return"])
def test_an_agent_goes_on_alone_whose_fork_comes_back_from_the_call(tmp_path, evil):
    result = run(tmp_path, evil, "agents.per_process=2", SOME)

    assert (result["exit_code"], result["reason"]) == (0, None)
    assert not (tmp_path / "stepped_by_a_fork").exists()  # by the other agent of the process


@pytest.mark.nightly
def test_an_agent_goes_on_alone_whose_fork_comes_back_as_it_is_made(tmp_path):
    (tmp_path / "fork_as_it_is_made").touch()
    result = run(tmp_path, "good", "agents.per_process=2", SOME)

    assert (result["exit_code"], result["reason"]) == (0, None)
    assert not (tmp_path / "fork_as_it_is_made").exists()


def test_an_agent_that_is_killed_in_a_call_is_told_with_the_call(tmp_path):
    result = run(tmp_path, "crash", "agents.per_process=2", LONG)

    assert result["exit_code"] == 1
    # As above.
    told = r"killed by SIGSEGV in the step of agent-01 at t = \d+(\.\d+)? s"
    assert re.search(told, result["reason"])


@pytest.mark.parametrize("mode", REALTIME_BY_DAY)
def test_an_agent_that_is_killed_by_a_signal_without_a_name_costs_no_other(tmp_path, mode):
    result = run(tmp_path, "nameless", SOME, f"time.mode={mode}", "on_agent_loss=continue")

    assert (result["status"], result["agents"]["lost"]) == ("complete", ["agent-01"])
    assert f"killed by signal {signal.SIGRTMIN + 1} in the " in json.dumps(result)


@pytest.mark.parametrize("mode", LOCKSTEP_BY_DAY)
def test_a_host_that_ends_without_a_word_is_told_with_the_call(tmp_path, mode):
    result = run(tmp_path, "timer_exit", f"time.mode={mode}")

    assert (result["exit_code"], result["who"]) == (1, "host")
    told = r"exited with code 3 in H\.timer at t = (\d+(\.\d+)?) s before the run was over"
    found = re.search(told, result["reason"])
    assert found, result["reason"]
    # The time of the call, which a busy machine makes later than the one it was asked for.
    t_s = float(found[1])
    assert t_s == 0.3 if mode == "lockstep" else t_s >= 0.3


def test_a_call_that_holds_the_host_is_told_with_its_time(tmp_path):
    result = run(tmp_path, "slow")

    told = result["host_calls"]["methods"]["H.timer"]
    assert told["longest_s"] >= 0.3
    assert told["longest_t_s"] >= 0.3
    words = f"the longest H.timer for {told['longest_s']:.3g} s"
    assert any(words in remark for remark in result["remarks"])


@pytest.mark.nightly
def test_no_page_of_a_host_is_left(tmp_path):
    before = set(FOLDER.glob(f"{PREFIX}*"))
    run(tmp_path, "timer_exit")
    run(tmp_path, "none")

    assert [
        path for path in set(FOLDER.glob(f"{PREFIX}*")) - before if is_own(path, tmp_path)
    ] == []


def is_own(path, tmp_path):
    """Tell whether a page is of a run of this test: others may run meanwhile."""
    plans = [json.loads(plan.read_text()) for plan in tmp_path.glob("runs/*/plan.json")]
    return any(path.name.endswith(plan["session"]) for plan in plans)


@pytest.mark.parametrize("mode", REALTIME_BY_DAY)
def test_the_timer_is_given_the_times_it_asked_for_however_late_it_is(tmp_path, mode):
    result = run(tmp_path, "nominal", f"time.mode={mode}")
    told = result["simulation"]["host"]
    start_s, *times_s = told["times_s"]

    assert start_s == -0.5
    assert times_s[:20] == pytest.approx([-0.45 + 0.05 * number for number in range(20)])
    assert (told["late_s"] > 0.0) == (mode == "realtime")


@pytest.mark.parametrize("mode", LOCKSTEP_BY_DAY)
def test_each_agent_is_given_its_own_initial_data_though_the_host_returns_one_mapping(
    tmp_path, mode
):
    result = run(tmp_path, "reused", f"time.mode={mode}")

    assert result["simulation"]["agents"] == {
        name: {"whose": name} for name in ("agent-01", "agent-02")
    }


def test_broken_sync_deadline_breaks_its_check(tmp_path):
    result = run(tmp_path, "deadline")

    broken = [check["name"] for check in result["checks"] if not check["passed"]]
    assert broken == ["messages.sync.deadlines_broken"]
    assert result["messages"]["sync"]["deadlines_broken"] >= 8
    assert result["exit_code"] == 4


@pytest.mark.parametrize("mode", REALTIME_BY_DAY)
def test_a_half_that_hears_something_can_ask_for_its_timer(tmp_path, mode):
    result = run(tmp_path, "wake", f"time.mode={mode}", SOME)

    assert result["simulation"]["host"] == {"woken": True}
    assert result["exit_code"] == 0


def run(tmp_path, evil, *settings):
    (tmp_path / "evil.py").write_text(PLUGIN, "utf-8")
    (tmp_path / "evil.yaml").write_text(SCENARIO, "utf-8")
    scenario = tmp_path / "evil.yaml"
    _, result = CosmosCommand(tmp_path).run(scenario, f"parameters.evil={evil}", *LOOSE, *settings)
    return result
