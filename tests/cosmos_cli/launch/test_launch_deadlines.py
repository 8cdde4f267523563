from __future__ import annotations

import dataclasses
import math

import pytest

from cosmos_cli.launch.actions import Agenda
from cosmos_cli.launch.host_limits import MARGIN_S, state_limit_s
from cosmos_cli.launch.request import MANUAL_READY_S, with_manual_agents
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


@dataclasses.dataclass(frozen=True)
class Decision:
    """Stands for what is called at its moment."""

    name: str

    def __call__(self) -> None:
        raise AssertionError("the agenda only hands it out")


def test_what_is_due_happens_once() -> None:
    agenda = Agenda()
    agenda.after("a", 1.0, Decision("a"))
    agenda.after("b", 2.0, Decision("b"))

    assert [*agenda.due(1.5), *agenda.due(1.5)] == [Decision("a")]
    assert agenda.wait_s(1.5) == 0.5


def test_moment_that_is_set_again_is_moved() -> None:
    agenda = Agenda()
    agenda.after("a", 1.0, Decision("early"))
    agenda.now_s = 0.5
    agenda.after("a", 2.5, Decision("late"))

    assert [*agenda.due(2.0), *agenda.due(3.0)] == [Decision("late")]


@pytest.mark.parametrize("is_moved", [False, True])
def test_moment_may_cancel_or_move_another_that_is_due_at_the_same_time(is_moved: bool) -> None:
    agenda = Agenda()
    agenda.after("a", 1.0, Decision("a"))
    agenda.after("b", 1.0, Decision("b"))

    came = []
    for decision in agenda.due(1.0):
        came.append(decision)
        agenda.after("b", 2.0, Decision("b")) if is_moved else agenda.cancel("b")

    assert came == [Decision("a")]
    assert agenda.wait_s(1.0) == (1.0 if is_moved else None)


def test_overdue_moment_is_waited_for_no_longer() -> None:
    agenda = Agenda()
    agenda.after("a", 1.0, Decision("a"))

    assert agenda.wait_s(5.0) == 0.0


def test_time_in_which_the_operator_was_stopped_does_not_count() -> None:
    agenda = Agenda()
    agenda.after("a", 1.0, Decision("a"))

    agenda.postpone(10.0)

    assert list(agenda.due(10.9)) == []
    assert agenda.wait_s(10.0) == 1.0


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
