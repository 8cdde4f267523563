"""Ticks of an agent whose steps a fault withholds: what it sends to others meanwhile is of the present tick."""

import math
from types import SimpleNamespace
from typing import Any

from madns_runtime.medium.mailbox import Mailbox
from madns_runtime.protocol.messages import AgentFault, Transmission
from madns_runtime.realtime import ticks as module
from madns_runtime.realtime.ticks import PacedTicks, TickCalls
from madns_runtime.timeline.fault_kinds import HANG


def test_what_a_hung_agent_sends_on_a_message_of_the_host_bears_the_newest_tick(
    monkeypatch: Any,
) -> None:
    now_s, sent = [0.0], list[Transmission]()
    monkeypatch.setattr(module, "monotonic", lambda: now_s[0])
    mailbox = Mailbox("a", ("a", "b"), has_medium=True, post=sent.append)
    stepped: list[float] = []
    port: Any = SimpleNamespace(
        process=SimpleNamespace(account=SimpleNamespace(add=lambda span: None)),
        conditions=SimpleNamespace(must_look=False),
        mailbox=mailbox,
        must_flush=False,
        at=lambda local_s: local_s,
    )
    config: Any = SimpleNamespace(
        agents=SimpleNamespace(tick_hz=10.0),
        time=SimpleNamespace(duration_s=1.0),
        deadline=SimpleNamespace(overrun_ms=50.0, lateness_limit_s=0.05),
    )

    def prepare(t_s: float) -> bool:
        mailbox.due(t_s)
        return True

    calls: Any = TickCalls(
        prepare=prepare,
        step=lambda tick: stepped.append(tick.t_s),
        end_if_forked=lambda: None,
        failed=lambda error: None,
        ended=lambda: None,
        is_running=lambda: True,
        report_if_due=lambda now_s: None,
    )
    seat: Any = SimpleNamespace(calls=SimpleNamespace(page=[0.0] * 8), number=0)
    recorder: Any = SimpleNamespace(record=lambda stream, values: None)
    ticks = PacedTicks(seat, config, 0.0, port=port, recorder=recorder, calls=calls)
    ticks.begin(0.0)

    for number in range(4):
        now_s[0] = number / 10.0
        ticks.tick()
        if number == 0:
            ticks.hinder(AgentFault(1, HANG, True, math.inf))
        mailbox.send("b", number)

    assert stepped == [0.0]
    assert [each.sent_s for each in sent] == [0.0, 0.1, 0.2, 0.3]
