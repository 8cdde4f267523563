"""
From a scenario and machines to a launch plan. Pure: the same input gives the same plan.

Agents are dealt in blocks of neighbours, so that the machines' loads differ by one agent at most, as
far as the scenario's placement rules and the room on the machines allow.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from cosmos_cli.errors import Fault, InputError
from cosmos_cli.fleet.target import target_of
from cosmos_cli.models.agent_labels import NO_LABELS, AgentLabels
from cosmos_cli.models.document import Path as ValuePath
from cosmos_cli.models.document import dotted
from cosmos_cli.models.inventory import Machine, no_machine_words
from cosmos_cli.models.inventory.devices import device_label, device_words
from cosmos_cli.models.inventory.machine import LOOPBACK
from cosmos_cli.models.limit import PatternError, matching_machines
from cosmos_cli.models.placement import PlacementRule, claim_agents
from cosmos_cli.models.scenario import Scenario
from madns_runtime.lockstep.partition import share_out
from madns_runtime.plain_values import first_few

NAMES_SHOWN_MAX = 8
LOCKSTEP_IS_HERE = (
    "time.mode: lockstep runs on this computer alone: leave out the inventory and --host, or run in"
    " real time on them with --set time.mode=realtime"
)

FaultAt = Callable[[ValuePath, str], Fault]
"""Tells where a path of the scenario stands in its file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MachinePlan:
    """Share of one machine in a run."""

    machine: Machine
    processes: tuple[tuple[str, ...], ...]
    """The names of the agents in each process."""

    @property
    def name(self) -> str:
        """The machine's name."""
        return self.machine.name

    @property
    def agents(self) -> tuple[str, ...]:
        """The names of all agents here, in order."""
        return tuple(name for process in self.processes for name in process)

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for plan.json."""
        return _machine_mapping(self.machine) | {
            "agents": list(self.agents),
            "processes": [list(process) for process in self.processes],
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class LaunchPlan:
    """Agents of each machine, and the processes that they share."""

    scenario: str
    machines: tuple[MachinePlan, ...]
    """Machines that run at least one agent, in the inventory's order."""
    idle: tuple[str, ...] = ()
    """Names of machines that are left without an agent, although they would take one."""
    spare: tuple[Machine, ...] = ()
    """Those of them that would run more agents, were there more: all, unless a rule takes all that are left."""
    host: Machine | None = None
    """The machine of the run's host; None for the operator's own."""
    notes: tuple[str, ...] = ()
    """Notes on the placement for a person."""
    is_lockstep: bool = False
    """Whether the host runs the agents in workers of its own, and simulated time waits for all."""

    @property
    def agents_by_machine(self) -> Mapping[str, tuple[str, ...]]:
        """The names of the agents that each machine runs."""
        return {machine.name: machine.agents for machine in self.machines}

    @property
    def involved(self) -> Mapping[str, Machine]:
        """The machines that run an agent or the host, by name."""
        machines = {planned.name: planned.machine for planned in self.machines}
        return machines if self.host is None else {**machines, self.host.name: self.host}

    @property
    def elsewhere(self) -> tuple[Machine, ...]:
        """The machines involved that are other computers."""
        return tuple(each for each in self.involved.values() if each.connection != "local")

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for plan.json: enough to reach every machine again without the inventory."""
        return {
            "scenario": self.scenario,
            "host": {"name": self.host.name} | _machine_mapping(self.host) if self.host else None,
            "machines": {machine.name: machine.to_mapping() for machine in self.machines},
            "idle": list(self.idle),
            "notes": list(self.notes),
            "is_lockstep": self.is_lockstep,
        }


def make_plan(  # noqa: PLR0913 - labels and the place of faults are of the scenario's file, by name
    scenario: Scenario,
    machines: Sequence[Machine] = (LOOPBACK,),
    *,
    host: str | None = None,
    fault_at: FaultAt | None = None,
    processors: int = 1,
    labels: AgentLabels = NO_LABELS,
) -> LaunchPlan:
    """
    Place the scenario's agents on machines.

    Without an inventory, that is on LOOPBACK alone, the rules' machines and bounds are left out of
    account, so that every scenario can be tried on one computer; a note says so.

    Args:
        scenario: The scenario.
        machines: At least one; by default this computer alone.
        host: Name of the machine that runs the host, None for the operator's own. Agents are placed
            there only by a rule that asks for machines or devices, or when there is no other.
        fault_at: Tells where faults stand in the scenario's file, as `ScenarioFile.fault` does.
        processors: Of this computer; in lockstep the agents are shared out over them.
        labels: Second names of agents, by which rules find them, too.

    Raises:
        InputError: There is no machine, no such host, or the rules cannot be kept: with every fault.
    """
    if not machines:
        raise InputError("expected at least one machine, got none; check the inventory")
    if scenario.time.is_lockstep and (tuple(machines) != (LOOPBACK,) or host is not None):
        raise InputError(LOCKSTEP_IS_HERE)
    dealer = _Dealer(machines, _host_of(machines, host), fault_at or fault_without_place)
    names = scenario.agents.resolved_names()
    claims = claim_agents(names, scenario.placement, labels)
    dealer.faults += [dealer.fault_at(("placement", *path), text) for path, text in claims.faults]
    for index, (rule, agents) in enumerate(zip(scenario.placement, claims.taken, strict=True)):
        dealer.follow(index, rule, agents)
    dealer.deal(("agents", "count"), claims.left, dealer.default_places(), None)
    if dealer.faults:
        raise InputError(faults=dealer.faults)
    _refuse_twins([place.machine for place in dealer.places if place.agents], dealer.host)
    order, idle = {name: index for index, name in enumerate(names)}, dealer.idle()
    return LaunchPlan(
        scenario=scenario.name,
        machines=tuple(
            MachinePlan(
                machine=place.machine,
                processes=_processes(
                    scenario, sorted(place.agents, key=order.__getitem__), processors
                ),
            )
            for place in dealer.places
            if place.agents
        ),
        idle=tuple(machine.name for machine in idle),
        spare=() if any(rule.takes_the_rest for rule in scenario.placement) else idle,
        host=dealer.host,
        notes=tuple(dealer.notes),
        is_lockstep=scenario.time.is_lockstep,
    )


def _refuse_twins(machines: Sequence[Machine], host: Machine | None) -> None:
    """Refuse machines that record in one folder: each would offer the other's records as its own."""
    named: dict[tuple[str, int | None, str | None, str], str] = {}
    involved = {machine.name: machine for machine in (*machines, *((host,) if host else ()))}
    for target in map(target_of, involved.values()):
        if target.connection == "local":
            continue
        place = target.address, target.port, target.user, target.root
        if (other := named.setdefault(place, target.name)) != target.name:
            raise InputError(
                f"{other} and {target.name} are one machine, {target.address}, with one cosmos_root: correct"
                " ansible_host, leave one of them out (--limit), or give each a cosmos_root of its own"
            )


@dataclass(slots=True)
class _Place:
    """A machine while agents are dealt."""

    machine: Machine
    agents: list[str] = field(default_factory=list)

    def room(self, per_machine: int | None) -> int | None:
        """Return for how many more agents there is room; None for any number."""
        limits = [] if per_machine is None else [per_machine]
        if self.machine.variables.cosmos_agents is not None:
            limits.append(max(0, self.machine.variables.cosmos_agents - len(self.agents)))
        return min(limits, default=None)


class _Dealer:
    """Deals agents over machines, and collects what cannot be done."""

    def __init__(
        self, machines: Sequence[Machine], host: Machine | None, fault_at: FaultAt
    ) -> None:
        self.places = [_Place(machine) for machine in machines]
        self.host = host
        self.fault_at = fault_at
        self.has_inventory = tuple(machines) != (LOOPBACK,)
        self.faults: list[Fault] = []
        self.notes: list[str] = []

    def follow(self, index: int, rule: PlacementRule, agents: Sequence[str]) -> None:
        """Deal the agents of one rule."""
        path: ValuePath = ("placement", index)
        if not self.has_inventory and (rule.machines or rule.per_machine):
            words = [f"machines: {rule.machines}"] if rule.machines else []
            words += [f"per_machine: {rule.per_machine}"] if rule.per_machine else []
            told = "without an inventory all agents run on this computer"
            self.notes.append(f"{dotted(path)}: {', '.join(words)} is left out of account: {told}")
        places = self._places_for(path, rule)
        if places:
            per_machine = rule.per_machine if self.has_inventory else None
            self.deal(path, agents, places, per_machine)

    def idle(self) -> tuple[Machine, ...]:
        """Return the machines that are left without an agent, but the host's and those that take none."""
        return tuple(
            place.machine
            for place in self.places
            if not place.agents
            and place.machine is not self.host
            and place.machine.variables.cosmos_agents != 0
        )

    def default_places(self) -> list[_Place]:
        """Return where agents run that no rule sends elsewhere: not beside the host, if there is another machine."""
        return [place for place in self.places if place.machine is not self.host] or self.places

    def _without_machines(self) -> list[str]:
        """Return the names of the inventory that no machine here has: empty groups, and what --limit leaves out."""
        machines = [place.machine for place in self.places]
        known = frozenset[str]().union(*(machine.inventory_names for machine in machines))
        return sorted(known - {machine.name for machine in machines})

    def _places_for(self, path: ValuePath, rule: PlacementRule) -> list[_Place]:
        """Return where a rule's agents may run; an empty list and a fault if nowhere."""
        places = self.places if rule.machines or rule.devices else self.default_places()
        if rule.machines and self.has_inventory:
            machines = [place.machine for place in self.places]
            try:
                chosen = matching_machines(machines, rule.machines, groups=self._without_machines())
            except PatternError as error:
                self.faults.append(self.fault_at((*path, "machines"), str(error)))
                return []
            names = {machine.name for machine in chosen}
            places = [place for place in places if place.machine.name in names]
        fitting = [
            place
            for place in places
            if set(rule.devices) <= device_words(place.machine.variables.cosmos_devices or ())
        ]
        if not fitting:
            self.faults.append(self.fault_at((*path, "devices"), self._no_device(rule, places)))
        return fitting

    def _no_device(self, rule: PlacementRule, places: Sequence[_Place]) -> str:
        wanted = " and ".join(rule.devices)
        if not self.has_inventory:
            return f"no inventory, so no machine with {wanted}: give one with -i"
        there = sorted(
            {
                word
                for place in places
                for word in device_words(place.machine.variables.cosmos_devices or ())
            }
        )
        known = f"devices there: {', '.join(there)}" if there else "no machine there has a device"
        hint = "name it in cosmos_devices of the machine that has it"
        return f"none of {_some(places)} has {wanted} ({known}); {hint}"

    def deal(
        self,
        path: ValuePath,
        agents: Sequence[str],
        places: Sequence[_Place],
        per_machine: int | None,
    ) -> None:
        """Deal *agents* in blocks, so that the loads become as even as they can."""
        rooms = [place.room(per_machine) for place in places]
        bounded = [room for room in rooms if room is not None]
        if len(bounded) == len(rooms) and sum(bounded) < len(agents):
            self.faults.append(self.fault_at(path, _no_room(len(agents), sum(bounded), places)))
            return
        shares = _shares(len(agents), [len(place.agents) for place in places], rooms)
        start = 0
        for place, share in zip(places, shares, strict=True):
            place.agents += agents[start : start + share]
            start += share


def _no_room(count: int, room: int, places: Sequence[_Place]) -> str:
    cure = "add machines, raise cosmos_agents in the inventory or per_machine in the scenario"
    return f"room for {room} of {count} agents on {_some(places)}: {cure}, or lower agents.count"


def _shares(count: int, loads: Sequence[int], rooms: Sequence[int | None]) -> list[int]:
    """Return how many of *count* agents go to each machine: always one more to the least loaded, the first of them."""
    shares = [0] * len(loads)
    waiting = [(load, index) for index, load in enumerate(loads) if rooms[index] != 0]
    heapq.heapify(waiting)
    for _ in range(count):
        load, index = waiting[0]
        shares[index] += 1
        if shares[index] == rooms[index]:
            heapq.heappop(waiting)
        else:
            heapq.heapreplace(waiting, (load + 1, index))
    return shares


def _host_of(machines: Sequence[Machine], name: str | None) -> Machine | None:
    if name is None:
        return None
    for machine in machines:
        if machine.name == name:
            return machine
    raise InputError(f"host: {no_machine_words(machines, name)}")


def fault_without_place(path: ValuePath, text: str) -> Fault:
    """Return a fault of a scenario that no file gives a line."""
    return Fault(text=text, path=dotted(path))


def _machine_mapping(machine: Machine) -> dict[str, Any]:
    return {
        "address": machine.address,
        "connection": machine.connection,
        "groups": list(machine.groups),
        "devices": [device_label(each) for each in machine.variables.cosmos_devices or ()],
        "target": target_of(machine).to_mapping(),
    }


def _some(places: Sequence[_Place]) -> str:
    return first_few([place.machine.name for place in places], NAMES_SHOWN_MAX)


def _processes(
    scenario: Scenario, names: Sequence[str], processors: int
) -> tuple[tuple[str, ...], ...]:
    if scenario.time.is_lockstep:
        return tuple(
            tuple(names[share.start : share.stop])
            for share in share_out(scenario.agents, processors)
        )
    size = scenario.agents.per_process
    return tuple(tuple(names[start : start + size]) for start in range(0, len(names), size))
