"""
Propagators of truth side by side in one run, and Basilisk as anybody would build it.

    python benchmarks/truth.py [--counts 10,93,1000,5000] [--rounds 7] [--json]
    python benchmarks/truth.py --accuracy

One batch is 10 s with 100 states per vehicle, under two-body and J2 forces; at a step of 1 s Basilisk
gives 10 states. Simulations are built, machine code compiled and element sets parsed before anything
is timed. Contenders alternate, so that what else the machine does hits all; medians are shown, and how
many times the default's they are. Basilisk stands there twice: `rigid` is its spacecraft as it comes,
whose rotation is integrated too, and what the goals are about; `point` leaves rotation out, which is
how the propagator `basilisk` uses it. --accuracy prints the tables of docs/accuracy.md instead.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from accuracy import agreement_m, print_tables
from numpy.typing import NDArray

from madns_runtime.errors import MissingExtraError
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.parameters import (
    AnyPropagator,
    BasiliskPropagator,
    NumbaPropagator,
    ScipyPropagator,
    Sgp4Propagator,
)
from madns_runtime.simulations.constellation.truth.element_sets import read_element_sets
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    load_propagator,
    propagate,
)

ROOT = Path(__file__).parents[1]
SETS = ROOT / "scenarios/data/iridium10.tle"
BATCH_S = 10.0
STATES = 100
BASILISK_COUNT_MAX = 1000
"""Beyond, a batch takes Basilisk seconds and tells nothing new."""
SLOW_ROUNDS_MAX = 3
SLOW_MS = 500.0
"""A contender that takes longer runs SLOW_ROUNDS_MAX times only."""
DEFAULT = "scipy"
RIVALS = ("basilisk 0.1 s, point", "basilisk 0.1 s, rigid")
"""Point masses do the same work; spacecraft, as the thesis flew them, integrate their rotation beside."""
ALONE_ROUNDS = 500
GOALS = (
    ("at 93 vehicles", 93, 50.0),
    ("at 1000 vehicles", 1000, 100.0),
)
AGREEMENT_M = 1e-5
ALONE_MS_P99 = 2.0

Array = NDArray[np.float64]
Times = dict[int, dict[str, list[float]]]


def main() -> None:
    """Measure, and print tables and which goals are met."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--counts", default="10,93,1000,5000", help="vehicles, comma-separated")
    parser.add_argument("--rounds", type=int, default=7, help="batches of each contender")
    parser.add_argument("--json", action="store_true", help="print all figures as JSON")
    parser.add_argument("--accuracy", action="store_true", help="print the accuracy tables instead")
    arguments = parser.parse_args()
    if arguments.accuracy:
        print_tables()
        return
    counts = [int(count) for count in arguments.counts.split(",")]
    times_ms = {count: race(count, arguments.rounds) for count in counts}
    alone_ms = {kind: alone(settings) for kind, settings in alone_settings()}
    agreement = agreement_m()
    if arguments.json:
        figures = {"batch_ms": times_ms, "one_vehicle_ms": alone_ms, "agreement_m": agreement}
        print(json.dumps(figures, indent=2))
        return
    print_times(times_ms)
    print_alone(alone_ms)
    print_agreement(agreement)
    print_goals(times_ms, alone_ms, agreement)


def race(count: int, rounds: int) -> dict[str, list[float]]:
    """Return each contender's times of a batch, ms."""
    batches = dict(contenders(count))
    times_ms: dict[str, list[float]] = {}
    for name, batch in batches.items():
        # The first call builds and compiles; it tells who is slow, and is not kept.
        batch()
        print(f"{count} vehicles: {name}: {timed_ms(batch):.3g} ms", file=sys.stderr)
    names = list(batches)
    for number in range(rounds):
        # Another order each round, so that what else the machine does hits everybody.
        shift = number % len(names)
        for name in names[shift:] + names[:shift]:
            kept = times_ms.setdefault(name, [])
            if len(kept) < SLOW_ROUNDS_MAX or statistics.median(kept) < SLOW_MS:
                kept.append(timed_ms(batches[name]))
    return {name: times_ms[name] for name in names}


def contenders(count: int) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield a name and what computes one batch, of those that are installed."""
    knots_s = np.arange(1, STATES + 1) * (BATCH_S / STATES)
    yield DEFAULT, batch_of(ScipyPropagator(kind="scipy"), count, knots_s)
    wanted: list[tuple[str, AnyPropagator, Array]] = [
        ("numba", NumbaPropagator(kind="numba"), knots_s),
        ("numba, 2 threads", NumbaPropagator(kind="numba", threads=2), knots_s),
        ("sgp4", Sgp4Propagator(kind="sgp4"), knots_s),
    ]
    if count <= BASILISK_COUNT_MAX:
        seconds = np.arange(1.0, BATCH_S + 1.0)
        wanted += [
            ("basilisk 0.1 s, point", BasiliskPropagator(kind="basilisk"), knots_s),
            ("basilisk 1 s, point", BasiliskPropagator(kind="basilisk", step_s=1.0), seconds),
        ]
    for name, settings, times_s in wanted:
        try:
            load_propagator(settings.kind)
        except MissingExtraError as error:
            print(f"{name}: left out: {error}", file=sys.stderr)
            continue
        yield name, batch_of(settings, count, times_s)
        if name.startswith("basilisk"):
            yield name.replace("point", "rigid"), rigid_batch(count, times_s)


def batch_of(settings: AnyPropagator, count: int, knots_s: Array) -> Callable[[], object]:
    """Return what computes a batch as the host has it computed."""
    parameters, states = problem(settings, count), orbits(count)
    return lambda: propagate(states, 0.0, knots_s, parameters)


def rigid_batch(count: int, knots_s: Array) -> Callable[[], object]:
    """Return what computes a batch with Basilisk's spacecraft as it comes."""
    from madns_runtime.simulations.constellation.truth.propagators.basilisk_simulation import (
        BasiliskSimulation,
        Design,
        ForcesAndTorques,
    )

    step_ns = round(float(knots_s[0]) * 1e9)
    design = Design(
        count=count,
        step_ns=step_ns,
        knot_ns=step_ns,
        gravity=EGM_96,
        has_j2=True,
        has_thrust=False,
        rotates_points=True,
    )
    simulation, states, pushes = BasiliskSimulation(design), orbits(count), ForcesAndTorques()
    return lambda: simulation.run(states, len(knots_s), pushes)


def problem(settings: AnyPropagator, count: int) -> PropagationParameters:
    """Return the parameters; satellites of element sets are ten, as often as it takes."""
    sets = read_element_sets(SETS)
    return PropagationParameters(
        settings=settings,
        gravity=EGM_96,
        epoch_utc=datetime(2017, 3, 7, 12, tzinfo=UTC),
        element_sets=tuple(sets[n % len(sets)] for n in range(count)),
    )


def orbits(count: int) -> Array:
    """Return states of circular orbits at 780 km in all directions, shape (count, 6)."""
    rng = np.random.default_rng(780)
    radius_m = EGM_96.radius_m + 780e3
    r = rng.normal(size=(count, 3))
    r /= np.linalg.norm(r, axis=1, keepdims=True)
    v = np.cross(r, rng.normal(size=(count, 3)))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    return np.hstack((r * radius_m, v * math.sqrt(EGM_96.mu_m3_s2 / radius_m)))


def alone_settings() -> Iterator[tuple[str, AnyPropagator]]:
    """Yield who can compute one vehicle anew after a maneuver."""
    yield "scipy", ScipyPropagator(kind="scipy")
    for settings in (NumbaPropagator(kind="numba"), BasiliskPropagator(kind="basilisk")):
        try:
            load_propagator(settings.kind)
        except MissingExtraError:
            continue
        yield settings.kind, settings


def alone(settings: AnyPropagator) -> dict[str, float]:
    """Return how long one vehicle's batch takes anew from another state each time, ms."""
    parameters = replace(problem(settings, 1), element_sets=())
    knots_s = np.arange(1, STATES + 1) * (BATCH_S / STATES)
    states = orbits(ALONE_ROUNDS)
    for n in range(20):
        propagate(states[n : n + 1], 0.0, knots_s, parameters)
    times_ms = [
        timed_ms(lambda row=states[n : n + 1]: propagate(row, 0.0, knots_s, parameters))
        for n in range(ALONE_ROUNDS)
    ]
    return {"p50": float(np.percentile(times_ms, 50)), "p99": float(np.percentile(times_ms, 99))}


def timed_ms(act: Callable[[], object]) -> float:
    """Return how long it took, ms."""
    start_s = time.perf_counter()
    act()
    return (time.perf_counter() - start_s) * 1e3


def print_times(times_ms: Times) -> None:
    """Print medians, and how many times the default's they are."""
    print(
        "One batch: 10 s, 100 states per vehicle (Basilisk at 1 s: 10); median ms (times the default)"
    )
    names = list(dict.fromkeys(name for row in times_ms.values() for name in row))
    print(f"  {'vehicles':24}" + "".join(f"{count:>20}" for count in times_ms))
    for name in names:
        cells = []
        for row in times_ms.values():
            if name not in row:
                cells.append("left out")
                continue
            median, own = statistics.median(row[name]), statistics.median(row[DEFAULT])
            cells.append(f"{short(median)} ({short(median / own)}x)")
        print(f"  {name:24}" + "".join(f"{cell:>20}" for cell in cells))
    if any(count > BASILISK_COUNT_MAX for count in times_ms):
        print(f"  Basilisk is left out beyond {BASILISK_COUNT_MAX} vehicles.")


def short(number: float) -> str:
    """Return a number with two digits or, above that, whole."""
    return f"{number:.0f}" if number >= 10.0 else f"{number:.2g}"


def print_alone(alone_ms: dict[str, dict[str, float]]) -> None:
    """Print percentiles of one vehicle's re-propagation."""
    print("\nOne vehicle anew, 10 s, 100 states; ms")
    for kind, figures in alone_ms.items():
        print(f"  {kind:24}p50 {figures['p50']:.3f}   p99 {figures['p99']:.3f}")


def print_agreement(agreement: dict[str, float]) -> None:
    """Print the largest distance from the default's positions."""
    print("\nLargest distance from the default's positions over 4 h, m")
    for name, distance_m in agreement.items():
        print(f"  {name:40}{distance_m:.1e}")


def print_goals(
    times_ms: Times, alone_ms: dict[str, dict[str, float]], agreement: dict[str, float]
) -> None:
    """Print each goal with what was measured."""
    print("\nGoals")
    for where, count, least in GOALS:
        row = times_ms.get(count, {})
        for rival in RIVALS:
            if rival in row:
                ratio = statistics.median(row[rival]) / statistics.median(row[DEFAULT])
                goal = f"default over {rival}, {where}: >= {least:g}x"
                judge(goal, f"{ratio:.0f}x", ratio >= least)
            else:
                print(f"  not measured  default over {rival}, {where}")
    worst_m = max(agreement.values(), default=math.nan)
    limit = f"agreement over 4 h: <= {AGREEMENT_M:g} m"
    judge(limit, f"{worst_m:.1e} m", worst_m <= AGREEMENT_M)
    for kind in ("scipy", "numba"):
        if kind in alone_ms:
            p99 = alone_ms[kind]["p99"]
            limit = f"one vehicle anew, {kind}, p99: <= {ALONE_MS_P99:g} ms"
            judge(limit, f"{p99:.3f} ms", p99 <= ALONE_MS_P99)


def judge(goal: str, got: str, is_met: bool) -> None:
    """Print one goal."""
    print(f"  {'met' if is_met else 'NOT MET':12}  {goal}: {got}")


if __name__ == "__main__":
    main()
