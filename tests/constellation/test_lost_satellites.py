"""A satellite that is lost for a while, and a text from the ground in a scenario without radio."""

import pytest
from constellation_fakes import Star, parameters, state_rows

from madns_runtime.plugin.api import TimelineAction
from madns_runtime.protocol.messages import Delivery
from madns_runtime.simulations.constellation.actions import (
    LOSE_SATELLITE,
    TELECOMMAND,
    Telecommand,
)
from madns_runtime.timeline.action import NoParameters

LISTENER = '''
class Listener:
    """Tells when it stepped and what it heard."""

    def setup(self, context):
        self.steps, self.heard = [], []

    def step(self, t_s, readings):
        self.steps.append(t_s)

    def receive(self, message):
        self.heard.append(f"{message.sender} {message.payload}")

    def finish(self):
        return {"steps": self.steps, "heard": self.heard}
'''


def action(kind, parameters, number=0):
    return TimelineAction(
        number=number,
        word=kind.word,
        agents=("agent-02",),
        parameters=parameters,
        t_s=10.0,
        for_s=None,
    )


LOSS = action(LOSE_SATELLITE, NoParameters())


@pytest.fixture
def star(tmp_path):
    (tmp_path / "listener.py").write_text(LISTENER)
    sensors = {"gnss": {"rate_hz": 1.0}, "accelerometer": {"rate_hz": 1.0}}
    params = parameters(flight="listener.py:Listener", vehicles=[{"sensors": sensors}])
    return Star(params, 3, base_directory=tmp_path, tick_hz=1.0)


def away(t_s):
    return 10.0 <= t_s < 20.0


def test_it_neither_flies_software_nor_measures_and_truth_goes_on(star):
    star.run(10.0)
    star.host.begin_action(LOSS)
    star.run(20.0, from_s=10.0)
    star.host.end_action(LOSS)
    star.run(30.0, from_s=20.0)

    summary = star.summaries()["agent-02"]
    assert not [t_s for t_s in summary["flight"]["steps"] if away(t_s)]
    assert {5.0, 25.0} <= set(summary["flight"]["steps"])
    measured_s = [row[1] for row in star.contexts["agent-02"].records["gnss"]]
    assert not [t_s for t_s in measured_s if away(t_s)]
    assert measured_s[-1] == 29.0
    assert summary["while_lost"] == {"ticks": 10, "messages": 0}
    assert len(state_rows(star, "agent-02")) == len(state_rows(star, "agent-01")) == 30
    assert "while_lost" not in star.summaries()["agent-01"]


def test_a_message_that_reaches_it_meanwhile_is_not_among_those_received(star):
    mailbox = star.contexts["agent-02"].mailbox
    star.run(10.0)
    mailbox.add(Delivery("agent-01", 9.5, 10.0, "before"))
    mailbox.add(Delivery("agent-01", 9.9, 12.0, "meanwhile"))
    star.run(11.0, from_s=10.0)
    star.host.begin_action(LOSS)
    star.run(15.0, from_s=11.0)
    summary = star.summaries()["agent-02"]

    assert summary["while_lost"]["messages"] == 1
    assert summary["flight"]["heard"] == ["agent-01 before"]
    assert summary["messages_received"] == 1


def test_two_losses_end_with_the_later_one_and_who_rejoins_is_told(star):
    star.run(10.0)
    star.host.begin_action(LOSS)
    star.host.begin_action(action(LOSE_SATELLITE, NoParameters(), number=1))
    star.run(12.0, from_s=10.0)
    star.host.end_action(LOSS)
    star.join("agent-02")
    star.host.agent_rejoined("agent-02")
    star.run(20.0, from_s=12.0)
    star.host.end_action(action(LOSE_SATELLITE, NoParameters(), number=1))
    star.run(22.0, from_s=20.0)

    assert star.summaries()["agent-02"]["flight"]["steps"] == [20.0, 21.0]


def test_who_is_lost_by_agent_or_satellite_has_no_slot(tmp_path):
    (tmp_path / "listener.py").write_text(LISTENER)
    flight = {"software": "listener.py:Listener", "settings": {"slots": "even"}}
    star = Star(
        parameters(flight=flight, record={"slots_hz": 1.0}), 3, base_directory=tmp_path, tick_hz=1.0
    )

    star.run(2.5)
    star.host.begin_action(LOSS)
    star.run(4.5, from_s=2.5)
    star.host.agent_lost("agent-02", "killed")
    star.host.end_action(LOSS)
    star.run(6.5, from_s=4.5)
    star.host.agent_rejoined("agent-02")
    star.run(8.5, from_s=6.5)

    assert [row[1] for row in star.context.records["slots"]] == [3, 3, 3, 2, 2, 2, 2, 3, 3]


def test_a_text_from_the_ground_comes_at_once_without_radio_and_is_recorded(star):
    star.run(10.0)
    star.host.begin_action(action(TELECOMMAND, Telecommand(text="report")))
    star.run(15.0, from_s=10.0)

    assert star.summaries()["agent-02"]["flight"]["heard"] == ["ground report"]
    ((_, way, peer, sent_s, *_),) = star.contexts["agent-02"].records["messages"]
    assert (way, peer, sent_s) == ("received", "ground", pytest.approx(10.0, abs=0.02))
