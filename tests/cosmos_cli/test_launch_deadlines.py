from __future__ import annotations

import dataclasses
import math

from cosmos_cli.launch.deadlines import MANUAL_READY_S, MARGIN_S, Deadlines, state_limit_s
from cosmos_cli.launch.outcome import with_manual_agents
from madns_runtime.config import Agents, RunConfig, Timeouts, TimeSettings

CONFIG = RunConfig(
    run="0001-x",
    scenario="x",
    simulation="counter",
    base_directory=".",
    agents=Agents(count=1),
    time=TimeSettings(duration_s=100),
    timeouts=Timeouts(
        agents_ready_s=1, host_setup_s=2, agent_setup_s=3, start_lead_s=0.5, complete_s=4
    ),
)


def test_what_is_due_is_done_once() -> None:
    deadlines, done = Deadlines(), []
    deadlines.set("a", 1.0, lambda: done.append("a"))
    deadlines.set("b", 2.0, lambda: done.append("b"))

    deadlines.fire(1.5)
    deadlines.fire(1.5)

    assert done == ["a"]
    assert deadlines.wait_s(1.5) == 0.5


def test_deadline_that_is_set_again_is_moved() -> None:
    deadlines, done = Deadlines(), []
    deadlines.set("a", 1.0, lambda: done.append("early"))
    deadlines.set("a", 3.0, lambda: done.append("late"))

    deadlines.fire(2.0)
    deadlines.fire(3.0)

    assert done == ["late"]


def test_deadline_may_cancel_another_that_is_due_at_the_same_time() -> None:
    deadlines, done = Deadlines(), []
    deadlines.set("a", 1.0, lambda: deadlines.cancel("b"))
    deadlines.set("b", 1.0, lambda: done.append("b"))

    deadlines.fire(1.0)

    assert done == []
    assert deadlines.wait_s(1.0) is None


def test_overdue_deadline_is_waited_for_no_longer() -> None:
    deadlines = Deadlines()
    deadlines.set("a", 1.0, lambda: None)

    assert deadlines.wait_s(5.0) == 0.0


def test_time_in_which_the_operator_was_stopped_does_not_count() -> None:
    deadlines, done = Deadlines(), []
    deadlines.set("a", 1.0, lambda: done.append("a"))

    deadlines.postpone(10.0)
    deadlines.fire(10.9)

    assert done == []
    assert deadlines.wait_s(10.0) == 1.0


def test_limit_of_a_state_is_the_hosts_own_and_a_margin() -> None:
    states = (
        "HOST_STARTUP",
        "SIMULATION_SETUP",
        "HOST_SIMULATION_READY",
        "SIMULATION_START",
        "BEGIN_SHUTDOWN",
    )

    limits = [state_limit_s(state, CONFIG) - MARGIN_S for state in states]

    assert limits == [1, 5, 3, 104.5, 10]


def test_manual_agents_extend_the_time_to_get_ready_only() -> None:
    extended = with_manual_agents(CONFIG, ("agent-01",))

    assert extended.timeouts.agents_ready_s == MANUAL_READY_S
    timeouts = dataclasses.replace(extended.timeouts, agents_ready_s=1)
    assert dataclasses.replace(extended, timeouts=timeouts) == CONFIG
    assert with_manual_agents(CONFIG, ()) == CONFIG


def test_lockstep_may_take_as_long_as_it_takes() -> None:
    config = dataclasses.replace(CONFIG, time=TimeSettings(mode="lockstep", duration_s=100))

    assert state_limit_s("SIMULATION_START", config) == math.inf
    assert state_limit_s("SIMULATION_SETUP", config) == state_limit_s("SIMULATION_SETUP", CONFIG)
