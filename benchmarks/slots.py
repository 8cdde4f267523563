"""
What slot keeping by hearsay costs: as flown, beside the same law given every satellite's true phase.

    python benchmarks/slots.py scenarios/chain77.yaml [--set KEY=VALUE] [--run RUN] [--json]

Flies the scenario in lockstep (or takes a recorded RUN of it) and judges it by truth; flies the same flight
software again in this process from the same states, J2 truth, with a member of the ring that is told every
living satellite's mean elements anew each exchange; and prints beside both the least delta-v with which all
errors can be gone by the end. The first divided by the second is what hearsay costs.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosmos_cli.models.loading import load_scenario
from madns_runtime.config import from_mapping
from madns_runtime.simulations.constellation.analysis.slots import even_errors_deg
from madns_runtime.simulations.constellation.flight.api import TRUTH, FlightContext, Reading
from madns_runtime.simulations.constellation.flight.gossip import Known
from madns_runtime.simulations.constellation.flight.loading import load_flight_class
from madns_runtime.simulations.constellation.flight.ring_consensus import RingMember, RingSettings
from madns_runtime.simulations.constellation.flight_settings import FlightClass
from madns_runtime.simulations.constellation.messages import CommandResult
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.frames import rtn_to_inertial
from madns_runtime.simulations.constellation.orbit.mean_elements import mean_from_state, wrapped
from madns_runtime.simulations.constellation.parameters import (
    ConstellationParameters,
    ScipyPropagator,
)
from madns_runtime.simulations.constellation.truth.initial_states import load_fleet
from madns_runtime.simulations.constellation.truth.propagation import PropagationParameters
from madns_runtime.simulations.constellation.truth.propagators.scipy_propagator import ScipyDop853
from madns_runtime.simulations.constellation.vehicles import flight_of, flight_rules

RTOL = 1e-10
"""Of truth in this process: 1 mm a day."""
RUN_S_MAX = 1800.0
"""For a whole run of the scenario, its collection and its report."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """A scenario's satellites that keep slots, at the epoch."""

    states: Floats
    """Shape (K, 6), m and m/s, TEME; the dead left out."""
    indices: tuple[int, ...]
    """Their places among all agents."""
    agents: tuple[str, ...]
    """All of them."""
    software: type
    settings: Mapping[str, Any]
    epoch_utc: datetime
    duration_s: float

    def errors_deg(self, states: Floats) -> Floats:
        """Return how far each one is ahead of its slot, deg, as a report judges it."""
        mean = np.full((len(self.agents), 1, 5), np.nan)
        for index, state in zip(self.indices, states.tolist(), strict=True):
            mean[index, 0, 0] = mean_from_state(tuple(state[:3]), tuple(state[3:]), EGM_96).lam_rad
        spacing_deg = self.settings.get("spacing_deg")
        return even_errors_deg(mean, spacing_deg=spacing_deg)[list(self.indices), 0]


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What became of the slots, and for how much."""

    slot_error_deg_rms: float
    slot_error_deg_max: float
    delta_v_m_s_mean: float
    """Over those that keep slots."""


class Sky:
    """Truth for all, in one process: their mean elements at a time, and burns as impulses."""

    def __init__(self, start: Start) -> None:
        self.states, self.t_s = start.states.copy(), 0.0
        self.delta_v_m_s = np.zeros(len(start.indices))
        self.members: list[InformedMember] = []
        self._waiting: list[tuple[float, int, Floats]] = []
        self._known: tuple[float, Known] | None = None
        self._first_smas_m: Floats | None = None
        settings = ScipyPropagator(kind="scipy", forces=("two_body", "j2"), rtol=RTOL)
        self._parameters = PropagationParameters(
            settings=settings, gravity=EGM_96, epoch_utc=start.epoch_utc
        )

    def burn(self, member: int, delta_v_m_s: Sequence[float], at_s: float) -> None:
        """Note a change of velocity, along radius, track and normal."""
        self._waiting.append((at_s, member, np.asarray(delta_v_m_s, dtype=np.float64)))

    def advance(self, to_s: float) -> None:
        """Let time pass, stopping at each burn."""
        while due := min(
            (item for item in self._waiting if item[0] <= to_s), default=None, key=_at
        ):
            self._waiting = [item for item in self._waiting if item is not due]
            at_s, member, change = due
            self._propagate(at_s)
            r, v = self.states[member, :3], self.states[member, 3:]
            self.states[member, 3:] += rtn_to_inertial(r, v) @ change
            self.delta_v_m_s[member] += float(np.linalg.norm(change))
        self._propagate(to_s)

    def known(self) -> Known:
        """Return what is true of all members now."""
        if self._known is None or self._known[0] != self.t_s:
            pairs = list(zip(self.members, self.states.tolist(), strict=True))
            places = [member.truly(state, self.t_s) for member, state in pairs]
            phases_rad, smas_m = np.array(places).T
            if self._first_smas_m is None:
                self._first_smas_m = smas_m
            known = Known(
                phases_rad=phases_rad,
                smas_m=smas_m,
                first_smas_m=self._first_smas_m,
                ages=np.zeros(len(places), dtype=np.int64),
                change_m=0.0,
            )
            self._known = self.t_s, known
        return self._known[1]

    def _propagate(self, to_s: float) -> None:
        if to_s > self.t_s:
            knots_s = np.array([self.t_s, to_s])
            moved = ScipyDop853().propagate(self.states, self.t_s, knots_s, self._parameters)
            self.states, self.t_s = moved[:, 1].copy(), to_s


class InformedMember(RingMember):
    """A member that needs no hearsay: the sky tells it where everybody is."""

    def __init__(self, context: FlightContext, sky: Sky) -> None:
        super().__init__(context, follows_sma=False)
        self._sky = sky
        sky.members.append(self)

    def known_members(self, now: int) -> Known:
        """Return what is true."""
        return self._sky.known()

    def truly(self, state: Sequence[float], t_s: float) -> tuple[float, float]:
        """Return its phase, rad, and its height above the design orbit, m, as it would measure them."""
        x, y, z, vx, vy, vz = state
        mean = mean_from_state((x, y, z), (vx, vy, vz), EGM_96)
        turned_rad = mean.lam_rad - self.rate_rad_s * t_s - self.slot_rad
        return wrapped(turned_rad), mean.a_m - self.design.a_m


class Cockpit:
    """What flight software is given here: as a vehicle's context, with a radio that nobody hears."""

    frame, first_number, tick_hz = "TEME", 0, 1.0

    def __init__(self, start: Start, member: int, sky: Sky) -> None:
        self.index, self.agents = start.indices[member], start.agents
        self.name = self.satellite = self.agents[self.index]
        self.settings, self.duration_s = start.settings, start.duration_s
        self.epoch_utc = start.epoch_utc.isoformat()
        self.random = np.random.default_rng(self.index)
        self.results: list[CommandResult] = []
        self._member, self._sky, self._commands = member, sky, 0

    def delta_v(self, delta_v_m_s: Sequence[float], *, at_s: float, frame: str = "rtn") -> int:
        """Command a burn, which comes off as wished."""
        assert frame == "rtn"
        self._sky.burn(self._member, delta_v_m_s, at_s)
        given = math.hypot(*delta_v_m_s)
        result = CommandResult(
            number=self._commands, status="executed", at_s=at_s, revision=0, delta_v_m_s=given
        )
        self.results.append(result)
        self._commands += 1
        return result.number

    def send(self, to: str, payload: object) -> int:
        """Say something into the void."""
        return 0

    def broadcast(self, payload: object) -> int:
        """Say something into the void."""
        return 0

    def estimate(self, values: Mapping[str, float]) -> None:
        """Believe something."""

    def log(self, level: str, text: str) -> None:
        """Say something to nobody."""


def load_start(path: Path, settings: Sequence[str] = ()) -> Start:
    """Return the satellites of a scenario of slots of even spacing; *settings* are KEY=VALUE, as of --set."""
    file = load_scenario(path, settings)
    parameters = from_mapping(ConstellationParameters, file.parameters)
    config = file.scenario
    agents = config.agents.resolved_names()
    fleet = load_fleet(parameters, len(agents), path.resolve().parent)
    keepers = [
        index
        for index, (agent, satellite) in enumerate(zip(agents, fleet.names, strict=False))
        if flight_of(parameters, agent, satellite) is not None
    ]
    flight = next(iter(flight_rules(parameters)), None)
    if not isinstance(flight, FlightClass) or flight.settings.get("slots") != "even":
        raise SystemExit(f"{path}: expected flight software with slots: even")
    return Start(
        states=fleet.states[keepers],
        indices=tuple(keepers),
        agents=agents,
        software=load_flight_class(flight.software, path.resolve().parent),
        settings=dict(flight.settings),
        epoch_utc=fleet.epoch_utc,
        duration_s=config.time.duration_s,
    )


def fly_informed(start: Start) -> Outcome:
    """Fly the scenario's software with every satellite's true phase."""
    sky = Sky(start)
    cockpits = [Cockpit(start, member, sky) for member in range(len(start.indices))]
    software = [start.software() for _ in cockpits]
    for one, cockpit in zip(software, cockpits, strict=True):
        one.setup(cockpit)
        one._ring = InformedMember(cockpit, sky)
    exchange_s = RingSettings.from_mapping(start.settings).exchange_s
    # Between exchanges the software only waits for the time of a second burn; so often does it look.
    tick_s = exchange_s / math.ceil(exchange_s / 60.0)
    for tick in range(1, math.ceil(start.duration_s / tick_s) + 1):
        for one, cockpit, state in zip(software, cockpits, sky.states.tolist(), strict=True):
            one.step(sky.t_s, {TRUTH: Reading(sky.t_s, tuple(state))})
            while cockpit.results:
                one.command_result(cockpit.results.pop(0))
        sky.advance(min(tick * tick_s, start.duration_s))
    errors_deg = start.errors_deg(sky.states)
    return Outcome(
        slot_error_deg_rms=float(np.sqrt(np.mean(errors_deg**2))),
        slot_error_deg_max=float(np.abs(errors_deg).max()),
        delta_v_m_s_mean=float(sky.delta_v_m_s.mean()),
    )


def fly(path: Path, settings: Sequence[str] = (), *, run: str | None = None) -> Outcome:
    """Fly a scenario in lockstep, or take a run of it, and return what its report says."""
    chosen = [part for setting in ("time.mode=lockstep", *settings) for part in ("--set", setting)]
    with tempfile.TemporaryDirectory() as folder:
        environment = dict(os.environ)
        if run is None:
            environment |= {"COSMOS_STATE_DIR": f"{folder}/state", "COSMOS_RUNS": f"{folder}/runs"}
            _cosmos(environment, "run", str(path), *chosen, "--no-report")
        document = json.loads(_cosmos(environment, "report", run or "last"))
    last = document["control"]["rows"][-1]
    given_m_s = last["delta_v_m_s_mean"] * document["agents"]["count"]
    return Outcome(
        slot_error_deg_rms=last["slot_error_deg_rms"],
        slot_error_deg_max=last["slot_error_deg_max"],
        delta_v_m_s_mean=given_m_s / last["satellites"],
    )


def least_delta_v_m_s(errors_deg: Floats, a_m: float, duration_s: float) -> float:
    """
    Return the least mean delta-v with which all slot errors are gone in a time, in impulses along the track.

    A burn dv changes the rate of the phase by -3 dv / a. From rest to rest, a change D of phase in T wants at
    least the rate D / T, taken up at once and given back at the end: 2 a |D| / (3 T). Where they meet is free: at
    the median the sum of |D| is least. Meeting at another height saves nothing: of a final rate w each one pays
    |D/T| + |D/T - w|, and the median, which is zero, makes both sums least. Small changes of near-circular
    orbits, without J2, and without undoing the eccentricity that each burn makes (two half burns, half an orbit
    apart, cost the same and leave none).
    """
    apart_rad = np.radians(np.abs(errors_deg - np.median(errors_deg)))
    return float(2.0 * a_m * np.mean(apart_rad) / (3.0 * duration_s))


def _cosmos(environment: Mapping[str, str], *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "cosmos_cli.start", *arguments, "--json", "--quiet"],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
        timeout=RUN_S_MAX,
        check=False,
    )
    if done.returncode:
        raise SystemExit(f"cosmos {' '.join(arguments)} ended with {done.returncode}")
    return done.stdout


def _at(item: tuple[float, int, Floats]) -> tuple[float, int]:
    return item[0], item[1]


def main() -> None:
    """Measure, and print what it came to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("scenario", type=Path)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="settings")
    parser.add_argument("--run", help="a recorded run of it, instead of a new one")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")
    arguments = parser.parse_args()
    path, settings = arguments.scenario, tuple(arguments.settings)
    start = load_start(path, settings)
    flown, informed = fly(path, settings, run=arguments.run), fly_informed(start)
    errors_deg = start.errors_deg(start.states)
    a_m = RingSettings.from_mapping(start.settings).design.a_m
    least_m_s = least_delta_v_m_s(errors_deg, a_m, start.duration_s)
    ratio = flown.delta_v_m_s_mean / informed.delta_v_m_s_mean
    if arguments.json:
        figures = {"flown": asdict(flown), "informed": asdict(informed)}
        print(json.dumps(figures | {"ratio": ratio, "least_delta_v_m_s_mean": least_m_s}))
        return
    hours = start.duration_s / 3600.0
    first_deg = float(np.sqrt(np.mean(errors_deg**2)))
    print(
        f"{len(start.indices)} satellites, {first_deg:.3f} deg rms at the start; after {hours:g} h:\n"
    )
    print("| | slot error rms, deg | max, deg | delta-v mean, m/s |\n|---|---|---|---|")
    for name, one in (("as flown", flown), ("the same law, every true phase known", informed)):
        print(
            f"| {name} | {one.slot_error_deg_rms:.4f} | {one.slot_error_deg_max:.4f} | "
            f"{one.delta_v_m_s_mean:.3f} |"
        )
    print(f"| least fuel, to no error at all | 0 | 0 | {least_m_s:.3f} |")
    print(f"\nHearsay costs {ratio:.3f} times the delta-v of knowledge.")


if __name__ == "__main__":
    main()
