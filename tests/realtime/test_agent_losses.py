"""Losses of agents in real time: why the simulation's half is told that one is lost, and what the result says."""

from types import SimpleNamespace
from typing import Any

import pytest

from madns_runtime.faults.intended_losses import IntendedLosses
from madns_runtime.protocol.events import AgentLost, AgentMoved, Phase
from madns_runtime.realtime.agent_losses import AgentLosses
from madns_runtime.realtime.announcements import Announcements

WHY = "killed on purpose at t = 3 s"


@pytest.mark.parametrize(
    ("ordered", "told"), [(WHY, WHY), (None, "killed by SIGKILL")], ids=["ordered", "by itself"]
)
def test_the_half_is_told_why_an_agent_is_lost_on_purpose_whoever_shared_its_process(
    ordered: str | None, told: str
) -> None:
    heard: list[tuple[str, ...]] = []
    report: Any = SimpleNamespace(lost={}, intended_lost={})
    core: Any = SimpleNamespace(journal=None, port=SimpleNamespace(now_s=lambda: 3.0))
    faults: Any = SimpleNamespace(lost=lambda agent, incarnation: ordered)
    announced: Any = SimpleNamespace(log=lambda level, text: None)
    losses = AgentLosses(
        core, report, faults=faults, announced=announced, call=lambda *call: heard.append(call)
    )

    losses.lost(AgentLost("a", "killed by SIGKILL"), may_tell=True)

    assert heard == [("agent_lost", "a", told)]
    assert (report.intended_lost if ordered else report.lost) == {"a": told}


@pytest.mark.parametrize("phase", [Phase.LOST, Phase.RUNNING])
@pytest.mark.parametrize("is_ordered", [True, False])
def test_the_event_of_a_loss_on_purpose_says_so_as_in_lockstep(
    phase: Phase, is_ordered: bool
) -> None:
    told: list[dict[str, object]] = []
    journal: Any = SimpleNamespace(event=lambda word, **values: told.append(values))
    core: Any = SimpleNamespace(journal=journal, port=SimpleNamespace(now_s=lambda: 3.0))
    intended = IntendedLosses()
    if is_ordered:
        intended.order("a", WHY, returns_s=None)
    host: Any = SimpleNamespace()
    faults: Any = SimpleNamespace(intended=intended)
    losses = AgentLosses(
        core,
        host,
        faults=faults,
        announced=Announcements(journal, lambda event: None),
        call=print,
    )

    losses.moved(AgentMoved("a", phase, "killed by SIGKILL", 1))

    plain = {"agent": "a", "state": phase.value, "incarnation": 1, "reason": "killed by SIGKILL"}
    is_told = is_ordered and phase is Phase.LOST
    assert told == [{**plain, "is_intended": True} if is_told else plain]
