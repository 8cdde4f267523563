"""The shipped scenario of ground passes, its first minutes: flight software, host and stations together."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from constellation_fakes import Star, carry

from cosmos_cli.models.document import read_document
from cosmos_cli.models.yaml_source import read_source
from madns_runtime.config import from_mapping
from madns_runtime.simulations.constellation.flight.loading import load_flight_class
from madns_runtime.simulations.constellation.parameters import (
    ConstellationParameters,
    Crosslinks,
)
from madns_runtime.simulations.constellation.truth.radio.channel import OUTCOMES

SCENARIO = Path(__file__).parents[2] / "scenarios/groundpass.yaml"
RISE_S = 525.525 - 480.0
"""Of IRIDIUM 5 over svalbard: tests/authorities/passes.json, whose epoch is 480 s earlier."""
UNTIL_S = 150.0


class TalkingStar(Star):
    """A star whose agents are heard by the host, a step after they spoke."""

    def _deliver(self, t_s):
        super()._deliver(t_s)
        for name, context in self.contexts.items():
            said, context.transmitted = context.transmitted, []
            for _, transmission in said:
                carry(self.host, self.context, name, transmission)


@pytest.fixture(scope="module")
def star():
    mapping = yaml.safe_load(SCENARIO.read_text())["parameters"]
    params = from_mapping(ConstellationParameters, mapping)
    star = TalkingStar(params, 10, duration_s=UNTIL_S, tick_hz=1.0)
    star.run(UNTIL_S, step_s=0.1)
    return star


def test_documented_settings_are_read_as_they_stand(tmp_path):
    block = (
        (SCENARIO.parents[1] / "docs/links.md").read_text().split("```yaml\n")[1].split("```")[0]
    )
    (tmp_path / "part.yaml").write_text(block)
    documented = read_document(read_source(tmp_path / "part.yaml")).value["parameters"]
    documented["satellites"] = {"elements": "data/iridium10.tle"}

    params = from_mapping(ConstellationParameters, documented)

    assert params.crosslinks == Crosslinks(loss=0.01)
    assert (params.stations[0].name, params.uplinks[0].to) == ("svalbard", "IRIDIUM 5")


def messages(star, agent, way):
    names = [field.name for field in star.contexts[agent].streams["messages"]]
    rows = [dict(zip(names, row, strict=True)) for row in star.contexts[agent].records["messages"]]
    return [row for row in rows if row["way"] == way]


def links(star, **wanted):
    names = [field.name for field in star.context.streams["links"]]
    rows = [dict(zip(names, row, strict=True)) for row in star.context.records["links"]]
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


def test_pass_begins_when_skyfield_says(star):
    ((event, agent, station, rise_s, *_),) = star.context.records["contacts"]

    assert (event, agent, station) == ("rise", "agent-04", "svalbard")
    assert rise_s == pytest.approx(RISE_S, abs=1e-3)


def test_order_goes_up_as_the_pass_begins_and_its_answer_comes_down(star):
    (order,) = links(star, sender="ground:svalbard")
    (heard,) = [
        row for row in messages(star, "agent-04", "received") if row["peer"] == "ground:svalbard"
    ]
    (answer,) = links(star, to="ground:svalbard", sent_s=46.0)

    assert order["sent_s"] == pytest.approx(RISE_S, abs=1e-3)
    # 7 bytes at 9600 bit/s and 2754 km.
    assert order["arrives_s"] - order["sent_s"] == pytest.approx(7 * 8 / 9600 + 9.19e-3, abs=1e-4)
    assert (heard["tick"], heard["arrives_s"]) == (46, order["arrives_s"])
    assert (answer["sender"], answer["outcome"]) == ("agent-04", "delivered")


def test_status_comes_down_within_the_pass_only(star):
    to_ground = [
        row for row in links(star) if row["to"].startswith("ground") and row["sent_s"] != 46.0
    ]

    assert len(to_ground) >= 20
    for row in to_ground:
        is_in_pass = row["sender"] == "agent-04" and row["sent_s"] > RISE_S
        assert row["outcome"] == ("delivered" if is_in_pass else "no_contact")


def test_beacons_reach_neighbours_and_nothing_is_unaccounted(star):
    summary = star.host.finish()
    vehicles = star.summaries()

    for part in ("links", "ground"):
        assert summary[part]["sent"] == sum(summary[part][name] for name in OUTCOMES)
    handed_over = summary["links"]["handed_over"] + summary["ground"]["handed_over"]
    assert handed_over == sum(
        vehicle[f"messages_{fate}"]
        for vehicle in vehicles.values()
        for fate in ("received", "held", "refused", "unheard")
    )
    assert sum(vehicle["flight"]["vehicles_heard"] for vehicle in vehicles.values()) > 20
    assert sum(vehicle["messages_late"] for vehicle in vehicles.values()) == 0


def test_a_beacon_that_was_away_makes_up_for_nothing():
    said, settings = [], {"status_s": 60, "beacon_s": 30}
    context = SimpleNamespace(settings=settings, index=1, agents=("a", "b"), satellite="B")
    context.send = context.broadcast = lambda *message: said.append(message)
    context.estimate = lambda values: None
    beacon = load_flight_class("flight/beacon.py:Beacon", SCENARIO.parent)()
    beacon.setup(context)

    for t_s in range(1000, 1120):
        beacon.step(float(t_s), {})

    to_ground = [message for message in said if message[0] == "ground"]
    assert (len(said) - len(to_ground), len(to_ground)) == (4, 2)


def test_who_spoke_to_nobody_is_told(star):
    for agent, summary in star.summaries().items():
        refused = links(star, sender=agent, outcome="no_contact")

        told = [row for row in star.contexts[agent].records["refusals"] if row[-1] == "no_contact"]
        # The last one may be on its way back yet.
        assert len(refused) - 1 <= len(told) == summary["sends_refused"]["no_contact"]
        numbers = {row["number"] for row in refused}
        assert numbers >= {number for _, number, *_ in told}
