import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosmos_cli.errors import InputError
from cosmos_cli.models.inventory import Machine
from cosmos_cli.models.scenario import Scenario
from cosmos_cli.plan import make_plan


def scenario(count, per_process=1):
    return Scenario.model_validate(
        {
            "name": "s",
            "simulation": "counter",
            "agents": {"count": count, "per_process": per_process},
        }
    )


def machines(count):
    return [Machine(name=f"pi{i:02d}", address=f"10.0.0.{i}") for i in range(count)]


def test_without_machines_all_agents_run_on_loopback():
    plan = make_plan(scenario(3))

    assert plan.is_local
    assert plan.agents_by_machine == {"loopback": ("agent-01", "agent-02", "agent-03")}
    assert plan.machines[0].address == "127.0.0.1"


def test_agents_fill_processes_in_order():
    plan = make_plan(scenario(5, per_process=2))

    assert plan.machines[0].processes == (
        ("agent-01", "agent-02"),
        ("agent-03", "agent-04"),
        ("agent-05",),
    )


def test_machines_without_an_agent_are_named():
    plan = make_plan(scenario(2), machines(3))

    assert [machine.name for machine in plan.machines] == ["pi00", "pi01"]
    assert plan.idle == ("pi02",)
    assert not plan.is_local


def test_no_machine_is_refused():
    with pytest.raises(InputError, match="at least one machine"):
        make_plan(scenario(1), [])


@given(agents=st.integers(1, 300), boards=st.integers(1, 60), per_process=st.integers(1, 9))
def test_every_agent_is_placed_once_and_loads_are_even(agents, boards, per_process):
    plan = make_plan(scenario(agents, per_process), machines(boards))

    placed = [name for machine in plan.machines for name in machine.agents]
    loads = [len(machine.agents) for machine in plan.machines]
    assert placed == list(scenario(agents).agents.resolved_names())
    assert max(loads) - min(loads) <= 1
    assert len(plan.machines) + len(plan.idle) == boards
    assert all(len(p) <= per_process for machine in plan.machines for p in machine.processes)


def test_mapping_is_plain_json():
    mapping = make_plan(scenario(3, 2)).to_mapping()

    assert json.loads(json.dumps(mapping)) == mapping
    assert mapping["machines"]["loopback"]["processes"] == [["agent-01", "agent-02"], ["agent-03"]]
