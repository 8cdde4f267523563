"""Messages between agents that were delivered and dropped become a remark of the verdict."""

import pytest
from harness.synthetic_run import SyntheticRun

from cosmos_cli.collect.finish import finish_run
from cosmos_cli.evidence.remarks import mailbox_remarks
from madns_runtime.medium.mailbox import HELD_MAX, Mailbox
from madns_runtime.medium.outcomes import between_agents
from madns_runtime.protocol.messages import Delivery


def account_of(messages):
    """Return a run's account of so many messages that one agent is sent a second ahead."""
    box = Mailbox("a", ("a", "b"), has_medium=True, post=lambda message: None)
    for _ in range(messages):
        box.add(Delivery("b", 0.0, 1.0, None))
    return between_agents({"delivered": messages}, [box.counts()])


def test_what_found_no_room_is_told_and_the_verdict_stays_what_it_is(tmp_path):
    made = SyntheticRun(tmp_path).write()
    result = made.result() | {"between_agents": account_of(HELD_MAX + 3)}

    summary = finish_run(made.run, result, made.expected)

    assert summary.exit_code == 0, summary.verdict.text
    (remark,) = summary.document["remarks"]
    assert remark.startswith("between agents: 3 messages found no room at their receivers")


def test_what_an_agent_that_was_there_took_no_more_of_is_told(tmp_path):
    made = SyntheticRun(tmp_path).write()
    account = account_of(5) | {"undelivered": 29, "unqueued": 29}

    summary = finish_run(made.run, made.result() | {"between_agents": account}, made.expected)

    (remark,) = summary.document["remarks"]
    assert remark.startswith(
        "between agents: the queues to their receivers had no room for 29 messages"
    )


@pytest.mark.parametrize(
    "account",
    [
        account_of(HELD_MAX),
        {},
        {"receivers": {"no_room": "x"}, "unqueued": None},
        {"undelivered": 3},
    ],
)
def test_of_what_was_held_nothing_is_said(account):
    assert mailbox_remarks(account) == ()
