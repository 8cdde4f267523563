"""Losses of agents in real time: why the simulation's half is told that one is lost, and what the result says."""

from types import SimpleNamespace
from typing import Any

import pytest

from madns_runtime.protocol.events import AgentLost
from madns_runtime.realtime.agent_losses import AgentLosses

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
