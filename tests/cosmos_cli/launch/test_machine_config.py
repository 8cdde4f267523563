"""Where a run's parts live, and by which address each machine reaches the host."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.launch.events import Listening
from cosmos_cli.launch.machines import expanded
from cosmos_cli.launch.plan import LaunchPlan, MachinePlan
from cosmos_cli.launch.preparation import (
    host_config,
    inventory_text,
    listening_config,
    places_of,
    plan_mapping,
    with_address,
)
from cosmos_cli.launch.request import (
    SYNC_INTERVAL_S,
    LaunchRequest,
    MachineConfig,
    SupervisorStart,
    config_at,
)
from cosmos_cli.launch.restarts import Restarts
from cosmos_cli.models.inventory import Machine, Variables
from madns_runtime.config import Agents, Network, Recording, RunConfig
from madns_runtime.timing.pack_split import packs_on_machine
from madns_runtime.timing.rate import staggered

CONFIG = RunConfig(
    run="0007-x", scenario="x", simulation="counter", base_directory="/here", agents=Agents(count=4)
)
SESSION = "0123456789abcdef"
RUN = RunDirectory(Path("/runs/0007-x"))


def machine(name: str, connection: str = "ssh", **variables: Any) -> Machine:
    known = {key: value for key, value in variables.items() if key != "cosmos_provision"}
    return Machine(
        name=name,
        address=name,
        connection=connection,  # type: ignore[arg-type]
        variables=Variables.of(known),
        raw_variables=variables,
    )


def remote(name: str) -> Any:
    """Stand for a machine that is logged in at."""
    return SimpleNamespace(
        name=name,
        connection=SimpleNamespace(own_address="10.0.0.1", peer_address=f"10.0.0.{name[-1]}"),
        paths=SimpleNamespace(base_directory=f"/home/pi/trees/{name}", driver_directory=""),
        directory_of=lambda run, session: f"/home/pi/runs/{run}-{session[:8]}",
    )


def plan(*machines: Machine, host: Machine | None = None) -> LaunchPlan:
    names = CONFIG.agents.resolved_names()
    planned = tuple(
        MachinePlan(machine=machine, processes=((names[index],),))
        for index, machine in enumerate(machines)
    )
    return LaunchPlan(scenario="x", machines=planned, host=host)


def addresses(plan: LaunchPlan, config: RunConfig = CONFIG) -> dict[str, str | None]:
    names = [planned.name for planned in plan.machines] + ([plan.host.name] if plan.host else [])
    there = {name: remote(name) for name in names if name.startswith("pi")}
    places = places_of(plan, there, config, run=RUN, session_hex=SESSION)
    return {name: place.host_address for name, place in places.items()}


HOST_PEER = "fe80::b%enp3s0"


@pytest.mark.parametrize(
    ("name", "own", "peer", "expected"),
    [
        ("pi2", "fe80::a%eth0", "fe80::c%enp3s0", "fe80::b%eth0"),
        ("pi2", "fe80::a%eth0", "fe80::c%enp4s0", None),
        ("pi2", "fe80::a", "fe80::c%enp3s0", None),
        ("pi2", "10.0.0.1", "10.0.0.2", None),
        ("laptop", "", "", HOST_PEER),
        ("pi1", "fe80::a%eth0", HOST_PEER, "127.0.0.1"),
    ],
)
def test_link_local_address_of_a_host_is_named_by_each_machines_own_interface(
    name: str, own: str, peer: str, expected: str | None
) -> None:
    there = {each: remote(each) for each in ("pi1", "pi2")}
    there["pi1"].connection = SimpleNamespace(own_address="fe80::a%eth0", peer_address=HOST_PEER)
    there["pi2"].connection = SimpleNamespace(own_address=own, peer_address=peer)
    planned = plan(machine(name, "local" if name == "laptop" else "ssh"), host=machine("pi1"))

    if expected is None:
        with pytest.raises(
            InputError, match="pi1, which runs the host, .*set cosmos_host_address of pi2"
        ):
            places_of(planned, there, CONFIG, run=RUN, session_hex=SESSION)
        return
    places = places_of(planned, there, CONFIG, run=RUN, session_hex=SESSION)

    assert places[name].host_address == expected


def test_run_on_this_computer_alone_is_told_nothing_special() -> None:
    local = plan(machine("loopback", "local"))
    places = places_of(local, {}, CONFIG, run=RUN, session_hex=SESSION)

    assert places == {"loopback": MachineConfig(directory="/runs/0007-x")}
    assert host_config(CONFIG, places) is CONFIG


def test_host_here_is_reached_by_the_address_that_each_connection_shows() -> None:
    mixed = plan(machine("pi2"), machine("here", "local"))

    assert addresses(mixed) == {"pi2": "10.0.0.1", "here": "127.0.0.1"}


def test_host_on_a_machine_is_reached_by_its_address_and_there_by_loopback() -> None:
    host = machine("pi3")
    mixed = plan(machine("pi2"), machine("here", "local"), host, host=host)

    assert addresses(mixed) == {"pi2": "10.0.0.3", "here": "10.0.0.3", "pi3": "127.0.0.1"}


def test_inventory_and_scenario_may_name_the_address() -> None:
    named = plan(machine("pi2", cosmos_host_address="192.0.2.9"), machine("pi4"))
    config = dataclasses.replace(CONFIG, network=Network(address="10.9.9.9"))

    assert addresses(named) == {"pi2": "192.0.2.9", "pi4": "10.0.0.1"}
    assert addresses(named, config) == {"pi2": "192.0.2.9", "pi4": "10.9.9.9"}


def test_machine_behind_a_proxy_command_fails_before_the_run_unless_an_address_is_named() -> None:
    closed: list[str] = []

    def connect(target: Any, options: Any) -> Any:
        return SimpleNamespace(own_address="", close=lambda: closed.append(target.name))

    host = machine("pi3")
    behind, named = machine("pi2"), machine("pi4", cosmos_host_address="192.0.2.9")
    both = plan(behind, named)
    config = dataclasses.replace(CONFIG, network=Network(address="10.9.9.9"))
    options: Any = None
    at_pi2: Any = SimpleNamespace(name="pi2")
    at_pi4: Any = SimpleNamespace(name="pi4")

    with pytest.raises(MachineFailure, match="cosmos_host_address") as caught:
        with_address(connect, both, CONFIG)(at_pi2, options)
    assert (caught.value.kind, closed) == (FailureKind.UNSUPPORTED, ["pi2"])
    with_address(connect, both, CONFIG)(at_pi4, options)
    with_address(connect, both, config)(at_pi2, options)
    with_address(connect, plan(behind, host, host=host), CONFIG)(at_pi2, options)
    assert closed == ["pi2"]


@pytest.mark.parametrize(
    ("said", "reached_by", "bound"),
    [
        ("127.0.0.1", ["10.0.0.1"], "0.0.0.0"),
        ("localhost", ["10.0.0.1"], "0.0.0.0"),
        ("0.0.0.0", ["10.0.0.1"], "0.0.0.0"),
        ("127.0.0.1", ["10.0.0.1", "fd00::1"], "::"),
        ("10.0.0.1", ["10.0.0.1"], "10.0.0.1"),
        ("tower.example", ["10.0.0.1"], "tower.example"),
    ],
)
def test_host_listens_where_machines_reach_it_unless_the_scenario_says_where(
    said: str, reached_by: list[str], bound: str
) -> None:
    config = dataclasses.replace(CONFIG, network=Network(address=said))

    assert listening_config(config, reached_by).network.address == bound


def test_machine_is_told_its_own_folder_and_processors() -> None:
    place = MachineConfig(directory="/d", base_directory="/there", cpu_affinity=(3,))

    config = config_at(CONFIG, place)

    assert (config.base_directory, config.scheduling.cpu_affinity) == ("/there", (3,))
    assert config_at(CONFIG, MachineConfig(directory="/d")) == CONFIG


def test_launch_lines_speak_of_the_machines_own_places() -> None:
    request = LaunchRequest(
        config=CONFIG,
        directory=Path("/runs/0007-x"),
        machines={"pi2": ("agent-01",)},
        places={"pi2": MachineConfig(directory="/d", host_address="10.0.0.1")},
        host_machine="pi2",
        is_detached=True,
        session_hex=SESSION,
    )
    listening: Any = SimpleNamespace(address="0.0.0.0", port=4711)

    launch = request.agent_launch(
        "pi2",
        ("agent-01",),
        listening,
        SupervisorStart(
            incarnation=2, first_incarnations={"agent-01": 3}, killed_before={"agent-01": 1}
        ),
    )

    assert (launch["host_address"], launch["host_port"]) == ("10.0.0.1", 4711)
    assert (launch["directory"], launch["is_detached"]) == ("/d", True)
    assert (launch["life"], launch["first_incarnations"]) == (2, {"agent-01": 3})
    assert launch["killed_before"] == {"agent-01": 1}
    assert request.host_launch()["directory"] == "/d/host"
    assert request.run_key_hex not in repr(request)


def test_plan_tells_where_every_part_of_the_run_lies() -> None:
    host = machine("pi3")
    mixed = plan(machine("pi2"), machine("here", "local"), host=host)
    there = {"pi2": remote("pi2"), "pi3": remote("pi3")}
    places = places_of(mixed, there, CONFIG, run=RUN, session_hex=SESSION)

    mapping = plan_mapping(mixed, places, SESSION, is_detached=False)

    directory = "/home/pi/runs/0007-x-01234567"
    assert mapping["machines"]["pi2"]["directory"] == directory
    assert mapping["host"]["directory"] == directory
    assert "directory" not in mapping["machines"]["here"]
    assert mapping["session"] == SESSION


def test_kept_inventory_holds_no_content_of_files_and_no_foreign_variables() -> None:
    variables = {"ansible_user": "pi", "cosmos_provision": [{"content": "psk"}], "wifi": "psk"}

    text = inventory_text(plan(machine("pi2", **variables)))

    assert "ansible_user: pi" in text
    assert "psk" not in text


@pytest.mark.parametrize(
    ("path", "expected"),
    [("~/cosmos", "/home/pi/cosmos"), ("~", "/home/pi"), ("/opt/c", "/opt/c"), ("~x/c", "~x/c")],
)
def test_home_is_resolved_as_a_shell_would(path: str, expected: str) -> None:
    assert expanded(path, "/home/pi/") == expected


# The roll of agents -------------------------------------------------------------------------------


def roll(
    restarts_max: int, *, on_agent_loss: str = "continue", manual: tuple[str, ...] = ()
) -> Restarts:
    agents = Agents(count=4, restarts_max=restarts_max)
    config = dataclasses.replace(CONFIG, agents=agents, on_agent_loss=on_agent_loss)  # type: ignore[arg-type]
    names = agents.resolved_names()
    machines = {"pi2": names[:3], "pi3": names[3:]}
    return Restarts(
        LaunchRequest(config=config, directory=Path("/d"), machines=machines, manual=manual)
    )


def test_agents_that_were_cut_off_may_start_again_as_often_as_allowed() -> None:
    made = roll(2)
    made.started("agent-01", 1)
    made.started("agent-02", 3)
    made.exited("agent-03", is_abnormal=False)

    assert made.restartable_on("pi2") == ("agent-01",)
    assert made.left_on("pi2") == ("agent-01", "agent-02")


@pytest.mark.parametrize(("restarts_max", "on_loss"), [(0, "continue"), (5, "abort")])
def test_nobody_starts_again_when_the_scenario_does_not_say_so(
    restarts_max: int, on_loss: str
) -> None:
    assert roll(restarts_max, on_agent_loss=on_loss).restartable_on("pi2") == ()


def test_hand_started_agents_are_nobodys_to_restart() -> None:
    assert "agent-01" not in roll(1, manual=("agent-01",)).restartable_on("pi2")


def test_agents_that_were_ended_on_purpose_have_lost_no_start() -> None:
    made = roll(1)
    made.started("agent-01", 1)
    made.killed("agent-01", will_return=True)
    made.started("agent-01", 2)
    made.started("agent-02", 1)
    made.killed("agent-02", will_return=False)

    assert made.restartable_on("pi2") == ("agent-01", "agent-03")
    assert made.left_on("pi2") == ("agent-01", "agent-03")
    start = made.next_start_on("pi2")
    assert start.first_incarnations == {"agent-01": 3, "agent-02": 2, "agent-03": 1}
    assert start.killed_before == {"agent-01": 1, "agent-02": 1}


def test_each_start_on_a_machine_counts_on_from_what_its_agents_had() -> None:
    made = roll(5)
    made.started("agent-01", 1)
    made.started("agent-01", 2)

    first, second = made.next_start_on("pi2"), made.next_start_on("pi2")

    assert (first.incarnation, second.incarnation) == (2, 3)
    assert first.first_incarnations == {"agent-01": 3, "agent-02": 1, "agent-03": 1}
    assert made.next_start_on("pi3").incarnation == 2


def test_machine_on_which_nothing_starts_is_given_up_after_as_many_starts_as_an_agent_has() -> None:
    made = roll(2)
    for _ in range(2):
        assert made.restartable_on("pi2")
        made.next_start_on("pi2")

    assert made.restartable_on("pi2") == ()
    assert made.restartable_on("pi3")


def test_records_on_another_machine_are_synced_unless_the_scenario_says_how() -> None:
    there = MachineConfig(directory="/d", base_directory="/there")
    own = dataclasses.replace(CONFIG, recording=Recording(sync_interval_s=0))

    assert config_at(CONFIG, there).recording.sync_interval_s == SYNC_INTERVAL_S
    assert config_at(own, there).recording.sync_interval_s == 0


def request_of(agents: Agents, machines: dict[str, tuple[str, ...]]) -> LaunchRequest:
    config = dataclasses.replace(CONFIG, agents=agents)
    return LaunchRequest(config=config, directory=Path("/runs/0007-x"), machines=machines)


@pytest.mark.parametrize(
    ("count", "per_process"), [(96, 48), (93, 47), (1000, 125), (24, 12), (50, 47)]
)
def test_packs_are_spread_over_the_period(count: int, per_process: int) -> None:
    agents = Agents(count=count, tick_hz=10.0, per_process=per_process)
    names = agents.resolved_names()
    packs = packs_on_machine(names, per_process)

    phases_s = request_of(agents, {"pi01": names}).phases_s()

    assert [len({phases_s[name] for name in pack}) for pack in packs] == [1] * len(packs)
    assert sorted(phases_s[pack[0]] for pack in packs) == pytest.approx(
        [0.1 * number / len(packs) for number in range(len(packs))]
    )


def test_packs_of_all_machines_are_spread_over_the_period() -> None:
    """24 agents on two machines, three per process, which is four packs on each."""
    agents = Agents(count=24, tick_hz=10.0, per_process=3)
    names = agents.resolved_names()
    machines = {"pi01": names[::2], "pi02": names[1::2]}

    phases_s = request_of(agents, machines).phases_s()

    assert sorted(phases_s.values()) == pytest.approx(
        [0.1 * number / 8 for number in range(8) for _ in range(3)]
    )
    assert phases_s[names[0]] == phases_s[names[4]] != phases_s[names[6]]


def test_agents_by_themselves_divide_the_period_by_their_numbers() -> None:
    agents = Agents(count=24, tick_hz=100.0)
    names = agents.resolved_names()
    machines = {"pi01": names[::2], "pi02": names[1::2]}

    phases_s = request_of(agents, machines).phases_s()

    assert sorted(phases_s.values()) == pytest.approx([number / 24 / 100 for number in range(24)])
    assert [phases_s[name] for name in names] == staggered(24, 100.0)


def test_aligned_packs_share_the_beginning_of_the_period() -> None:
    agents = Agents(count=24, tick_hz=100.0, per_process=24, phase="aligned")

    phases_s = request_of(agents, {"pi01": agents.resolved_names()}).phases_s()

    assert set(phases_s.values()) == {0.0}


@pytest.mark.parametrize("there", [1, 2])
def test_agents_of_a_machine_that_has_returned_have_the_phases_they_had(there: int) -> None:
    """Those that may not be started again, or left the run, are missing among them."""
    agents = Agents(count=48, tick_hz=1.0, per_process=8)
    names = agents.resolved_names()
    machines = {"pi01": names[:24], "pi02": names[24:]} if there == 2 else {"pi01": names}
    request = request_of(agents, machines)
    left = (*names[3:12], *names[17:24])

    before = request.agent_launch("pi01", machines["pi01"], Listening("127.0.0.1", 1))
    after = request.agent_launch("pi01", left, Listening("127.0.0.1", 1))

    assert after["phases_s"] == {name: before["phases_s"][name] for name in left}
    assert request.host_launch()["phases_s"].items() >= before["phases_s"].items()
