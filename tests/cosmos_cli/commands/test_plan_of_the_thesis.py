"""The thesis's tables 2.2, 2.3 and equations 2.11-2.14, each by one command, as docs/plan.md sets them beside ours."""

import json
from pathlib import Path

import pytest

from cosmos_cli.app import main
from cosmos_cli.launch.feasibility import judge
from cosmos_cli.launch.plan import make_plan
from cosmos_cli.launch.plan_view import demand_of, resources_of
from cosmos_cli.models.loading import load_scenario

SCENARIOS = Path(__file__).parents[3] / "scenarios"
PRINTED, CORRECTED = "thesis/table_2_2.yaml", "thesis/table_2_2_corrected.yaml"


def inequalities(name, *overrides, latency_s=0.001):
    file = load_scenario(SCENARIOS / name, overrides)
    agents = file.scenario.agents
    resources = resources_of(file, make_plan(file.scenario), latency_s)
    found = judge(demand_of(file), resources, agents=agents.count, tick_hz=agents.tick_hz)
    return {item.number: item for item in found.inequalities}


def sides(item):
    return pytest.approx(item.left, rel=2e-3), item.relation, item.right


def test_as_printed_but_for_what_it_forgot():
    found = inequalities(PRINTED)

    assert sides(found["2.7"]) == (0.401, "<=", 10)
    assert sides(found["2.9"]) == (3, ">=", 0.1)
    assert sides(found["2.10"]) == (8.174e5, "<=", 1e9)
    assert [found[n].breaks_at for n in ("2.7", "2.8", "2.10")] == [250, 75, 12_234]
    # 240 besides the ten that fly; and 71 if the way there and back counts for each agent.
    assert found["2.7"].margin // 0.04 + 1 == 240
    assert 3 // 0.042 == 71


def test_one_maneuver_a_tick_ahead():
    found = inequalities(PRINTED, "plan.lead_s=0.1", "plan.maneuvers_at_once=1")

    assert sides(found["2.8"]) == (0.042, "<=", 0.1)


def test_without_the_slips():
    found = inequalities(CORRECTED)

    assert sides(found["2.8"]) == (0.402, "<=", 3)
    assert sides(found["2.10"]) == (1.845e5, "<=", 1.25e8)
    assert [found[n].breaks_at for n in ("2.7", "2.8", "2.10")] == [250, 75, 6_776]
    # Its own bytes, over a gigabit as it is.
    assert inequalities(PRINTED, "plan.bandwidth_mbit=1000")["2.10"].breaks_at == 1_530


def test_1000_agents_with_45_s_and_five_workers():
    found = inequalities(CORRECTED, "agents.count=1000", "plan.lead_s=45", "plan.workers=5")

    assert all(item.holds for item in found.values())
    assert sides(found["2.7"]) == (8.001, "<=", 10)
    assert found["2.7"].breaks_at == 1250


def test_agents_whose_workers_cannot_follow_are_not_said_to_keep_real_time(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["plan", str(SCENARIOS / CORRECTED), "--set", "agents.count=70"])

    # A batch of 0.04 s in 10 s and a maneuver of 0.04 s each second: 22 agents take 0.968 of the one worker.
    *_, last = capsys.readouterr().out.splitlines()
    assert ended.value.code == 0
    assert last.startswith(
        "70 agents may not keep real time: the inequalities hold, but up to 22 are predicted, by host's workers"
    )


@pytest.mark.parametrize(("buffer_bytes", "is_warned"), [(48, True), (4799, True), (4800, False)])
def test_a_buffer_that_holds_no_batch_is_warned_of(buffer_bytes, is_warned, capsys):
    with pytest.raises(SystemExit):
        main(["plan", str(SCENARIOS / CORRECTED), "--set", f"plan.buffer_bytes={buffer_bytes}"])

    err = capsys.readouterr().err
    assert ("does not hold a batch of 4,800 B (S_b)" in err) == is_warned


@pytest.mark.process
def test_1000_satellites_of_starlink_keep_real_time(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["plan", str(SCENARIOS / "starlink1000.yaml"), "--json", "--latency-ms", "0.5"])

    code = ended.value.code
    told = json.loads(capsys.readouterr().out)
    assert (code, told["feasibility"]["holds"], told["feasibility"]["agents"]) == (0, True, 1000)
    assert told["resources"]["workers"] == 5
    assert told["feasibility"]["inequalities"][2]["left"] == 45.0
    names = {each["name"] for each in told["capacity"]["limits"]}
    assert {"host's loop", "host's workers", "process of agents", "inequality 2.8"} <= names
