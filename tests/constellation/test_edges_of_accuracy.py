"""Where truth is least exact: bends of the air, bodies that spin, rounding of records, UT1, the edge of the shadow."""

import math
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from constellation_fakes import SCENARIOS, Star, parameters, state_rows

from madns_runtime.simulations.constellation.host_side.model_health import CHECK
from madns_runtime.simulations.constellation.orbit.atmosphere import STEP_S_MIN, kink_step_s
from madns_runtime.simulations.constellation.orbit.constants import EARTH_RADIUS_M, EGM_96
from madns_runtime.simulations.constellation.orbit.elements import Elements, state_from_elements
from madns_runtime.simulations.constellation.orbit.interpolation import (
    evaluate_turn,
    knot_error_rad,
    turn_between,
)
from madns_runtime.simulations.constellation.orbit.quaternions import rotation_between
from madns_runtime.simulations.constellation.orbit.sun import (
    ASTRONOMICAL_UNIT_M,
    SUN_RADIUS_M,
    is_in_umbra,
)
from madns_runtime.simulations.constellation.parameters import (
    GroundStation,
    NumbaPropagator,
    ScipyPropagator,
)
from madns_runtime.simulations.constellation.truth.element_sets import read_element_sets
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    propagate,
)
from madns_runtime.simulations.constellation.truth.propagators.attitude import propagate_attitude
from madns_runtime.simulations.constellation.truth.propagators.rigid_body import RigidBody
from madns_runtime.simulations.constellation.truth.propagators.sgp4_propagator import sgp4_states
from madns_runtime.simulations.constellation.truth.radio.passes import Sites

DAY_S = 86_400.0
EPOCH = datetime(2017, 3, 7, 12, tzinfo=UTC)


def problem(settings, **rest):
    return PropagationParameters(
        settings=settings,
        gravity=EGM_96,
        epoch_utc=datetime(2000, 1, 1, 12, tzinfo=UTC),
        **rest,
    )


# --- drag through a low perigee ------------------------------------------------------------------


def transfer_orbit(perigee_m):
    low, high = EGM_96.radius_m + perigee_m, EGM_96.radius_m + 35_786e3
    orbit = Elements(
        a_m=(low + high) / 2.0,
        e=(high - low) / (high + low),
        i_rad=0.1,
        raan_rad=0.3,
        argp_rad=1.0,
        mean_anomaly_rad=2.0,
    )
    r, v = state_from_elements(orbit, EGM_96.mu_m3_s2)
    return np.array([[*r, *v]])


def after_a_day(settings, states, window_s):
    dragged = problem(settings, ballistic_m2_kg=np.array([0.01]))
    for window in range(round(DAY_S / window_s)):
        from_s, until_s = window * window_s, (window + 1) * window_s
        knots_s = np.array([(from_s + until_s) / 2.0, until_s])
        states = propagate(states, from_s, knots_s, dragged)[:, -1]
    return states[0, :3]


@pytest.mark.slow
@pytest.mark.parametrize(
    "perigee_km",
    [pytest.param(150, marks=pytest.mark.nightly), pytest.param(185, marks=pytest.mark.nightly)],
)
def test_drag_through_a_low_perigee_errs_centimetres_in_a_day(perigee_km):
    pytest.importorskip("numba")
    forces = ("two_body", "j2", "drag")
    start = transfer_orbit(1e3 * perigee_km)
    # With steps of at most 0.1 s it differs from that by 2 mm.
    fine = NumbaPropagator(kind="numba", forces=forces, rtol=1e-13, atol_m=1e-9, step_s_max=0.3)
    expected = after_a_day(fine, start, DAY_S)

    for settings in (
        ScipyPropagator(kind="scipy", forces=forces),
        NumbaPropagator(kind="numba", forces=forces),
    ):
        for window_s in (DAY_S, 300.0):
            found = after_a_day(settings, start, window_s)
            # Before steps minded the bends of the density: 0.2 to 1.5 m.
            assert np.linalg.norm(found - expected) < 0.05, (settings.kind, window_s)


def test_steps_are_shorter_where_the_air_bends_and_nowhere_else():
    def step_s(height_m, climb_m_s):
        r = np.array([[EGM_96.radius_m + height_m], [0.0], [0.0]])
        v = np.array([[climb_m_s], [9000.0], [0.0]])
        return kink_step_s(r, v, 0.01, EGM_96.radius_m, step_s_max=30.0)

    assert step_s(780e3, 10.0) == 30.0
    assert step_s(200e3, 0.0) == 30.0
    assert 1.0 < step_s(185e3, 300.0) < 10.0
    # Whoever comes down steeply is there within the step.
    assert step_s(220e3, -1000.0) < 10.0
    assert step_s(50e3, 500.0) == STEP_S_MIN


# --- attitude between knots ----------------------------------------------------------------------

PLATE = (1.0, 1.9, 2.8)
LEO = (7.158e6, 0.0, 0.0, 0.0, 1e3, 7.4e3)


def turning(inertia, rates_deg_s, times_s):
    state = np.array([[*LEO, 0.0, 0.0, 0.0, 1.0, *np.radians(rates_deg_s)]])
    body = RigidBody(inertia_kg_m2=inertia)
    kind = problem(ScipyPropagator(kind="scipy"))
    return propagate_attitude([body], state, t0_s=0.0, knots_s=times_s, parameters=kind)[0, :, 6:]


def worst_between_knots_rad(fine, per_knot):
    worst = 0.0
    for first in range(0, len(fine) - per_knot, per_knot):
        turn = turn_between(fine[first].tolist(), fine[first + per_knot].tolist(), 1.0)
        for inside in range(1, per_knot):
            found = evaluate_turn(turn, inside / per_knot, 1.0)
            off = rotation_between(found[:4], fine[first + inside, :4].tolist())
            worst = max(worst, math.hypot(*off))
    return worst


@pytest.mark.slow
@pytest.mark.parametrize("inertia", [PLATE, (10.0, 24.0, 17.0), (12.0, 14.0, 9.0)], ids=str)
@pytest.mark.parametrize("rate_deg_s", [3.0, 30.0, 88.0, 120.0])
def test_knots_tell_how_far_attitude_between_them_is_off(inertia, rate_deg_s):
    direction = np.array([1.0, 0.8, -0.6]) / math.sqrt(2.0)
    fine = turning(inertia, rate_deg_s * direction, np.arange(0.0, 30.01, 0.125))

    expected = worst_between_knots_rad(fine, 8)
    found = knot_error_rad(fine[::8].tolist(), 1.0)

    assert expected / 2.0 < found < 3.0 * expected
    assert (found > 1e-4) == (rate_deg_s > 40.0) or rate_deg_s == 30.0


@pytest.mark.parametrize("rate_deg_s", [5.0, 80.0, 95.0, 175.0])
def test_a_steady_spin_is_no_error(rate_deg_s):
    rows = turning(PLATE, (0.0, 0.0, rate_deg_s), np.arange(0.0, 31.0))

    # Gravity's gradient bends it a little.
    assert knot_error_rad(rows.tolist(), 1.0) < 1e-7


def test_two_knots_tell_nothing():
    rows = turning(PLATE, (9.0, 9.0, 9.0), np.arange(0.0, 2.0))

    assert knot_error_rad(rows.tolist(), 1.0) == 0.0


def spun(rate_deg_s, **rest):
    attitude = {"inertia_kg_m2": list(PLATE), "rates_deg_s": [rate_deg_s, rate_deg_s / 2, 0.0]}
    vehicles = [{"agents": ["agent-02"], "attitude": attitude}, {}]
    star = Star(parameters(vehicles=vehicles, **rest), 2, duration_s=30.0)
    star.run(29.0)
    summary = star.host.finish()
    return summary, {check["name"]: check for check in summary["checks"]}, star.context.logs


@pytest.mark.slow
def test_a_body_too_fast_for_its_knots_is_told_and_breaks_a_check():
    summary, checks, logs = spun(80.0)

    assert checks[CHECK]["passed"] is False
    assert summary["attitude_error_agent"] == "agent-02"
    assert 1e-3 < summary["attitude_error_rad_max"] == checks[CHECK]["got"] < 1e-2
    (said,) = [text for level, text in logs if level == "warning"]
    assert said.startswith("agent-02 turns so fast that its attitude between knots is off by about")
    knot_s = float(said.split("segments.knot_s: ")[1].split()[0])

    # What it advises is enough, and not told again.
    summary, checks, logs = spun(80.0, segments={"knot_s": 0.25 if knot_s >= 0.25 else 0.1})
    assert 0.1 <= knot_s < 1.0
    assert checks[CHECK]["passed"] is True
    assert logs == []


def test_without_rigid_bodies_nothing_is_judged():
    star = Star(parameters(), 2, duration_s=30.0)
    star.run(29.0)

    assert CHECK not in [check["name"] for check in star.host.finish()["checks"]]


# --- records -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_what_is_flown_on_from_an_agents_record_is_under_four_millimetres_off_after_a_day():
    star = Star(parameters(), 6, duration_s=5.0)
    seen = {}
    for name, agent in star.agents.items():

        def lookup(t_s, whole=agent._buffer.lookup, name=name):
            seen[name] = whole(t_s)
            return seen[name]

        agent._buffer.lookup = lookup
    star.run(4.0)

    exact = np.array([seen[name] for name in star.agents])
    recorded = np.array([state_rows(star, name)[-1, 1:] for name in star.agents])
    kind = problem(ScipyPropagator(kind="scipy"))
    flown, flown_on = (propagate(s, 0.0, np.array([DAY_S]), kind)[:, 0] for s in (exact, recorded))
    assert (recorded != exact).any()
    # Rounded to 0.1 mm and 0.1 um/s: 20 mm.
    assert np.linalg.norm((flown_on - flown)[:, :3], axis=1).max() < 4e-3


# --- UT1 -----------------------------------------------------------------------------------------


def rises(sites, states, times_s, mask_deg):
    """Return the times at which each vehicle rises, s, and how far above the mask it then culminates, deg."""
    clear = np.array([sites.clearances(states[:, k], t)[0] for k, t in enumerate(times_s.tolist())])
    found = {}
    for station, vehicle in np.ndindex(clear.shape[1:]):
        sines = clear[:, station, vehicle]
        for k in np.flatnonzero((sines[:-1] < 0.0) & (sines[1:] >= 0.0)).tolist():
            near = slice(max(0, k - 2), k + 4)
            curve = np.polyfit(times_s[near] - times_s[k], sines[near], 5)
            roots = [
                r.real for r in np.roots(curve) if abs(r.imag) < 1e-6 and -0.01 <= r.real <= 5.01
            ]
            below = np.flatnonzero(sines[k + 1 :] < 0.0)
            if not roots or not len(below):
                continue
            summit = sines[k + 1 : k + 1 + below[0]].max() + math.sin(math.radians(mask_deg))
            culmination = math.degrees(math.asin(summit)) - mask_deg
            found.setdefault((station, vehicle), []).append((times_s[k] + roots[0], culmination))
    return found


@pytest.mark.slow
def test_ut1_moves_grazing_passes_by_a_third_of_a_second_and_others_by_a_tenth():
    sets = read_element_sets(SCENARIOS / "data/iridium10.tle")
    places = [(78.2, 15.4), (0, 0), (30, 60), (45, -100), (60, 150), (10, -60), (-35, 20), (-70, 0)]
    stations = [
        GroundStation(name=str(n), latitude_deg=lat, longitude_deg=lon, elevation_deg_min=5.0)
        for n, (lat, lon) in enumerate(places)
    ]
    times_s = np.arange(0.0, 43_200.0, 5.0)
    states = sgp4_states(sets, EPOCH, times_s)
    # UT1 - UTC stays within 0.9 s: the Earth has turned so much farther.
    here, moved = (
        rises(Sites(stations, EPOCH + timedelta(seconds=late_s)), states, times_s, 5.0)
        for late_s in (0.0, 0.9)
    )

    shifts = [
        (abs(other_s - at_s), culmination)
        for pair, passes in here.items()
        for at_s, culmination in passes
        for other_s, _ in moved.get(pair, [])
        if abs(other_s - at_s) < 30.0
    ]
    assert len(shifts) > 200
    assert 0.2 < max(shift for shift, _ in shifts) < 0.4
    assert 0.05 < max(shift for shift, culmination in shifts if culmination > 5.0) < 0.1


# --- the edge of the shadow ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("height_km", "beta_deg", "expected_s"),
    [(400, 0, 8.2), (780, 0, 8.9), (780, 40, 12.9), (780, 50, 17.5), (780, 60, 37.9)],
)
def test_the_penumbra_lasts_nine_seconds_at_least_and_longer_the_more_the_shadow_is_grazed(
    height_km, beta_deg, expected_s
):
    radius_m, beta = EARTH_RADIUS_M + 1e3 * height_km, math.radians(beta_deg)
    rate_rad_s = math.sqrt(EGM_96.mu_m3_s2 / radius_m**3)
    sun = (ASTRONOMICAL_UNIT_M, 0.0, 0.0)

    def place(t_s):
        u = rate_rad_s * t_s
        flat = radius_m * math.cos(beta)
        return (
            -flat * math.cos(u),
            radius_m * math.sin(u),
            radius_m * math.cos(u) * math.sin(beta),
        )

    def is_lit(r_m):
        """The discs do not touch: Montenbruck and Gill, 3.4.2."""
        to_sun = tuple(s - c for s, c in zip(sun, r_m, strict=True))
        distance, r = math.hypot(*to_sun), math.hypot(*r_m)
        cosine = -sum(a * b for a, b in zip(r_m, to_sun, strict=True)) / (r * distance)
        discs = math.asin(SUN_RADIUS_M / distance) + math.asin(EARTH_RADIUS_M / r)
        return math.acos(max(-1.0, min(1.0, cosine))) > discs

    def first(condition):
        low, high = 0.0, math.pi / 2.0 / rate_rad_s
        for _ in range(60):
            middle = (low + high) / 2.0
            low, high = (low, middle) if condition(place(middle)) else (middle, high)
        return high

    leaves_umbra_s, is_lit_s = first(lambda r: not is_in_umbra(r, sun)), first(is_lit)

    assert is_lit_s - leaves_umbra_s == pytest.approx(expected_s, abs=0.1)
