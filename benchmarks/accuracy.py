"""The accuracy of truth as tables; run by `python benchmarks/truth.py --accuracy`, which prints Markdown."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
import sgp4
from accuracy_edges import perigee_rows, record_rows, turning_rows
from numpy.typing import NDArray

from madns_runtime.errors import ConfigurationError, MissingExtraError
from madns_runtime.simulations.constellation.equipment import Attitude
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.elements import Elements, state_from_elements
from madns_runtime.simulations.constellation.orbit.interpolation import interpolate
from madns_runtime.simulations.constellation.orbit.invariants import ENERGY, specific_energy
from madns_runtime.simulations.constellation.parameters import (
    AnyPropagator,
    BasiliskPropagator,
    NumbaPropagator,
    ScipyPropagator,
)
from madns_runtime.simulations.constellation.truth.element_sets import read_element_sets
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    conserved_by,
    load_propagator,
    propagate,
)
from madns_runtime.simulations.constellation.truth.propagators.attitude import propagate_attitude
from madns_runtime.simulations.constellation.truth.propagators.rigid_body import (
    RigidBody,
    initial_attitude,
)
from madns_runtime.simulations.constellation.truth.propagators.sgp4_propagator import sgp4_states
from madns_runtime.simulations.constellation.truth.tle_files import tle_checksum

ROOT = Path(__file__).parents[1]
TWO_BODY = ROOT / "tests/authorities/two_body.json"
HOURS_4_S = 14_400.0
ALL = ("two_body", "j2", "j3", "j4", "drag")

Array = NDArray[np.float64]
Row = tuple[str, ...]


class Section(NamedTuple):
    """One table."""

    title: str
    text: str
    head: tuple[str, ...]
    rows: Callable[[], Iterator[Row]]


def print_tables() -> None:
    """Print every table, with what it says."""
    for section in SECTIONS:
        print(heading(section))
        for row in section.rows():
            print(f"| {' | '.join(row)} |")
        print()


def heading(section: Section) -> str:
    """Return all of a section that is not measured."""
    head = f"| {' | '.join(section.head)} |\n|{'---|' * len(section.head)}"
    return f"## {section.title}\n\n{section.text}\n\n{head}"


def agreement_m() -> dict[str, float]:
    """Return the largest distance of each propagator from scipy's positions over 4 h, m."""
    return {
        f"{kind}: {forces}": distance_m
        for forces, kind, distance_m in agreements(with_all=False, coarse=False)
    }


def kinds(forces: tuple[str, ...], *, coarse: bool = True) -> Iterator[tuple[str, AnyPropagator]]:
    """Yield the installed propagators that have these forces, scipy first."""
    yield "scipy", ScipyPropagator(kind="scipy", forces=forces)
    wanted: list[tuple[str, AnyPropagator]] = [
        ("numba", NumbaPropagator(kind="numba", forces=forces))
    ]
    if set(forces) <= {"two_body", "j2"}:
        steps_s = (0.1, 1.0) if coarse else (0.1,)
        wanted += [
            (
                f"basilisk {step_s:g} s",
                BasiliskPropagator(kind="basilisk", forces=forces, step_s=step_s),
            )
            for step_s in steps_s
        ]
    for name, settings in wanted:
        try:
            load_propagator(settings.kind)
        except MissingExtraError:
            continue
        yield name, settings


def problem(settings: AnyPropagator, vehicles: int) -> PropagationParameters:
    """Return parameters with a ballistic coefficient for each vehicle, which acts if drag is asked for."""
    return PropagationParameters(
        settings=settings,
        gravity=EGM_96,
        epoch_utc=datetime(2000, 1, 1, 12, tzinfo=UTC),
        ballistic_m2_kg=np.linspace(0.0, 0.02, vehicles),
    )


def orbits(count: int = 20) -> Array:
    """Return states of low orbits in all directions and, last, of one of e = 0.7, shape (count + 1, 6)."""
    rng = np.random.default_rng(4)
    angles = math.tau * rng.random((count + 1, 4))
    rows = []
    for n, (raan, argp, mean, i) in enumerate(angles):
        is_last = n == count
        orbit = Elements(
            a_m=2.66e7 if is_last else EGM_96.radius_m + 500e3 + 700e3 * n / count,
            e=0.7 if is_last else 0.002,
            i_rad=i / 2.0,
            raan_rad=raan,
            argp_rad=argp,
            mean_anomaly_rad=mean,
        )
        r, v = state_from_elements(orbit, EGM_96.mu_m3_s2)
        rows.append((*r, *v))
    return np.array(rows)


def two_body_rows() -> Iterator[Row]:
    """Yield errors against the authority, in one call and in windows of 100 s."""
    cases = json.loads(TWO_BODY.read_text())["cases"]
    states = np.array([case["state_m_m_s"] for case in cases])
    table = np.array([case["t_s_and_states"] for case in cases])
    times_s, expected = table[0, :, 0], table[:, :, 1:]
    for name, settings in kinds(("two_body",)):
        parameters = problem(settings, len(states))
        yield (name, *errors(propagate(states, 0.0, times_s, parameters), expected))
        if name.startswith("basilisk"):
            continue
        found, at = np.empty_like(expected), states
        for window in range(round(HOURS_4_S / 100.0)):
            inside = (times_s > 100.0 * window) & (times_s <= 100.0 * (window + 1))
            knots_s = np.append(times_s[inside], 100.0 * (window + 1))
            stretch = propagate(at, 100.0 * window, knots_s, parameters)
            found[:, inside], at = stretch[:, :-1], stretch[:, -1]
        yield (f"{name}, 144 calls of 100 s", *errors(found, expected))


def errors(found: Array, expected: Array) -> Row:
    """Return the largest error of position and velocity as text."""
    difference = found - expected
    r = np.linalg.norm(difference[..., :3], axis=-1).max()
    v = np.linalg.norm(difference[..., 3:], axis=-1).max()
    return f"{r:.0e}", f"{v:.0e}"


def agreements(*, with_all: bool, coarse: bool) -> Iterator[tuple[str, str, float]]:
    """Yield forces, propagator and its largest distance from scipy's positions, m."""
    knots_s = np.arange(0.0, HOURS_4_S + 1.0, 600.0)
    for forces in (ALL[:1], ALL[:2], ALL)[: 3 if with_all else 2]:
        expected: Array | None = None
        for name, settings in kinds(forces, coarse=coarse):
            # Basilisk takes its time for each vehicle.
            states = orbits() if not name.startswith("basilisk") else orbits()[::5]
            found = propagate(states, 0.0, knots_s, problem(settings, len(states)))
            if expected is None:
                expected = found
                continue
            same = expected if len(found) == len(expected) else expected[::5]
            distance_m = float(np.linalg.norm((found - same)[..., :3], axis=-1).max())
            yield "+".join(forces), name, distance_m


def agreement_rows() -> Iterator[Row]:
    """Yield distances from scipy as text."""
    for forces, name, distance_m in agreements(with_all=True, coarse=True):
        yield forces, name, f"{distance_m:.0e}"


def drift_rows() -> Iterator[Row]:
    """Yield drifts of energy and axial momentum."""
    for forces in (ALL[:1], ALL[:2], ALL[:4]):
        for name, settings in kinds(forces):
            hours = 4 if name.startswith("basilisk") else 24
            states = orbits()[::5]
            parameters = problem(settings, len(states))
            knots_s = np.arange(0.0, hours * 3600.0 + 1.0, 300.0)
            values = conserved_by(propagate(states, 0.0, knots_s, parameters), parameters)
            energy = np.abs(values[..., ENERGY] / values[:, :1, ENERGY] - 1.0).max()
            momentum = np.abs(values[..., 2] - values[:, :1, 2]) / values[:, :1, 1]
            yield "+".join(forces), name, str(hours), f"{energy:.0e}", f"{momentum.max():.0e}"


def knot_rows() -> Iterator[Row]:
    """Yield errors of interpolation for some distances of knots."""
    radius_m = EGM_96.radius_m + 780e3
    speed = math.sqrt(EGM_96.mu_m3_s2 / radius_m)
    state = np.array([[radius_m, 0.0, 0.0, 0.0, 0.1 * speed, math.sqrt(0.99) * speed]])
    parameters = problem(ScipyPropagator(kind="scipy"), 1)
    for knot_s in (0.1, 1.0, 2.0, 5.0, 10.0):
        knots_s = np.arange(0.0, 601.0, knot_s)
        times_s = (knots_s[:-1, None] + knot_s * np.array((0.25, 0.5, 0.75))).ravel()
        knots = propagate(state, 0.0, knots_s, parameters)[0]
        found = interpolate(knots, times_s, t0_s=0.0, knot_s=knot_s)
        expected = propagate(state, 0.0, times_s, parameters)[0]
        yield (f"{knot_s:g}", *errors(found, expected))


def drag_rows() -> Iterator[Row]:
    """Yield the relative difference of energy lost from the analytic one."""
    from madns_runtime.simulations.constellation.orbit.constants import EARTH_RATE_RAD_S

    a_m, ballistic, density = EGM_96.radius_m + 400e3, 1e-3, 3.725e-12
    speed = math.sqrt(EGM_96.mu_m3_s2 / a_m)
    period_s = math.tau * a_m / speed
    wind = speed - EARTH_RATE_RAD_S * a_m
    expected = -0.5 * ballistic * density * wind**2 * speed * period_s
    state = np.array([[a_m, 0.0, 0.0, 0.0, speed, 0.0]])
    for name, settings in kinds(("two_body", "drag")):
        parameters = PropagationParameters(
            settings=settings,
            gravity=EGM_96,
            epoch_utc=datetime(2000, 1, 1, 12, tzinfo=UTC),
            ballistic_m2_kg=np.array([ballistic]),
        )
        end = propagate(state, 0.0, np.array([period_s]), parameters)[0]
        lost = specific_energy(end, EGM_96, with_j2=False)[0] + speed**2 / 2.0
        yield name, f"{abs(lost / expected - 1.0):.0e}"


def sgp4_rows() -> Iterator[Row]:
    """Yield the worst difference from the verification vectors."""
    folder = Path(sgp4.__file__).parent
    lines = [x for x in (folder / "SGP4-VER.TLE").read_text().splitlines() if x[:1] in "12"]
    sets = {}
    for first, second in zip(lines[::2], lines[1::2], strict=True):
        sets.setdefault(int(first[2:7]), (first[:68], second[:68]))
    vectors: dict[int, list[list[float]]] = {}
    number = 0
    for line in (folder / "tcppver.out").read_text().splitlines():
        words = line.split()
        if words[1:] == ["xx"]:
            number = int(words[0])
        elif len(words) >= 7:
            vectors.setdefault(number, []).append([float(word) for word in words[:7]])
    sets_compared, compared, worst = 0, 0, np.zeros(2)
    for number, rows in vectors.items():
        table = np.array(rows)
        try:
            found = verified_states(sets[number], table[:, 0] * 60.0) / 1000.0
        except ConfigurationError:
            continue  # one set is there to be refused
        sets_compared += 1
        compared += len(rows)
        difference = np.abs(found - table[:, 1:])
        worst = np.maximum(worst, (difference[:, :3].max(), difference[:, 3:].max()))
    yield str(sets_compared), str(compared), f"{worst[0]:.0e}", f"{worst[1]:.0e}"


def verified_states(lines: tuple[str, str], times_s: Array) -> Array:
    """Return the states of a set, some of which come without their checksums."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "one.tle"
        path.write_text("\n".join(line + str(tle_checksum(line)) for line in lines))
        found = read_element_sets(path)
    return sgp4_states(found, found[0].epoch_utc, times_s)[0]


def rigid_rows() -> Iterator[Row]:
    """Yield the largest difference from Basilisk's rigid bodies, if it is installed."""
    settings = BasiliskPropagator(kind="basilisk", step_s=0.05)
    try:
        load_propagator(settings.kind)
    except MissingExtraError:
        return
    inertia = (10.0, 24.0, 17.0)
    attitude = Attitude(inertia_kg_m2=inertia, rates_deg_s=(1.0, -2.0, 0.5))
    states = np.array([(*s, *initial_attitude(attitude, s[:3], s[3:])) for s in orbits()[:3]])
    torques = ((1e-3, 0.0, -5e-4), (0.0, 2e-4, 0.0), (0.0, 0.0, 0.0))
    bodies = [RigidBody(inertia_kg_m2=inertia, torque_n_m=torque) for torque in torques]
    knots_s = np.arange(1, 61) * 60.0
    ours, theirs = (
        propagate_attitude(
            bodies, states, t0_s=0.0, knots_s=knots_s, parameters=problem(each, len(states))
        )
        for each in (ScipyPropagator(kind="scipy"), settings)
    )
    q, p = ours[..., 6:10], theirs[..., 6:10]
    same = np.sign(np.sum(q * p, axis=-1, keepdims=True))
    angle = 2.0 * np.linalg.norm(q * same - p, axis=-1).max()
    rates = np.abs(ours[..., 10:] - theirs[..., 10:]).max()
    yield f"{angle:.0e}", f"{rates:.0e}", f"{np.abs(ours - theirs)[..., :3].max():.0e}"


SECTIONS = (
    Section(
        "Two bodies over 4 h",
        "Five orbits from LEO to GEO and e = 0.74 against the authority `tests/authorities/two_body.json` "
        "(60-digit decimals); largest error at any of its times up to 4 h.",
        ("propagator", "position, m", "velocity, m/s"),
        two_body_rows,
    ),
    Section(
        "One another over 4 h",
        "Largest distance from scipy at its defaults, twenty orbits of 500 to 1200 km and one of "
        "e = 0.7; Basilisk, RK4, five of them.",
        ("forces", "propagator", "position, m"),
        agreement_rows,
    ),
    Section(
        "What is conserved",
        "Largest relative drift of specific energy and of angular momentum about the Earth's axis, "
        "same orbits.",
        ("forces", "propagator", "time, h", "energy", "momentum"),
        drift_rows,
    ),
    Section(
        "Between knots",
        "Cubic Hermite interpolation of segments, circular orbit at 780 km under J2.",
        ("knots, s", "position, m", "velocity, m/s"),
        knot_rows,
    ),
    Section(
        "Drag",
        "Energy lost in one revolution of a circular equatorial orbit at 400 km, B = 0.001 m^2/kg, "
        "against -B rho w^2 v / 2 with w the speed against the turning air. The metre that it sinks "
        "in the meantime makes air denser by 1e-5.",
        ("propagator", "relative difference"),
        drag_rows,
    ),
    Section(
        "Drag through a low perigee",
        "A day of a transfer orbit up to 35,786 km, B = 0.01 m^2/kg, under J2, against numba at steps of "
        "0.1 s (which is 2e-3 m from its steps of 0.3 s).",
        ("perigee, km", "scipy, m", "numba, m", "numba, windows of 10 s, m"),
        perigee_rows,
    ),
    Section(
        "Attitude between knots",
        "A body like a plate (moments 1, 1.9 and 2.8 kg m^2) that tumbles for 30 s, knots 1 s apart: the "
        "largest error, rad, by 7 times in each interval, and what the host tells of the knots alone.",
        ("rate, deg/s", "error", "told"),
        turning_rows,
    ),
    Section(
        "Flown on from records",
        "Twenty-one orbits under J2, flown on for a day from a state rounded as it is recorded; distance "
        "from the same state unrounded. The host's own records have every bit.",
        ("record", "position, m"),
        lambda: record_rows(orbits()),
    ),
    Section(
        "SGP4",
        "Against the verification vectors shipped with the sgp4 package (AIAA 2006-6753); "
        "the vectors are printed to 1e-8 km.",
        ("sets", "states", "position, km", "velocity, km/s"),
        sgp4_rows,
    ),
    Section(
        "Rigid bodies",
        "Attitude and rates against Basilisk's rigid body at a step of 0.05 s over 1 h: gravity "
        "gradient, constant torques of up to 1 mN m, rates of up to 2 deg/s, orbit under J2.",
        ("attitude, rad", "body rates, rad/s", "position, m"),
        rigid_rows,
    ),
)
"""The tables, in the order of docs/accuracy.md."""
