"""`cosmos plan` of shipped constellations: with maneuvers and without, with knots shorter and longer than what is urgent."""

import json
from pathlib import Path

import pytest

from cosmos_cli.app import main

SCENARIOS = Path(__file__).parents[3] / "scenarios"
REALTIME = ("--set", "time.mode=realtime")


def plan(capsys, name, *options):
    with pytest.raises(SystemExit) as ended:
        main(["plan", str(SCENARIOS / name), "--json", *options])
    return ended.value.code, json.loads(capsys.readouterr().out)


@pytest.mark.process
@pytest.mark.parametrize(
    ("name", "options", "applying"),
    [
        ("iridium10.yaml", (), ["2.7", "2.10"]),  # nothing is commanded: T_m - T_s is infinite
        ("ring93.yaml", REALTIME, ["2.7", "2.8", "2.9", "2.10"]),  # a knot every 10 s
    ],
)
def test_inequalities_of_a_constellation(name, options, applying, capsys):
    code, told = plan(capsys, name, *options)

    assert code == 0
    found = told["feasibility"]["inequalities"]
    assert [each["equation"] for each in found if each["applies"]] == applying


@pytest.mark.process
@pytest.mark.parametrize(("count", "agents"), [(1, "1 agent"), (3, "3 agents")])
def test_what_a_batch_takes_is_told_with_the_agents_that_it_was_timed_with(count, agents, capsys):
    with pytest.raises(SystemExit):
        main(["plan", str(SCENARIOS / "iridium10.yaml"), "--set", f"agents.count={count}"])

    assert f"measured here, T_p(S_b) with {agents} at once" in capsys.readouterr().out


@pytest.mark.process
def test_json_tells_the_demand_as_well(capsys):
    _, told = plan(capsys, "thesis/table_2_2_corrected.yaml")

    demand = told["demand"]
    assert (demand["batch_bytes"], demand["buffer_bytes"], demand["lead_s"]) == (4800, 100_000, 3)
    assert [(each["name"], each["wire_bytes"], each["within_s"]) for each in demand["flows"]] == [
        ("state updates", 5280, 5.0),
        ("system status", 4480, pytest.approx(1 / 0.07)),
        ("agent time updates", 320, 0.1),
        ("hardware interface", 860, 0.1),
        ("maneuvers", 5280, 3),
    ]
