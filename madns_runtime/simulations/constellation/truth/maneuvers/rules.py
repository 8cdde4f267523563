"""
The desk that commands come to: decides what becomes of each, and keeps the account. Pure.

A command is accepted if truth that holds it can be with its agent before it is executed; one that comes
too late for that is postponed to the first feasible time or refused, as the scenario says. Times of an
agent are judged by its own ticks: they lie `phase_s` behind their nominal time, and so do its T_s and T_m.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.messages import (
    TOO_LATE,
    Command,
    CommandResult,
    CommandStatus,
)
from madns_runtime.simulations.constellation.parameters import Maneuvers
from madns_runtime.simulations.constellation.thrust import Vector
from madns_runtime.simulations.constellation.truth.maneuvers.account import (
    ManeuverAccount,
    Times,
)
from madns_runtime.simulations.constellation.truth.maneuvers.actuators import (
    ActuatorFailures,
    ActuatorRefusal,
    Burn,
    Given,
    Magnetisation,
    WheelTurn,
    chance_of,
    fire,
    magnetise,
    number_fault,
    propellant_of,
    turn,
    vector_of,
    vehicle_fault,
)
from madns_runtime.simulations.constellation.truth.maneuvers.effects import (
    ARC_S_MIN,
    SNAP_S,
    Effect,
    EffectKind,
    Timeline,
    snap,
    spin_rad_s_max,
)
from madns_runtime.simulations.constellation.truth.maneuvers.stuck_thrusters import (
    RAN_EMPTY,
    StuckThrusters,
    is_closure,
)
from madns_runtime.simulations.constellation.truth.maneuvers.tank import Tank

WAITING_MAX = 64
"""Commands of one vehicle whose time is not over."""
ACTUATORS = {
    "impulse": "thruster",
    "thrust": "thruster",
    "torque": "wheels",
    "dipole": "torquers",
}
"""Actuator of each effect; it does one thing at a time."""
FIELD_T_MAX = 7e-5
"""The Earth's field is nowhere stronger, T."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Taken:
    """A command that truth will hold, or the reason why not."""

    vehicle: int
    command: Command
    heard_s: float
    status: CommandStatus
    """accepted, postponed or refused."""
    at_s: float
    reason: str = ""
    effect: Effect | None = None
    """None if it is refused."""
    delta_v_m_s: float = 0.0
    """Magnitude that is really given."""
    used_kg: float = 0.0
    """Propellant that is really burnt."""
    propellant_kg: float = 0.0
    """Propellant left after the command, kg."""
    expected_m_s: float = 0.0
    """Magnitude without error."""
    expected_kg: float = 0.0
    """Propellant left after the command without error, kg."""
    begins_s: float = 0.0
    """Begin as commanded, s: T_m, of a finite burn half its length before."""
    is_late: bool = False
    """Whether it could not be in truth by its time."""
    wheels_n_m_s: Vector | None = None
    """Momentum of the wheels after a torque that is over, body axes, N m s."""

    def result(self, revision: int, *, is_over: bool = False) -> CommandResult:
        """Return what the vehicle is told: now what is expected, for errors show when its time is over."""
        return CommandResult(
            number=self.command.number,
            status="executed" if is_over else self.status,
            at_s=self.at_s,
            revision=revision,
            reason=self.reason,
            delta_v_m_s=self.delta_v_m_s if is_over else self.expected_m_s,
            propellant_kg=self.propellant_kg if is_over else self.expected_kg,
            wheels_n_m_s=self.wheels_n_m_s if is_over else None,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Rules:
    """Rules that all vehicles' commands are judged by."""

    settings: Maneuvers
    can_maneuver: bool
    """Whether the propagator starts from any state."""
    can_magnetise: bool = True
    """Whether truth follows a magnetic dipole."""
    duration_s: float
    tick_hz: float
    knot_s: float
    seed: int


class ManeuverDesk:
    """
    Decides about commands, one after the other.

    Args:
        rules: For all.
        agents: Names.
        vehicles: What each agent's vehicle is like.
        timelines: What is done to each; the desk adds to them.
    """

    def __init__(
        self,
        rules: Rules,
        agents: Sequence[str],
        vehicles: Sequence[Vehicle],
        timelines: Sequence[Timeline],
    ) -> None:
        self.account = ManeuverAccount()
        self.failures = ActuatorFailures()
        self._rules = rules
        self._agents = agents
        self._vehicles = vehicles
        self._timelines = timelines
        self._tanks = [Tank(vehicle) for vehicle in vehicles]
        self.stuck = StuckThrusters(
            vehicles,
            timelines,
            self._tanks,
            knot_s=rules.knot_s,
            duration_s=rules.duration_s,
        )
        self._taken = [0] * len(agents)
        self._waiting = [0] * len(agents)

    @property
    def waiting(self) -> int:
        """Commands that truth holds, or will, and whose time is not over."""
        return sum(self._waiting)

    def decide(self, vehicle: int, command: Command, heard_s: float) -> Taken:
        """Return what becomes of a command that is heard of now; an effect is in its vehicle's timeline then."""
        self.account.commanded += 1
        taken = self._judge(vehicle, command, heard_s)
        if taken.effect is None:
            self.account.refused += 1
            return taken
        self._timelines[vehicle].add(taken.effect)
        if is_closure(command):
            self.stuck.close(vehicle, taken.effect.start_s, "closed")
            left_kg = self._tanks[vehicle].propellant_kg
            taken = replace(taken, propellant_kg=left_kg, expected_kg=left_kg)
        self._taken[vehicle] += 1
        self._waiting[vehicle] += 1
        self.account.postponed += taken.status == "postponed"
        return taken

    def measure(self, taken: Taken, sent_s: float | None) -> Times:
        """Enter the synchronous inequality of a command whose truth was handed out at *sent_s*; None for a refused one."""
        command, account = taken.command, self.account
        network_s = max(0.0, taken.heard_s - (command.commanded_s + command.phase_s))
        propagation_s = None if sent_s is None else sent_s - taken.heard_s
        account.network_s_max = max(account.network_s_max, network_s)
        account.propagation_s_max = max(account.propagation_s_max, propagation_s or 0.0)
        allowed_s = self._rules.settings.propagation_s
        needed_s = (allowed_s if propagation_s is None else propagation_s) + 2.0 * network_s
        slack_s = taken.begins_s - command.commanded_s - needed_s
        if slack_s < 0.0 or taken.is_late:
            account.inequality_broken += 1
            account.inequality_broken_by[taken.vehicle] += 1
        account.slack_s_min = min(account.slack_s_min, slack_s)
        return Times(propagation_s=propagation_s, network_s=network_s, slack_s=slack_s)

    def execute(self, taken: Taken) -> Taken:
        """Enter that a command's time is over, and return it with what its actuator holds now."""
        self._waiting[taken.vehicle] -= 1
        attitude, effect = self._vehicles[taken.vehicle].attitude, taken.effect
        if effect and (burn := self.stuck.drained.pop((taken.vehicle, effect.number), None)):
            taken = replace(taken, delta_v_m_s=burn.delta_v_m_s, used_kg=burn.kg, reason=RAN_EMPTY)
        self.account.executed += 1
        self.account.delta_v_m_s += taken.delta_v_m_s
        self.account.propellant_kg += taken.used_kg
        if effect is None:
            return taken
        # Not what was left when it was accepted: others may have burnt since, or be booked and not have burnt.
        left_kg = self.stuck.left_kg(taken.vehicle, effect.end_s)
        taken = replace(taken, propellant_kg=left_kg)
        has_wheels = attitude is not None and attitude.wheels is not None
        if effect.kind != "torque" or not has_wheels:
            return taken
        momentum = self._timelines[taken.vehicle].wheels_at(effect.end_s)
        return replace(taken, wheels_n_m_s=momentum)

    def _judge(self, vehicle: int, command: Command, heard_s: float) -> Taken:
        refused = Taken(
            vehicle=vehicle,
            command=command,
            heard_s=heard_s,
            status="refused",
            at_s=command.at_s,
            propellant_kg=self._tanks[vehicle].propellant_kg,
            expected_kg=self._tanks[vehicle].propellant_kg,
        )
        fault = (
            number_fault(command)
            or self._rule_fault(vehicle, command)
            or vehicle_fault(command, self._vehicles[vehicle])
            or self.failures.refusal(vehicle, command.kind)
            or self.stuck.fault(vehicle, command)
        )
        if fault:
            return replace(refused, reason=fault)
        is_stuck = command.kind == "delta_v" and vehicle in self.stuck.burns
        given = None if is_stuck else self._given(refused)
        if isinstance(given, WheelTurn | Magnetisation):
            given = self._bearable(vehicle, command, given)
        if isinstance(given, ActuatorRefusal):
            return replace(refused, reason=given.reason)
        return self._in_time(refused, given)

    def _rule_fault(self, vehicle: int, command: Command) -> str:
        """Return why the scenario has no room for a command; empty if it has."""
        if not self._rules.can_maneuver:
            return "the scenario's propagator starts from no other states than its own"
        if command.kind == "dipole" and not self._rules.can_magnetise:
            return "the scenario's propagator follows no magnetic dipole"
        longest_s = self._rules.settings.duration_s_max
        if command.kind in ("torque", "dipole") and command.duration_s > longest_s:
            return (
                f"a {command.kind} of {command.duration_s:g} s: {longest_s:g} s at most "
                "(maneuvers.duration_s_max), so that none outlives by far who commanded it"
            )
        if self._waiting[vehicle] >= WAITING_MAX:
            return f"{WAITING_MAX} commands are waiting already"
        return ""

    def _given(self, heard: Taken) -> Given | ActuatorRefusal | None:
        """Return what the actuator makes of a command; None if it needs none."""
        vehicle, command = heard.vehicle, heard.command
        described = self._vehicles[vehicle]
        random = chance_of(self._rules.seed, self._agents[vehicle], command.number)
        if command.kind == "delta_v" and described.thruster is not None:
            share = self.failures.share(vehicle)
            return fire(described.thruster, self._tanks[vehicle], command.vector, random, share)
        if command.kind == "torque" and described.attitude is not None:
            # Torques of later times may have been commanded before: their wheels must not be overfilled.
            from_s = max(command.at_s, heard.heard_s - command.phase_s)
            held = self._timelines[vehicle].wheels_from(from_s)
            wheels = described.attitude.wheels
            return turn(wheels, held, command.vector, command.duration_s, random)
        if command.kind == "dipole" and described.attitude is not None:
            torquers = described.attitude.magnetorquers
            return None if torquers is None else magnetise(torquers, command.vector, random)
        return None

    def _bearable(
        self, vehicle: int, command: Command, given: WheelTurn | Magnetisation
    ) -> WheelTurn | Magnetisation | ActuatorRefusal:
        """Return a turn, or a refusal if it alone would spin the body faster than knots can tell."""
        described = self._vehicles[vehicle].attitude
        assert described is not None
        acting_s = min(command.duration_s, self._rules.duration_s)
        if isinstance(given, WheelTurn):
            torque_n_m = given.torque_n_m
        else:
            torque_n_m = (math.hypot(*given.dipole_a_m2) * FIELD_T_MAX,) * 3
        pairs = zip(torque_n_m, described.inertia_kg_m2, strict=True)
        gained_rad_s = max(abs(torque) / inertia for torque, inertia in pairs) * acting_s
        limit_rad_s = spin_rad_s_max(self._rules.knot_s)
        if gained_rad_s < limit_rad_s:
            return given
        return ActuatorRefusal(
            reason=f"it would spin the body up by {gained_rad_s:.4g} rad/s; "
            f"less than {limit_rad_s:.4g} rad/s, half a turn a knot, can be told"
        )

    def _in_time(self, refused: Taken, given: Given | None) -> Taken:
        """Return the command at its time, or at the first feasible one, or refused."""
        command, rules = refused.command, self._rules
        burn_s = given.duration_s if isinstance(given, Burn) else 0.0
        burn_s = burn_s if burn_s >= ARC_S_MIN else 0.0
        is_turn = isinstance(given, WheelTurn | Magnetisation)
        arc_s = command.duration_s if is_turn else burn_s
        start_s = begins_s = snap(command.at_s - burn_s / 2.0, rules.knot_s)
        ready_s = refused.heard_s + rules.settings.propagation_s + rules.settings.network_s
        status: CommandStatus = "accepted"
        is_late = start_s + command.phase_s < ready_s
        refused = replace(refused, begins_s=begins_s, is_late=is_late)
        reasons = given.limits if isinstance(given, WheelTurn | Magnetisation) else ()
        if is_late:
            late = f"{ready_s - command.phase_s - start_s:.4g} {TOO_LATE}"
            if rules.settings.late == "refuse":
                return replace(refused, reason=late)
            reasons = (late, *reasons)
            # A whole tick: the first time that flight software could have named itself, and none that it has passed.
            tick = math.ceil((ready_s - command.phase_s) * rules.tick_hz - 1e-9)
            heard_tick = math.floor((refused.heard_s - command.phase_s) * rules.tick_hz + 1e-9)
            tick = max(tick, heard_tick + 1, 1)
            start_s, status = snap(tick / rules.tick_hz, rules.knot_s), "postponed"
        end_s = snap(start_s + arc_s, rules.knot_s) if arc_s > 0.0 else start_s
        at_s = start_s + (end_s - start_s) / 2.0 if burn_s > 0.0 else start_s
        # Truth ends there: of what begins then it holds nothing, of a burn around the end half.
        if start_s >= rules.duration_s or at_s > rules.duration_s:
            where = "beyond" if at_s > rules.duration_s else "the end of"
            over = f"{at_s:g} s is {where} the run's {rules.duration_s:g} s"
            return replace(refused, at_s=at_s, reason=over)
        effect = Effect(
            number=self._taken[refused.vehicle],
            kind=_kind(command, arc_s),
            at_s=at_s,
            start_s=start_s,
            end_s=end_s,
            vector=command.vector if given is None else vector_of(given),
            frame="body" if is_turn else command.frame,
            burnt=given.burnt if isinstance(given, Burn) else 0.0,
        )
        effect = self._abutting(refused.vehicle, effect)
        if not is_closure(command) and (busy := self._busy(refused.vehicle, effect)):
            return replace(refused, at_s=at_s, reason=busy)
        taken = replace(refused, status=status, at_s=at_s, reason="; ".join(reasons), effect=effect)
        return self._booked(taken, given)

    def _abutting(self, vehicle: int, effect: Effect) -> Effect:
        """Return an effect that begins or ends where another does on its actuator, were it not for the rounding of times."""
        for other in self._timelines[vehicle].effects:
            is_one_actuator = ACTUATORS.get(other.kind) == ACTUATORS.get(effect.kind)
            if not is_one_actuator or not (effect.is_arc or other.is_arc):
                continue
            if 0.0 < abs(other.end_s - effect.start_s) <= SNAP_S:
                effect = effect.moved(start_s=other.end_s)
            if 0.0 < abs(other.start_s - effect.end_s) <= SNAP_S:
                effect = effect.moved(end_s=other.start_s)
        return effect

    def _busy(self, vehicle: int, effect: Effect) -> str:
        """Return why an effect cannot be made: its actuator is at work; empty if it can."""
        actuator = ACTUATORS.get(effect.kind, "")
        for other in self._timelines[vehicle].effects:
            overlaps = other.start_s < effect.end_s and effect.start_s < other.end_s
            if overlaps and ACTUATORS.get(other.kind) == actuator:
                return f"{actuator} busy from {other.start_s:.3f} s to {other.end_s:.3f} s"
        return ""

    def _booked(self, taken: Taken, given: Given | None) -> Taken:
        thruster = self._vehicles[taken.vehicle].thruster
        if not isinstance(given, Burn) or thruster is None:
            return taken
        tank, commanded_m_s = self._tanks[taken.vehicle], math.hypot(*taken.command.vector)
        needed_kg = propellant_of(thruster, tank.mass_kg, commanded_m_s)
        expected_kg = max(0.0, tank.propellant_kg - needed_kg)
        effect, now_s = taken.effect, taken.heard_s - taken.command.phase_s
        assert effect is not None
        tank.book(effect, given.propellant_kg, now_s=now_s)
        return replace(
            taken,
            delta_v_m_s=given.magnitude_m_s,
            used_kg=given.propellant_kg,
            propellant_kg=tank.propellant_kg,
            expected_m_s=commanded_m_s,
            expected_kg=expected_kg,
        )


def _kind(command: Command, arc_s: float) -> EffectKind:
    if command.kind == "delta_v":
        return "thrust" if arc_s > 0.0 else "impulse"
    return command.kind
