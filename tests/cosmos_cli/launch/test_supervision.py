"""The supervision of a run as tables: events with their times, and the actions that follow."""

from __future__ import annotations

import dataclasses
import signal
from pathlib import Path
from typing import Any

import pytest

from cosmos_cli.launch import actions, events
from cosmos_cli.launch import run_events as happened
from cosmos_cli.launch.actions import Action
from cosmos_cli.launch.children import (
    GROUP_ANSWER_S,
    GROUP_GRACE_S,
    HOST,
    KILL_WAIT_S,
    TERM_GRACE_S,
)
from cosmos_cli.launch.host_limits import HOST_SILENCE_S, MARGIN_S
from cosmos_cli.launch.machine_watch import REATTACH_INTERVAL_S, RETURN_INTERVAL_S, SILENCE_S
from cosmos_cli.launch.request import LaunchRequest, SupervisorStart
from cosmos_cli.launch.run_events import (
    Begun,
    ChildExited,
    ChildLost,
    ChildSaid,
    ChildStarted,
    GroupKilled,
    GroupSeen,
    LineBroke,
    MachineAsked,
    MachineReached,
    Reattached,
    ReattachFailed,
    Signalled,
)
from cosmos_cli.launch.supervision import (
    END_MARGIN_S,
    STOP_GRACE_S,
    Supervision,
)
from madns_runtime.config import Agents, DeviceLaunch, HardwareSettings, RunConfig, Timeouts

LISTENING = events.Listening("127.0.0.1", 40001)
AGENTS = "agents@pi01"
TIMEOUTS = Timeouts(host_start_s=20, agents_ready_s=30, shutdown_s=5)
STEP_S = 0.25


class Table:
    """A supervision on a clock of the test's own, and all that it asked for."""

    def __init__(self, *, remote: tuple[str, ...] = ("pi01",), **changes: Any) -> None:
        config = RunConfig(
            run="0001-x",
            scenario="x",
            simulation="counter",
            base_directory=".",
            agents=changes.pop("agents", Agents(count=2)),
            timeouts=TIMEOUTS,
            on_agent_loss=changes.pop("on_agent_loss", "abort"),
            hardware=HardwareSettings(on_device_loss=changes.pop("on_device_loss", "abort")),
        )
        self.request = request = LaunchRequest(
            config=config,
            directory=Path("/runs/0001-x"),
            machines={"pi01": config.agents.resolved_names()},
            **changes,
        )
        self.supervision = Supervision(request, remote)
        self.now_s = 100.0
        self.done: list[Action] = []
        self.answers: set[str] = set()
        """Children that answer pings."""

    def play(self, *steps: tuple[float, happened.RunEvent]) -> list[Action]:
        """Let events happen, each so long after the one before; return what was asked for since."""
        before = len(self.done)
        for wait_s, event in steps:
            self.wait(wait_s)
            self._note(self.supervision.handle(event, self.now_s))
        return self.done[before:]

    def wait(self, seconds: float) -> list[Action]:
        """Let time pass in small steps; return what was asked for meanwhile."""
        before, end_s = len(self.done), self.now_s + seconds
        while self.now_s < end_s:
            self.now_s = min(self.now_s + STEP_S, end_s)
            self._note(self.supervision.tick(self.now_s))
        return self.done[before:]

    def run(self, host_pid: int = 10) -> None:
        """Bring the run to where its agents run."""
        self.play(
            (0, Begun()),
            (0, ChildStarted(HOST, None, host_pid)),
            (0, ChildSaid(HOST, LISTENING)),
            (0, ChildStarted(AGENTS, "pi01")),
            (0, ChildSaid(AGENTS, events.ProcessKnown(20))),
            (0, started("agent-01")),
            (0, started("agent-02")),
            (0, state("SIMULATION_START")),
        )

    def _note(self, asked: list[Action]) -> None:
        self.done += asked
        for action in asked:
            is_answered = isinstance(action, actions.Send) and action.name in self.answers
            if is_answered and action.command["command"] == "ping":
                pong = events.PingAnswered(action.command["n"])
                self._note(self.supervision.handle(ChildSaid(action.name, pong), self.now_s))


def started(agent: str, incarnation: int = 1) -> ChildSaid:
    return ChildSaid(AGENTS, events.AgentStarted(agent, 1000, incarnation))


def exited(agent: str, *, is_abnormal: bool, how: str = "ended") -> ChildSaid:
    event = events.AgentExited(agent, 1000, how, is_abnormal=is_abnormal)
    return ChildSaid(AGENTS, event)


def state(name: str) -> ChildSaid:
    return ChildSaid(HOST, events.StateChanged(name))


def of_kind(asked: list[Action], *kinds: type) -> list[Action]:
    return [action for action in asked if isinstance(action, kinds)]


def problems(asked: list[Action]) -> list[str]:
    return [action.text for action in asked if isinstance(action, actions.ReportProblem)]


def told(asked: list[Action], name: str) -> list[dict[str, Any]]:
    """Commands to a child but for pings."""
    sent = [dict(a.command) for a in asked if isinstance(a, actions.Send) and a.name == name]
    return [command for command in sent if command["command"] != "ping"]


@pytest.fixture
def here() -> Table:
    """Return a run whose agents are on this computer."""
    table = Table(remote=())
    table.run()
    return table


@pytest.fixture
def there() -> Table:
    """Return a run whose agents are on another computer."""
    table = Table()
    table.answers = {AGENTS}
    table.run()
    return table


def test_host_is_started_first_and_a_supervisor_when_it_listens() -> None:
    table = Table(remote=(), nice=5)

    assert table.play((0, Begun())) == [actions.StartHost()]
    assert table.play((0, ChildStarted(HOST, None, 10))) == []
    assert table.play((1, ChildSaid(HOST, LISTENING))) == [
        actions.StartAgents("pi01", ("agent-01", "agent-02"), LISTENING),
        actions.StepBack(5),
    ]
    assert table.play((0, ChildSaid(HOST, LISTENING))) == []  # once


@pytest.mark.parametrize(
    ("where", "told"),
    [(" in Grid.setup", ["host (pid 10) stands in Grid.setup"]), ("", [])],
)
def test_call_of_the_plug_in_in_which_a_hanging_host_stands_is_told(
    where: str, told: list[str]
) -> None:
    table = Table(remote=())
    table.play((0, Begun()), (0, ChildStarted(HOST, None, 10)))
    table.wait(TIMEOUTS.host_start_s)

    assert problems(table.play((0, happened.LastCallFound(HOST, "", where)))) == told


def test_host_that_does_not_listen_is_ended_then_killed_then_given_up() -> None:
    table = Table(remote=())
    table.play((0, Begun()), (0, ChildStarted(HOST, None, 10)))
    table.play((0, ChildSaid(HOST, events.Loading("loading a.py"))))

    late = table.wait(TIMEOUTS.host_start_s)
    killed = table.wait(TERM_GRACE_S)
    met = table.play((0, GroupKilled(HOST, "did not heed SIGTERM for 3 s", (10, 11))))

    why = "has not listened within 20 s (timeouts.host_start_s) while loading a.py"
    assert problems(late) == [f"host (pid 10) {why}: it is being ended"]
    assert late[1:] == [
        actions.Terminate(HOST),
        actions.FindLastCall(HOST),
        actions.QuoteLastWords(HOST),
    ]
    assert killed == [actions.Kill(HOST, "did not heed SIGTERM for 3 s")]
    assert problems(met) == [
        "host (pid 10) did not heed SIGTERM for 3 s: killed with SIGKILL (10, 11)"
    ]
    assert not table.supervision.is_over
    table.wait(KILL_WAIT_S)
    assert table.supervision.is_over


def test_run_that_completes_ends_its_supervisors_and_is_over_when_all_groups_are_empty(
    here: Table,
) -> None:
    result = {"status": "complete"}

    here.play((1, ChildSaid(HOST, events.Finished(result))))
    assert told(here.wait(STOP_GRACE_S), AGENTS) == [
        {"command": "stop", "reason": "the run is over"}
    ]
    looked = here.play((0, ChildExited(HOST, "ended", 0)), (0, GroupSeen(HOST, ())))
    assert looked == [actions.LookAtGroup(HOST)]
    here.play((0, exited("agent-01", is_abnormal=False)), (0, ChildExited(AGENTS, "ended", 0)))
    assert not here.supervision.is_over
    here.play((0, GroupSeen(AGENTS, ())))

    assert here.supervision.is_over
    assert here.supervision.host_result == result
    assert problems(here.done) == []


def test_failure_that_a_copy_of_the_host_has_told_stands_before_what_the_host_tells_later(
    here: Table,
) -> None:
    failed = {"status": "failed", "who": HOST, "reason": "it forked a process that came back"}

    here.play(
        (1, ChildSaid(HOST, events.Finished(failed))),
        (1, ChildSaid(HOST, events.Finished({"status": "complete"}))),
    )

    assert here.supervision.host_result == failed


def test_supervisor_that_does_not_end_with_the_run_is_ended_by_force(here: Table) -> None:
    here.play((1, ChildSaid(HOST, events.Finished({"status": "complete"}))))

    limit_s = STOP_GRACE_S + TIMEOUTS.shutdown_s + END_MARGIN_S
    here.play((0, ChildExited(HOST, "ended", 0)), (0, GroupSeen(HOST, ())))
    late = here.wait(limit_s)

    assert problems(late) == [
        f"{AGENTS} (pid 20) has not ended within 12 s of the end of the run: it is being ended"
    ]
    assert of_kind(late, actions.Terminate) == [actions.Terminate(AGENTS)]


def test_members_that_a_dead_leader_leaves_are_killed_after_a_grace(here: Table) -> None:
    here.play((0, ChildExited(HOST, "was killed by SIGKILL", -9)), (0, GroupSeen(HOST, (11,))))
    for _ in range(4):
        here.play((GROUP_GRACE_S / 4, GroupSeen(HOST, (11,))))

    (kill,) = of_kind(here.done, actions.Kill)

    assert kill == actions.Kill(HOST, "left 1 running that should have ended with it")
    here.play((0, GroupSeen(HOST, ())))
    assert here.supervision.has_ended(HOST)


def kills_of_host(table: Table) -> list[actions.Kill]:
    return [kill for kill in of_kind(table.done, actions.Kill) if kill.name == HOST]


def test_dead_leader_is_not_told_late_while_its_machine_has_not_answered_who_of_its_group_lives(
    here: Table,
) -> None:
    here.play((1, ChildSaid(HOST, events.Finished({"status": "complete"}))))
    here.play((0, ChildExited(HOST, "ended", 0)), (0, GroupSeen(HOST, ())))
    here.play((0, exited("agent-01", is_abnormal=False)), (0, ChildExited(AGENTS, "ended", 0)))

    here.play((20, GroupSeen(AGENTS, (20,), age_s=21)), (1, GroupSeen(AGENTS, ())))

    assert problems(here.done) == []
    assert here.supervision.is_over


def test_nobody_is_taken_for_left_by_what_a_busy_machine_told_before_the_grace_was_over(
    here: Table,
) -> None:
    here.play((0, ChildExited(HOST, "ended", 0)))
    for late_s in range(1, 20):
        here.play((1, GroupSeen(HOST, (10,), age_s=late_s + 0.5)))
    here.play((1, GroupSeen(HOST, ())))

    assert kills_of_host(here) == []
    assert here.supervision.has_ended(HOST)


def test_members_are_killed_of_whom_a_machine_answers_nothing_new(here: Table) -> None:
    here.play((0, ChildExited(HOST, "ended", 0)))
    over_s = GROUP_GRACE_S + GROUP_ANSWER_S

    here.play((over_s - 0.1, GroupSeen(HOST, (10,), age_s=over_s)))
    assert kills_of_host(here) == []
    here.play((0.1, GroupSeen(HOST, (10,), age_s=over_s)))

    (kill,) = kills_of_host(here)
    assert kill.why == "left 1 running that should have ended with it, as known 35 s ago"


def test_host_that_died_is_told_with_its_last_call(here: Table) -> None:
    died = here.play((0, ChildExited(HOST, "was killed by SIGKILL", -9)))
    found = here.play((0, happened.LastCallFound(HOST, "was killed by SIGKILL", " in step()")))

    assert died == [
        actions.LookAtGroup(HOST),
        actions.FindLastCall(HOST, "was killed by SIGKILL"),
        actions.QuoteLastWords(HOST),
    ]
    assert problems(found) == [
        "host (pid 10) was killed by SIGKILL in step() before the run was over"
    ]


@pytest.mark.parametrize(("code", "is_kept"), [(0, True), (1, True), (-9, False)])
def test_result_that_a_host_left_counts_if_it_came_to_its_end(
    here: Table, code: int, is_kept: bool
) -> None:
    here.play((0, ChildExited(HOST, "ended", code, {"status": "complete"})))

    assert (here.supervision.host_result is not None) is is_kept


def test_agents_that_end_abnormally_are_told_to_the_host(here: Table) -> None:
    asked = here.play(
        (0, exited("agent-01", is_abnormal=True, how="killed by SIGKILL")),
        (0, exited("agent-02", is_abnormal=False)),
    )

    how = {"agent": "agent-01", "how": "killed by SIGKILL", "pid": 1000}
    assert told(asked, HOST) == [{"command": "agent_exited", **how}]


def test_supervisor_that_dies_loses_the_agents_that_were_not_done_and_leaves_the_host_alone(
    here: Table,
) -> None:
    here.play((0, exited("agent-02", is_abnormal=False)))
    asked = here.play((0, ChildExited(AGENTS, "was killed by SIGKILL", -9)))
    limit_s = TIMEOUTS.silence_s + TIMEOUTS.complete_s + TIMEOUTS.shutdown_s + MARGIN_S
    heard = ChildSaid(HOST, events.Progress(t_s=1.0))
    alone = here.play(*((limit_s / 4, heard) for _ in range(4)))

    text = f"{AGENTS} (pid 20) was killed by SIGKILL"
    assert problems(asked) == [f"{text} before its agents agent-01 were done"]
    (command,) = told(asked, HOST)
    assert (command["agent"], command["how"]) == ("agent-01", f"its supervisor {text}")
    assert told(alone, HOST)[0]["reason"].startswith("the host has gone on without agents")


def test_running_host_that_says_nothing_is_given_up(here: Table) -> None:
    here.play((5, ChildSaid(HOST, events.Progress(t_s=1.0))))

    assert problems(here.wait(HOST_SILENCE_S - 1)) == []
    assert problems(here.wait(1)) == ["host (pid 10) has said nothing for 20 s: it is being ended"]


def test_time_in_which_the_operator_was_stopped_does_not_count(here: Table) -> None:
    here.play((0, ChildSaid(HOST, events.Progress(t_s=1.0))))
    here.now_s += 60.0
    here.supervision.postpone(60.0)

    assert problems(here.wait(HOST_SILENCE_S - 1)) == []


def test_program_that_cannot_be_started_stops_the_host() -> None:
    table = Table(remote=())
    table.play((0, Begun()), (0, ChildStarted(HOST, None, 10)), (0, ChildSaid(HOST, LISTENING)))

    asked = table.play((0, happened.StartFailed(AGENTS, "pi01", "No such file")))

    assert asked[0] == actions.ReportProblem(f"{AGENTS} cannot be started: No such file", "pi01")
    assert told(asked, HOST)[0]["status"] == "failed"


def test_first_signal_stops_the_host_and_a_second_one_kills_everything(here: Table) -> None:
    first = here.play((0, Signalled(signal.SIGHUP)))
    again = here.play((0, Signalled(signal.SIGHUP)))
    second = here.play((0, Signalled(signal.SIGINT)))

    assert told(first, HOST) == [
        {"command": "stop", "reason": "interrupted by SIGHUP", "status": "interrupted"}
    ]
    assert again == []  # a closing terminal sends two
    why = "was ended at once on the operator's word"
    assert of_kind(second, actions.Kill) == [actions.Kill(HOST, why), actions.Kill(AGENTS, why)]
    assert here.supervision.interruption == "at once"


def test_detached_run_is_left_once_it_runs() -> None:
    table = Table(remote=(), is_detached=True)
    table.run()

    assert table.supervision.is_detached
    assert table.supervision.is_over


def test_interrupted_run_is_not_left() -> None:
    table = Table(remote=(), is_detached=True)
    table.play((0, Begun()), (0, ChildStarted(HOST, None, 10)), (0, Signalled(signal.SIGINT)))
    table.play((0, state("SIMULATION_START")))

    assert not table.supervision.is_detached


# Agents started by hand -------------------------------------------------------------------------------


def test_line_of_an_agent_that_left_early_is_told_to_the_host_and_stays_open() -> None:
    table = Table(remote=(), manual=("agent-02",))
    table.run()
    assert of_kind(table.done, actions.OpenManualLine) == [
        actions.OpenManualLine("agent-02", "pi01", LISTENING)
    ]

    left = table.play(
        (0, happened.ManualAgentJoined("agent-02")), (0, happened.ManualAgentLeft("agent-02"))
    )

    assert [command["agent"] for command in told(left, HOST)] == ["agent-02"]
    assert of_kind(left, actions.CloseManualLine) == []


def test_line_of_an_agent_that_is_still_connected_is_closed_after_a_while() -> None:
    table = Table(remote=(), manual=("agent-02",))
    table.run()
    table.play((0, happened.ManualAgentJoined("agent-02")))

    finished = table.play((0, ChildSaid(HOST, events.Finished({"status": "complete"}))))
    late = table.wait(STOP_GRACE_S + TIMEOUTS.shutdown_s + END_MARGIN_S)

    assert actions.StopListening("agent-02") in finished
    assert of_kind(finished, actions.CloseManualLine) == []
    assert of_kind(late, actions.SendOnManualLine)[0].agent == "agent-02"
    assert "agent-02, started by hand, is still connected: its line is being closed" in problems(
        late
    )
    assert of_kind(late, actions.CloseManualLine) == [actions.CloseManualLine("agent-02")]


# Machines ---------------------------------------------------------------------------------------------


def test_silent_supervisor_of_a_running_run_is_a_lost_machine(there: Table) -> None:
    assert len(of_kind(there.wait(5.0), actions.AskMachine)) <= 1  # until its first answer
    assert problems(there.done) == []

    there.answers = set()
    lost = there.wait(SILENCE_S + 2.0)

    text = f"machine pi01 is lost: no sign of life for {SILENCE_S:g} s"
    assert problems(lost) == [text]
    assert [(c["agent"], c["how"]) for c in told(lost, HOST)] == [
        ("agent-01", text),
        ("agent-02", text),
    ]
    assert of_kind(lost, actions.CloseChild, actions.ReachMachine) == [
        actions.CloseChild(AGENTS),
        actions.ReachMachine("pi01"),
    ]


def test_silent_supervisor_of_an_ending_run_is_asked_for_through_its_connection(
    there: Table,
) -> None:
    there.play((5, state("SIMULATION_COMPLETE")))
    there.play((0, ChildSaid(HOST, events.Finished({"status": "complete"}))))
    there.answers = set()  # it closes its records

    asked = 0
    for _ in range(5):
        asked += len(of_kind(there.wait(1.0), actions.AskMachine))
        there.play((0, MachineAsked("pi01", is_alive=True)))

    assert problems(there.done) == []
    assert asked >= 4


def test_machine_that_goes_while_its_run_ends_is_lost_all_the_same(there: Table) -> None:
    there.play((5, state("SIMULATION_COMPLETE")))
    there.answers = set()
    there.wait(1.25)

    asked = there.play((0, MachineAsked("pi01", is_alive=False)))
    lost = there.wait(TIMEOUTS.silence_s)

    assert asked == [actions.Reattach(AGENTS)]  # another connection is tried first
    assert problems(lost) == ["machine pi01 is lost: it does not answer"]


def test_late_answer_is_a_warning() -> None:
    table = Table()
    table.run()
    table.play((1.0, ChildSaid(AGENTS, events.PingAnswered(1))))

    table.wait(0.25)  # the second ping
    asked = table.play((1.5, ChildSaid(AGENTS, events.PingAnswered(2))))

    text = "pi01 answered only after 1.5 s; is its link or its processor overloaded?"
    assert of_kind(asked, actions.Say) == [actions.Say(text, "warning")]


def test_supervisor_that_hangs_beside_a_live_host_is_killed_and_its_machine_is_not_lost() -> None:
    table = Table(host_machine="pi01")
    table.answers = {AGENTS, HOST}
    table.play((0, Begun()), (0, ChildStarted(HOST, "pi01")), (0, ChildSaid(HOST, LISTENING)))
    table.play((0, ChildStarted(AGENTS, "pi01")), (0, state("SIMULATION_START")))
    table.wait(2.0)
    table.answers = {HOST}

    asked = table.wait(SILENCE_S + 2.0)

    assert of_kind(asked, actions.Kill) == [actions.Kill(AGENTS, "gives no sign of life")]
    assert problems(asked) == []


def test_run_ends_when_the_machine_of_its_host_is_lost() -> None:
    table = Table(remote=("pi01", "pi02"), host_machine="pi02")
    table.answers = {AGENTS}
    table.play((0, Begun()), (0, ChildStarted(HOST, "pi02")), (0, ChildSaid(HOST, LISTENING)))
    table.play((0, ChildStarted(AGENTS, "pi01")), (0, state("SIMULATION_START")))

    lost = table.play((0, ChildLost(HOST, "the connection broke")))

    assert problems(lost) == ["machine pi02 is lost: the connection broke"]
    assert told(table.wait(STEP_S), AGENTS) == [{"command": "stop", "reason": "the run is over"}]
    assert not table.supervision.is_over  # while pi02 is reached for


def test_machine_that_returns_is_given_its_agents_again() -> None:
    table = Table(on_agent_loss="continue", agents=Agents(count=2, restarts_max=1))
    table.answers = {AGENTS}
    table.run()
    table.play((1, ChildLost(AGENTS, "the connection broke")))
    again = table.play((0, MachineReached("pi01", is_reached=False)))
    again += table.wait(RETURN_INTERVAL_S)
    back = table.play((0, MachineReached("pi01", is_reached=True)))

    start = SupervisorStart(incarnation=2, first_incarnations={"agent-01": 2, "agent-02": 2})
    assert again == [actions.ReachMachine("pi01")]
    assert back[0] == actions.Say(
        "pi01 has returned; its agents agent-01, agent-02 rejoin", "warning"
    )
    assert back[1] == actions.StartAgents("pi01", ("agent-01", "agent-02"), LISTENING, start)
    assert back[1].name == f"{AGENTS} (2)"


def test_machine_that_returns_is_given_agents_that_were_ended_on_purpose_and_were_to_return() -> (
    None
):
    table = Table(on_agent_loss="continue", agents=Agents(count=2, restarts_max=1))
    table.run()
    for agent, returns in (("agent-01", True), ("agent-02", False)):
        ended = {"how": "killed by SIGKILL", "is_abnormal": True, "is_on_purpose": True}
        event = events.AgentExited(agent, 1000, **ended, will_restart=returns)
        table.play((0, ChildSaid(AGENTS, event)))
    table.play((0, started("agent-01", 2)), (1, ChildLost(AGENTS, "the connection broke")))
    back = table.play((0, MachineReached("pi01", is_reached=True)))

    start = SupervisorStart(
        incarnation=2,
        first_incarnations={"agent-01": 3, "agent-02": 2},
        killed_before={"agent-01": 1, "agent-02": 1},
    )
    assert back[1] == actions.StartAgents("pi01", ("agent-01",), LISTENING, start)


@pytest.mark.parametrize("is_lost", [False, True])
def test_supervisor_that_ends_before_it_has_started_anything_again_is_told(is_lost: bool) -> None:
    table = Table(on_agent_loss="continue", agents=Agents(count=2, restarts_max=1))
    table.run()
    table.play((1, ChildLost(AGENTS, "the connection broke")))
    table.play((1, MachineReached("pi01", is_reached=True)))
    again = f"{AGENTS} (2)"
    table.play((0, ChildStarted(again, "pi01")), (0, ChildSaid(again, events.ProcessKnown(30))))

    why = "the connection broke" if is_lost else "ended with exit code 1"
    ended = ChildLost(again, why) if is_lost else ChildExited(again, why, 1)
    asked = table.play((1, ended))

    told_of = "machine pi01 is lost: the connection broke"
    if not is_lost:
        told_of = f"{again} (pid 30) {why} before its agents agent-01, agent-02 were done"
    assert problems(asked) == [told_of]
    assert bool(of_kind(asked, actions.QuoteLastWords)) is not is_lost
    assert [command["agent"] for command in told(asked, HOST)] == ["agent-01", "agent-02"]


def test_machine_that_is_not_wanted_any_more_is_reached_for_once(there: Table) -> None:
    there.play((1, ChildLost(AGENTS, "the connection broke")))
    gone = there.play((0, MachineReached("pi01", is_reached=False)))
    repeated = there.play((0, happened.SignalUndelivered("pi01")))

    assert [a.text for a in of_kind(gone, actions.Say)] == [
        "pi01 cannot be reached; its agents end by themselves within 40 s"
    ]
    assert repeated == []
    assert of_kind(there.wait(10.0), actions.ReachMachine) == []


WHY_NOT = "the host key is not the one that is known; see known_hosts"


def test_why_a_lost_machine_cannot_be_reached_is_told_during_the_run() -> None:
    table = Table(on_agent_loss="continue", agents=Agents(count=2, restarts_max=1))
    table.answers = {AGENTS}
    table.run()
    table.play((1, ChildLost(AGENTS, "the connection broke")))

    first = table.play((0, MachineReached("pi01", is_reached=False, why=WHY_NOT)))
    table.wait(RETURN_INTERVAL_S)
    second = table.play((0, MachineReached("pi01", is_reached=False, why="no answer in 5 s")))
    given_up = table.supervision.stop_seeking()

    assert first == [
        actions.Say(f"pi01 is tried again every {RETURN_INTERVAL_S:g} s: {WHY_NOT}", "warning")
    ]
    assert second == []
    text = "pi01 cannot be reached; its agents end by themselves within 40 s (the last try: no answer in 5 s)"
    assert given_up == [actions.Say(text, "warning")]


def test_child_of_a_lost_machine_is_lost_once(there: Table) -> None:
    there.play((1, ChildLost(AGENTS, "the connection broke")))

    again = there.play(
        (0, ChildLost(AGENTS, "the connection broke")), (0, ChildExited(AGENTS, "ended", None))
    )

    assert again == []


# Broken lines -----------------------------------------------------------------------------------------


def test_line_that_broke_is_made_anew_and_the_run_goes_on(there: Table) -> None:
    there.wait(3.0)
    broke = there.play((0, LineBroke(AGENTS, "the connection broke")))
    again = there.play((0.1, ReattachFailed(AGENTS)))
    again += there.wait(REATTACH_INTERVAL_S)
    back = there.play((0, Reattached(AGENTS)))

    assert broke == [actions.Reattach(AGENTS)]
    assert actions.Reattach(AGENTS) in again
    text = f"the connection to pi01 broke; {AGENTS} goes on over another one"
    assert back == [actions.Say(text, "warning")]
    assert problems(there.wait(10.0)) == []
    there.answers = set()
    assert problems(there.wait(SILENCE_S + 2.0)) == [  # it is watched as before
        f"machine pi01 is lost: no sign of life for {SILENCE_S:g} s"
    ]


def test_child_whose_line_broke_is_asked_for_nothing_and_is_not_silent() -> None:
    table = Table()
    table.supervision = Supervision(
        dataclasses.replace(
            table.request,
            config=dataclasses.replace(
                table.request.config, timeouts=dataclasses.replace(TIMEOUTS, silence_s=15)
            ),
        ),
        ("pi01",),
    )
    table.answers = {AGENTS}
    table.run()
    table.wait(2.0)
    table.play((0, LineBroke(AGENTS, "the connection broke")))

    asked = table.wait(14.0)

    assert of_kind(asked, actions.Send, actions.AskMachine) == []
    assert problems(asked) == []
    assert problems(table.wait(1.0)) == ["machine pi01 is lost: the connection broke"]


def test_line_that_does_not_come_back_in_time_loses_the_machine(there: Table) -> None:
    there.play((1, LineBroke(AGENTS, "the connection broke")))

    lost = there.wait(TIMEOUTS.silence_s)
    late = there.play((0, Reattached(AGENTS)), (0, ReattachFailed(AGENTS)))

    assert problems(lost) == ["machine pi01 is lost: the connection broke"]
    assert of_kind(lost, actions.CloseChild) == [actions.CloseChild(AGENTS)]
    assert late == []
    assert of_kind(there.wait(5.0), actions.Reattach) == []


def test_why_no_line_could_be_made_anew_is_told_with_the_loss(there: Table) -> None:
    there.play((1, LineBroke(AGENTS, "the connection broke")))
    there.play((0.1, ReattachFailed(AGENTS, WHY_NOT)))

    lost = there.wait(TIMEOUTS.silence_s)

    text = f"machine pi01 is lost: the connection broke, and none could be made anew: {WHY_NOT}"
    assert problems(lost) == [text]


def test_process_that_is_gone_when_its_line_is_made_anew_has_ended(there: Table) -> None:
    there.play((1, LineBroke(AGENTS, "the connection broke")))

    ended = there.play((0, ChildExited(AGENTS, "ended, and nobody knows how")))

    text = f"{AGENTS} (pid 20) ended, and nobody knows how before its agents agent-01, agent-02 were done"
    assert problems(ended) == [text]
    assert problems(there.wait(TIMEOUTS.silence_s + 1)) == []


def test_line_that_broke_twice_at_once_is_made_anew_once(there: Table) -> None:
    there.wait(1.0)
    broke = there.play(
        (0, LineBroke(AGENTS, "the connection broke")),
        (0, LineBroke(AGENTS, "the connection broke")),
        (0, MachineAsked("pi01", is_alive=False)),
    )

    assert broke == [actions.Reattach(AGENTS)]


def test_every_event_has_a_handler() -> None:
    table = Table()
    handled = set(table.supervision._handlers)

    kinds = {
        kind
        for kind in vars(happened).values()
        if dataclasses.is_dataclass(kind) and kind.__module__ == happened.__name__
    }

    assert handled == kinds


def device(status: str, why: str = "", name: str = "pi01/imu") -> ChildSaid:
    return ChildSaid(AGENTS, events.DeviceChanged(name, status, why))


def orders(done: list[Action], command: str) -> list[dict[str, Any]]:
    sent = [dict(a.command) for a in done if isinstance(a, actions.Send) and a.name == HOST]
    return [order for order in sent if order["command"] == command]


def test_a_device_that_is_lost_while_simulated_time_runs_ends_the_run_by_its_name() -> None:
    table = Table()
    table.run()

    done = table.play((1, device("lost", "killed by SIGKILL")), (0, device("ok")))

    assert orders(done, "stop") == [
        {
            "command": "stop",
            "reason": "lost: killed by SIGKILL",
            "status": "failed",
            "who": "pi01/imu",
        }
    ]
    assert orders(done, "device")[0]["status"] == "lost"
    said = [action.text for action in done if isinstance(action, actions.Say)]
    assert "device pi01/imu: lost: killed by SIGKILL" in said


def test_a_device_that_is_still_lost_when_simulated_time_begins_counts() -> None:
    table = Table()
    table.play(
        (0, Begun()),
        (0, ChildStarted(HOST, None, 10)),
        (0, ChildSaid(HOST, LISTENING)),
        (0, ChildStarted(AGENTS, "pi01")),
        (0, device("lost", "no cable")),
        (0, device("lost", "no cable", "pi01/gps")),
        (0, device("ok", name="pi01/gps")),
    )
    assert not orders(table.done, "stop")

    done = table.play((1, state("SIMULATION_START")))

    assert [(o["who"], o["reason"]) for o in orders(done, "stop")] == [
        ("pi01/imu", "lost: no cable")
    ]


def test_a_loss_that_may_be_is_told_and_recorded_alone() -> None:
    table = Table(on_device_loss="continue")
    table.run()

    done = table.play((1, device("lost", "unplugged")), (1, device("ok")))

    assert not orders(done, "stop")
    assert [order["status"] for order in orders(done, "device")] == ["lost", "ok"]


@pytest.mark.parametrize(("rule", "stops"), [("abort", ["pi01/imu"]), ("continue", [])])
def test_devices_of_a_lost_machine_are_lost_and_a_scenario_s_own_are_not(
    rule: str, stops: list[str]
) -> None:
    def launch(name: str, place: str) -> DeviceLaunch:
        return DeviceLaunch(name=name, place=place, kind="k", base_directory="/", rate_hz=1.0)

    devices = {"pi01": (launch("imu", "pi01"), launch("gps", "agent-01"))}
    table = Table(on_device_loss=rule, on_agent_loss="continue", devices=devices)
    table.answers = {AGENTS}
    table.run()
    table.wait(5.0)

    table.answers = set()
    done = table.wait(SILENCE_S + 2.0)

    assert [order["who"] for order in orders(done, "stop")] == stops
    lost = [(order["device"], order["status"]) for order in orders(done, "device")]
    assert lost == [("pi01/imu", "lost")]
    said = [action.text for action in done if isinstance(action, actions.Say)]
    why = f"machine pi01 is lost: no sign of life for {SILENCE_S:g} s"
    assert f"device pi01/imu: lost: {why}" in said
    assert problems(done) == [f"{why}, with pi01/imu"]


def test_devices_that_are_closed_at_the_end_are_no_loss() -> None:
    table = Table()
    table.run()

    done = table.play((1, state("SIMULATION_COMPLETE")), (0, device("lost", "it is closed")))

    assert not orders(done, "stop")
    assert not orders(done, "device")


def test_what_a_driver_says_is_cleaned_before_it_is_shown() -> None:
    line = b'{"event":"device","device":"pi01/imu","status":"lost","why":"\\u001b[2Jgone\\nx"}'

    event = events.parse_event(line)

    assert isinstance(event, events.DeviceChanged)
    assert "\x1b" not in event.text
    assert "\n" not in event.text
    assert "gone" in event.text


IMU = DeviceLaunch(name="imu", place="pi01", kind="null", base_directory=".", rate_hz=1.0)


def ordered(number: int, target: str = "pi01/imu", action: str = "freeze") -> happened.FaultOrdered:
    return happened.FaultOrdered(number, target, action, None)


def answers(done: list[Action]) -> list[tuple[int, str]]:
    return [(a.number, a.refusal) for a in done if isinstance(a, actions.AnswerOrder)]


def test_a_fault_is_passed_to_who_drives_the_device_and_its_answer_told_and_recorded() -> None:
    table = Table(devices={"pi01": (IMU,)})
    table.run()

    asked = table.play((1, ordered(1)))
    told = table.play((1, ChildSaid(AGENTS, events.FaultInserted(1, ""))))

    order = {"command": "inject", "target": "pi01/imu", "action": "freeze", "value": None}
    assert actions.Send(AGENTS, {**order, "order": 1}) in asked
    assert not answers(asked)
    assert answers(told) == [(1, "")]
    assert orders(told, "inject") == [{**order, "refusal": ""}]


def test_a_fault_around_an_unknown_device_is_refused_with_those_that_there_are() -> None:
    table = Table(devices={"pi01": (IMU,)})
    table.run()

    done = table.play((1, ordered(1, "pi01/gps")))

    assert answers(done) == [(1, "no device 'pi01/gps' in this run; there are pi01/imu")]


def test_a_supervisor_that_does_not_answer_is_not_waited_for() -> None:
    table = Table(devices={"pi01": (IMU,)})
    table.run()
    table.play((1, ordered(1)))

    done = table.wait(6.0)
    late = table.play((0, ChildSaid(AGENTS, events.FaultInserted(1, ""))))

    assert answers(done) == [(1, "pi01 has not answered within 5 s")]
    assert not answers(late)


def test_a_late_answer_is_not_taken_for_that_of_the_same_order_given_again() -> None:
    table = Table(devices={"pi01": (IMU,)})
    table.run()
    table.play((1, ordered(1)))
    table.wait(6.0)
    table.play((1, ordered(2)))

    late = table.play((0, ChildSaid(AGENTS, events.FaultInserted(1, ""))))
    own = table.play((1, ChildSaid(AGENTS, events.FaultInserted(2, "it is lost"))))

    assert not answers(late)
    assert answers(own) == [(2, "it is lost")]


def test_a_fault_is_refused_while_nobody_drives_the_device() -> None:
    table = Table(devices={"pi01": (IMU,)})
    table.play((0, Begun()), (0, ChildStarted(HOST, None, 10)))

    assert answers(table.play((1, ordered(1)))) == [(1, "nobody drives pi01/imu at present")]


def test_a_device_that_flaps_is_shown_a_few_times_and_recorded_always() -> None:
    table = Table(on_device_loss="continue")
    table.run()

    done = table.play(*((0, device(status)) for status in ("ok", *("stale", "ok") * 30)))

    said = [action.text for action in done if isinstance(action, actions.Say)]
    assert said[0] == "device pi01/imu: stale"
    assert len(said) == 21
    assert "host's events" in said[-1]
    assert len(orders(done, "device")) == 61
