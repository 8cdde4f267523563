"""The account of refused datagrams, and what of it is worth a remark."""

from cosmos_cli.evidence.datagrams import (
    FOREIGN_MAX,
    USUAL_MAX,
    datagram_account,
    datagram_remarks,
)


def result(refused, *, of_link=None, of_agent=None, has_agent=True):
    agent = {"received": 5, "refused": of_agent or {}} if has_agent else {}
    messages = {
        "host": {"refused": of_link or {}},
        "host_earlier": [{"refused": {"mac": 1}}],
        "agent": agent,
    }
    records = {"network": {"received": 9, "dropped_by_kernel": 2}}
    return {
        "network": {"received": 100, "dropped_by_kernel": 0},
        "refused": refused,
        "agents": {"agent-01": {"messages": messages, "records": records}},
    }


def test_both_ends_of_every_link_and_strangers_count():
    account = datagram_account(
        result({"session": 3, "mac": 0}, of_link={"mac": 4, "replay": 2}, of_agent={"mac": 7})
    )

    assert account == {
        "refused": 17,
        "host": {
            "received": 100,
            "dropped_by_kernel": 0,
            "refused": 10,
            "by_reason": {"session": 3, "mac": 5, "replay": 2},
        },
        "agents": {
            "agent-01": {
                "received": 9,
                "dropped_by_kernel": 2,
                "refused": 7,
                "by_reason": {"mac": 7},
            }
        },
    }


def test_of_an_agent_that_gave_no_word_nothing_is_known():
    assert datagram_account(result({}, has_agent=False))["agents"] == {"agent-01": None}


def test_where_no_datagram_travels_there_is_no_account():
    assert datagram_account({"network": {}, "refused": {}}) == {}
    assert datagram_account({}) == {}
    assert datagram_remarks({}) == ()


def test_a_remark_begins_where_chance_ends():
    few = datagram_account(result({"mac": FOREIGN_MAX - 1, "replay": USUAL_MAX}))
    foreign = datagram_account(result({"mac": FOREIGN_MAX, "short": 2}))
    usual = datagram_account(result({"replay": USUAL_MAX + 1}))

    assert datagram_remarks(few) == ()
    (remark,) = datagram_remarks(foreign)
    assert remark.startswith("host: 13 datagrams refused (wrong seal 11, too short 2); something")
    assert len(datagram_remarks(usual)) == 1
