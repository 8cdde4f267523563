import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosmos_cli.errors import Fault, InputError
from cosmos_cli.fleet.target import Target, target_of
from cosmos_cli.launch.capacity_view import computers_of
from cosmos_cli.launch.plan import make_plan
from cosmos_cli.models.inventory import Machine, Variables, load_machines
from cosmos_cli.models.scenario import Scenario


def scenario(count, per_process=1, placement=()):
    return Scenario.model_validate(
        {
            "name": "s",
            "simulation": "counter",
            "agents": {"count": count, "per_process": per_process},
            "placement": placement,
        }
    )


def machines(count, **variables):
    return [
        Machine(name=f"pi{i:02d}", address=f"10.0.0.{i}", variables=Variables.of(variables))
        for i in range(count)
    ]


def board(name, *groups, **variables):
    return Machine(
        name=name, address=name, groups=("all", *groups), variables=Variables.of(variables)
    )


TOWER = [
    board("pi01", "tower"),
    board("pi02", "tower", "hwil", cosmos_devices=["sense_hat"]),
    board("pi03", "tower"),
    board("pi04", "tower", "hwil", cosmos_devices=["sense_hat", "camera"], cosmos_agents=1),
    board("desk", "lab", cosmos_agents=0),
]


def placed(count, *rules, boards=TOWER, **options):
    """Return the numbers of the agents on each machine."""
    plan = make_plan(scenario(count, placement=rules), boards, **options)
    return {
        name: [int(agent.removeprefix("agent-")) for agent in agents]
        for name, agents in plan.agents_by_machine.items()
    }


def faults_of(count, *rules, boards=TOWER, **options):
    with pytest.raises(InputError) as caught:
        make_plan(scenario(count, placement=rules), boards, **options)
    return [(fault.path, fault.text) for fault in caught.value.faults]


def test_without_machines_all_agents_run_on_loopback():
    plan = make_plan(scenario(3))

    assert not plan.elsewhere
    assert plan.agents_by_machine == {"loopback": ("agent-01", "agent-02", "agent-03")}
    assert plan.machines[0].machine.address == "127.0.0.1"


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
    assert plan.elsewhere


def test_no_machine_is_refused():
    with pytest.raises(InputError, match="at least one machine"):
        make_plan(scenario(1), [])


def test_rule_deals_its_agents_in_blocks_over_the_machines_of_a_group():
    assert placed(5, {"machines": "hwil[0],pi03"}) == {"pi02": [1, 2, 3], "pi03": [4, 5]}


def test_rest_goes_where_the_load_is_least():
    assert placed(4, {"agents": ["agent-03"], "machines": "pi01"}) == {
        "pi01": [3],
        "pi02": [1],
        "pi03": [2],
        "pi04": [4],
    }


def test_rest_makes_up_for_what_rules_have_dealt_unevenly():
    rule = {"count": 4, "machines": "pi00"}

    assert placed(10, rule, boards=machines(2)) == {
        "pi00": [1, 2, 3, 4, 5],
        "pi01": [6, 7, 8, 9, 10],
    }


def test_rules_take_agents_by_name_by_glob_by_count_and_the_rest_in_turn():
    rules = [
        {"agents": ["agent-04", "agent-0[12]"], "machines": "pi01"},
        {"count": 1, "machines": "pi02"},
        {"machines": "pi03"},
    ]

    assert placed(6, *rules) == {"pi01": [1, 2, 4], "pi02": [3], "pi03": [5, 6]}


def test_rule_with_devices_takes_machines_that_have_them_all():
    assert placed(1, {"count": 1, "devices": ["camera", "sense_hat"]}) == {"pi04": [1]}
    assert placed(3, {"count": 3, "devices": ["sense_hat"]}) == {"pi02": [1, 2], "pi04": [3]}


def test_machine_takes_no_more_agents_than_its_inventory_allows():
    assert placed(9) == {"pi01": [1, 2, 3], "pi02": [4, 5, 6], "pi03": [7, 8], "pi04": [9]}


def computers(count, *rules, boards=TOWER, host=None):
    """Return the names of the computers whose capacity is predicted, with `+` where they run agents."""
    plan = make_plan(scenario(count, placement=rules), boards, host=host)
    return [each.name + "+" * each.has_agents for each in computers_of(plan)]


def test_capacity_is_that_of_all_machines_on_which_more_agents_would_run():
    assert computers(1) == ["pi01+", "pi02+", "pi03+", "pi04+", "this computer"]
    assert computers(1, host="pi02") == ["pi01+", "pi03+", "pi04+", "pi02"]
    rest_is_on_one = {"machines": "pi02"}
    assert computers(3, rest_is_on_one) == ["pi02+", "this computer"]
    assert computers(1, {"count": 1, "machines": "pi02"})[1:] == [
        "pi01+",
        "pi03+",
        "pi04+",
        "this computer",
    ]


def test_machines_of_one_address_are_one_computer_of_the_capacity():
    one = machines(1) + [
        Machine(name="twin", address="10.0.0.0", variables=Variables.of({"cosmos_root": "~/twin"}))
    ]

    assert computers(4, boards=one) == ["pi00+", "this computer"]


def test_machine_that_takes_no_agents_is_not_called_idle():
    assert make_plan(scenario(2), TOWER).idle == ("pi03", "pi04")


def test_rule_bounds_its_own_agents_on_a_machine():
    rules = [{"count": 2, "machines": "pi01,pi03", "per_machine": 1}, {"machines": "pi01"}]

    assert placed(4, *rules) == {"pi01": [1, 3, 4], "pi03": [2]}


def test_processes_hold_the_agents_of_a_machine_in_order():
    rules = [{"agents": ["agent-05", "agent-02"], "machines": "pi01"}, {"machines": "pi01"}]

    plan = make_plan(scenario(5, per_process=2, placement=rules), TOWER)

    assert plan.machines[0].processes == (
        ("agent-01", "agent-02"),
        ("agent-03", "agent-04"),
        ("agent-05",),
    )


def test_machine_of_the_host_is_spared_unless_a_rule_asks_for_it():
    assert placed(2, host="pi01") == {"pi02": [1], "pi03": [2]}
    assert placed(2, {"count": 1}, host="pi01") == {"pi02": [1], "pi03": [2]}
    assert placed(2, {"count": 1, "machines": "pi01"}, host="pi01") == {"pi01": [1], "pi02": [2]}
    assert placed(1, boards=TOWER[:1], host="pi01") == {"pi01": [1]}


def test_plan_names_the_host_and_how_to_reach_it():
    plan = make_plan(scenario(1), TOWER, host="pi01")

    assert plan.host is TOWER[0]
    assert plan.to_mapping()["host"]["name"] == "pi01"
    assert plan.to_mapping()["host"]["target"]["address"] == "pi01"
    assert plan.idle == ("pi03", "pi04")
    assert make_plan(scenario(1), TOWER).to_mapping()["host"] is None


def test_unknown_host_is_refused():
    with pytest.raises(InputError, match="host: no machine is named pi05, did you mean pi04"):
        make_plan(scenario(1), TOWER, host="pi05")


def test_local_machines_with_a_remote_host_are_not_local():
    here = Machine(name="here", address="127.0.0.1", connection="local")

    assert not make_plan(scenario(1), [here]).elsewhere
    assert make_plan(scenario(1), [here, board("pi01")], host="pi01").elsewhere


def twin(name, **variables):
    values = {"ansible_user": "pi"} | variables
    return Machine(name=name, address="10.0.0.1", variables=Variables.of(values))


def test_machines_that_would_record_in_one_folder_are_refused():
    with pytest.raises(InputError, match="pi01 and pi02 are one machine, 10.0.0.1"):
        placed(2, boards=[twin("pi01"), twin("pi02")])
    with pytest.raises(InputError, match="pi01 and pi02 are one machine"):
        placed(1, boards=[twin("pi01"), twin("pi02")], host="pi02")


@pytest.mark.parametrize(
    "other", [{"ansible_user": "you"}, {"ansible_port": 2222}, {"cosmos_root": "~/b"}]
)
def test_machines_at_one_address_may_differ_in_what_tells_their_folders_apart(other):
    assert len(placed(2, boards=[twin("pi01"), twin("pi02", **other)])) == 2


def test_twin_that_takes_no_part_is_nobodys_business():
    boards = [twin("pi01"), twin("pi02", cosmos_agents=0)]

    assert placed(2, boards=boards) == {"pi01": [1, 2]}


@pytest.fixture
def inventory(tmp_path):
    file = tmp_path / "tower.yaml"
    hosts = "tower: {hosts: {pi01: {}, pi02: {}, pi03: {}}}, hwil: {hosts: {pi03: {}}}, spare: {}"
    file.write_text(f"all: {{children: {{{hosts}}}}}\n")
    return file


@pytest.mark.parametrize("pattern", ["tower:!hwil", "tower:!pi03", "tower:!spare", "tower,spare"])
def test_rule_may_name_what_limit_leaves_out_and_groups_without_machines(inventory, pattern):
    left = load_machines(str(inventory), "!pi03")

    assert placed(2, {"machines": pattern}, boards=left) == {"pi01": [1], "pi02": [2]}


def test_rule_that_means_only_what_limit_leaves_out_is_a_fault(inventory):
    left = load_machines(str(inventory), "!pi03")

    fault = "placement[0].machines", "means no machine; there are pi01, pi02"
    assert faults_of(1, {"machines": "hwil"}, boards=left) == [fault]
    told = faults_of(1, {"machines": "pi04"}, boards=left)
    assert "no machine or group is named pi04" in told[0][1]


@pytest.mark.parametrize(
    ("rules", "expected"),
    [
        (
            [{"machines": "twer"}],
            [("placement[0].machines", "no machine or group is named twer, did you mean tower?")],
        ),
        (
            [{"count": 1, "devices": ["lidar"]}],
            [
                (
                    "placement[0].devices",
                    "none of pi01, pi02, pi03, pi04, desk has lidar (devices there: camera, sense_hat);"
                    " name it in cosmos_devices of the machine that has it",
                )
            ],
        ),
        (
            [{"devices": ["camera"]}],
            [
                (
                    "placement[0]",
                    "room for 1 of 3 agents on pi04: add machines, raise cosmos_agents in the inventory"
                    " or per_machine in the scenario, or lower agents.count",
                )
            ],
        ),
        (
            [{"count": 1, "machines": "x"}, {"machines": "desk"}],
            [
                (
                    "placement[0].machines",
                    "no machine or group is named x; there are all, tower, hwil, lab, pi01, pi02, pi03,"
                    " pi04, desk",
                ),
                (
                    "placement[1]",
                    "room for 0 of 2 agents on desk: add machines, raise cosmos_agents in the inventory"
                    " or per_machine in the scenario, or lower agents.count",
                ),
            ],
        ),
        (
            [{"agents": ["agent-9"]}, {"count": 4}],
            [
                ("placement[0].agents[0]", "no agent is named agent-9, did you mean agent-03?"),
                (
                    "placement[1].count",
                    "expected <= 3, the agents that no earlier rule takes, got 4",
                ),
            ],
        ),
    ],
)
def test_rules_that_cannot_be_kept_are_refused_all_at_once(rules, expected):
    assert faults_of(3, *rules) == expected


def test_agents_without_room_are_refused():
    ((path, text),) = faults_of(9, boards=machines(2, cosmos_agents=4))

    assert path == "agents.count"
    assert text.startswith("room for 8 of 9 agents on pi00, pi01: ")


def test_faults_are_told_at_their_place_in_the_scenario():
    def fault_at(path, text):
        return Fault(text=text, file="s.yaml", line=3, column=len(path))

    with pytest.raises(InputError) as caught:
        make_plan(scenario(1, placement=[{"machines": "x"}]), TOWER, fault_at=fault_at)

    assert (caught.value.faults[0].line, caught.value.faults[0].column) == (3, 3)


def test_without_an_inventory_machines_are_left_out_of_account_and_a_note_says_so():
    rules = [{"count": 2, "machines": "tower", "per_machine": 1}, {"per_machine": 1}]

    plan = make_plan(scenario(5, placement=rules))

    assert plan.agents_by_machine["loopback"] == tuple(f"agent-0{i}" for i in range(1, 6))
    assert plan.notes == (
        "placement[0]: machines: tower, per_machine: 1 is left out of account:"
        " without an inventory all agents run on this computer",
        "placement[1]: per_machine: 1 is left out of account:"
        " without an inventory all agents run on this computer",
    )
    assert plan.to_mapping()["notes"] == list(plan.notes)


def test_without_an_inventory_devices_are_missed():
    with pytest.raises(InputError) as caught:
        make_plan(scenario(1, placement=[{"devices": ["sense_hat"]}]))

    (fault,) = caught.value.faults
    assert fault.path == "placement[0].devices"
    assert fault.text == "no inventory, so no machine with sense_hat: give one with -i"


@given(
    agents=st.integers(1, 60),
    bounds=st.lists(st.none() | st.integers(0, 9), min_size=1, max_size=12),
    first=st.integers(1, 20),
    per_machine=st.none() | st.integers(1, 4),
)
def test_bounds_hold_and_loads_are_as_even_as_they_allow(agents, bounds, first, per_machine):
    boards = [board(f"m{i}", cosmos_agents=bound) for i, bound in enumerate(bounds)]
    rules = [{"count": min(first, agents), "per_machine": per_machine}]
    try:
        plan = make_plan(scenario(agents, placement=rules), boards)
    except InputError:
        room = [bound for bound in bounds if bound is not None]
        own = [min(x for x in (b, per_machine) if x is not None) for b in bounds
               if b is not None or per_machine is not None]  # fmt: skip
        too_small = len(room) == len(bounds) and sum(room) < agents
        assert too_small or (len(own) == len(bounds) and sum(own) < rules[0]["count"])
        return

    loads = {b.name: len(plan.agents_by_machine.get(b.name, ())) for b in boards}
    most = {b.name: b.variables.cosmos_agents for b in boards}
    open_loads = [load for name, load in loads.items() if most[name] is None or load < most[name]]
    assert sum(loads.values()) == agents
    assert all(most[name] is None or load <= most[name] for name, load in loads.items())
    if per_machine is None and open_loads:
        assert max(loads.values()) - min(open_loads) <= 1


@given(agents=st.integers(1, 300), boards=st.integers(1, 60), per_process=st.integers(1, 9))
def test_every_agent_is_placed_once_and_loads_are_even(agents, boards, per_process):
    plan = make_plan(scenario(agents, per_process), machines(boards))

    placed = [name for machine in plan.machines for name in machine.agents]
    loads = [len(machine.agents) for machine in plan.machines]
    assert placed == list(scenario(agents).agents.resolved_names())
    assert max(loads) - min(loads) <= 1
    assert len(plan.machines) + len(plan.idle) == boards
    assert all(len(p) <= per_process for machine in plan.machines for p in machine.processes)


def test_mapping_tells_how_to_reach_a_machine_without_the_inventory():
    machine = board(
        "pi01", "tower", ansible_user="pi", ansible_port=22, cosmos_devices=["sense_hat"]
    )

    mapping = make_plan(scenario(1), [machine]).to_mapping()["machines"]["pi01"]

    assert Target.from_mapping(mapping["target"]) == target_of(machine)
    assert (mapping["groups"], mapping["devices"]) == (["all", "tower"], ["sense_hat"])
    assert (mapping["target"]["user"], mapping["target"]["port"]) == ("pi", 22)


def test_mapping_is_plain_json():
    mapping = make_plan(scenario(3, 2)).to_mapping()

    assert json.loads(json.dumps(mapping)) == mapping
    assert mapping["machines"]["loopback"]["processes"] == [["agent-01", "agent-02"], ["agent-03"]]
