"""
Visibility: line of sight past the Earth, light time, elevation over a place. Pure; SI units.

The Earth is the WGS-84 ellipsoid, both radii raised by the height of the atmosphere that blocks a link.
An ellipsoid costs no more than a sphere: scaled along each axis it is one, and lines stay lines.
Signals travel straight and at the speed of light in vacuum: no refraction, no relativity.

Frame of all positions: inertial, with z along the Earth's axis (TEME).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from madns_runtime.simulations.constellation.orbit.constants import (
    EARTH_POLAR_RADIUS_M,
    EARTH_RADIUS_M,
    EGM_96,
)
from madns_runtime.simulations.constellation.orbit.elements import (
    elements_from_state,
    state_from_elements,
)

LIGHT_SPEED_M_S = 299_792_458.0
"""Exact, by the definition of the metre."""
SERIES_S_MAX = 10.0
"""So long a time is coasted by a series, whose error grows with its fourth power."""


def has_line_of_sight(first: Sequence[float], second: Sequence[float], height_m: float) -> bool:
    """
    Return whether the straight line between two positions stays above a height over the ellipsoid.

    Plain numbers: this is asked once per message, where arrays of three would cost ten times as much.

    Args:
        first: Position, m; further numbers are ignored.
        second: The same.
        height_m: Height that both radii of the ellipsoid are raised by, m; an end below it sees nothing.
    """
    equator, pole = EARTH_RADIUS_M + height_m, EARTH_POLAR_RADIUS_M + height_m
    x, y, z = first[0] / equator, first[1] / equator, first[2] / pole
    dx, dy, dz = second[0] / equator - x, second[1] / equator - y, second[2] / pole - z
    square = dx * dx + dy * dy + dz * dz
    along = -(x * dx + y * dy + z * dz)
    # The point of the line nearest to the centre, within its ends.
    share = 0.0 if along <= 0.0 else 1.0 if along >= square else along / square
    x, y, z = x + share * dx, y + share * dy, z + share * dz
    return x * x + y * y + z * z >= 1.0


def have_line_of_sight(
    first: NDArray[np.float64], second: NDArray[np.float64], height_m: float
) -> NDArray[np.bool_]:
    """
    Return the same as `has_line_of_sight` for many pairs at once.

    Args:
        first: Positions, shape (..., 3), m.
        second: Positions, shape (..., 3), m; the two are broadcast against each other.
        height_m: As there.

    Returns:
        Shape (...).
    """
    equator, pole = EARTH_RADIUS_M + height_m, EARTH_POLAR_RADIUS_M + height_m
    scale = np.array((equator, equator, pole))
    start = first / scale
    way = second / scale - start
    square = np.maximum((way * way).sum(axis=-1), np.finfo(np.float64).tiny)
    share = np.clip(-(start * way).sum(axis=-1) / square, 0.0, 1.0)
    nearest = start + share[..., None] * way
    clear: NDArray[np.bool_] = (nearest * nearest).sum(axis=-1) >= 1.0
    return clear


def signal_way(
    sender_r_m: Sequence[float], receiver: Sequence[float]
) -> tuple[float, tuple[float, float, float]]:
    """
    Return how far a signal travels, and where it meets its receiver.

    One iteration: the receiver moves on a straight line for as long as light takes to where it was when
    the signal left. What that leaves is v/c of that motion: below 2 mm over 5000 km at 8 km/s.

    Args:
        sender_r_m: Position when the signal leaves, m; further numbers are ignored.
        receiver: Position, m, and velocity, m/s, at the same time: six numbers.

    Returns:
        Distance, m, and the receiver's position when the signal arrives, m.
    """
    x, y, z = sender_r_m[0], sender_r_m[1], sender_r_m[2]
    rx, ry, rz, vx, vy, vz = receiver[:6]
    light_s = math.sqrt((rx - x) ** 2 + (ry - y) ** 2 + (rz - z) ** 2) / LIGHT_SPEED_M_S
    rx, ry, rz = rx + vx * light_s, ry + vy * light_s, rz + vz * light_s
    return math.sqrt((rx - x) ** 2 + (ry - y) ** 2 + (rz - z) ** 2), (rx, ry, rz)


def signal_ways(
    sender_r_m: NDArray[np.float64], receivers: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """
    Return the same as `signal_way` for many receivers.

    Args:
        sender_r_m: Position, shape (3,), m.
        receivers: Positions and velocities, shape (N, 6), m and m/s.

    Returns:
        Distances, shape (N,), m, and positions at arrival, shape (N, 3), m.
    """
    r, v = receivers[:, :3], receivers[:, 3:]
    light_s = np.sqrt(((r - sender_r_m) ** 2).sum(axis=1)) / LIGHT_SPEED_M_S
    r = r + v * light_s[:, None]
    return np.sqrt(((r - sender_r_m) ** 2).sum(axis=1)), r


def coast(states: NDArray[np.float64], dt_s: float) -> NDArray[np.float64]:
    """
    Return where vehicles are a while later, under a point mass, without propagation.

    For up to SERIES_S_MAX by Taylor's series to the third power, in LEO 4 mm off by then beside 60 cm of
    J2; for longer along the osculating ellipse, which J2 leaves by 90 m in two minutes. An open orbit,
    which has none, is left to the series.

    Args:
        states: Positions and velocities, shape (..., 6), m and m/s.
        dt_s: Seconds later.

    Returns:
        Positions and velocities, shape (..., 6).

    Source: the f and g series, Bate, Mueller and White, Fundamentals of Astrodynamics, section 5.5.
    """
    if dt_s > SERIES_S_MAX:
        rows = [_along_orbit(row, dt_s) for row in states.reshape(-1, 6)]
        return np.array(rows).reshape(states.shape)
    return _along_series(states, dt_s)


def _along_orbit(state: NDArray[np.float64], dt_s: float) -> NDArray[np.float64]:
    x, y, z, vx, vy, vz = state.tolist()
    try:
        now = elements_from_state((x, y, z), (vx, vy, vz), EGM_96.mu_m3_s2)
    except ValueError:
        return _along_series(state, dt_s)
    rate_rad_s = math.sqrt(EGM_96.mu_m3_s2 / now.a_m**3)
    then = replace(now, mean_anomaly_rad=now.mean_anomaly_rad + rate_rad_s * dt_s)
    return np.concatenate(state_from_elements(then, EGM_96.mu_m3_s2))


def _along_series(states: NDArray[np.float64], dt_s: float) -> NDArray[np.float64]:
    r, v = states[..., :3], states[..., 3:]
    square = (r * r).sum(axis=-1, keepdims=True)
    u = EGM_96.mu_m3_s2 / (square * np.sqrt(square))
    p = (r * v).sum(axis=-1, keepdims=True) / square
    up = u * p
    f = 1.0 + dt_s * dt_s * (-0.5 * u + 0.5 * up * dt_s)
    g = dt_s * (1.0 - u * dt_s * dt_s / 6.0)
    f_rate = dt_s * (-u + 1.5 * up * dt_s)
    g_rate = 1.0 - 0.5 * u * dt_s * dt_s
    return np.concatenate((f * r + g * v, f_rate * r + g_rate * v), axis=-1)


def sines_of_elevation(
    sites_r_m: NDArray[np.float64],
    sites_up: NDArray[np.float64],
    states: NDArray[np.float64],
    turn_rad_s: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """
    Return the sines of the elevations of vehicles over places, and their rates.

    Geometric: where the vehicle is at that very time, without refraction and light time.

    Args:
        sites_r_m: Places, shape (S, 3), m.
        sites_up: Unit vectors to their zeniths, shape (S, 3).
        states: Vehicles, shape (N, 6), m and m/s.
        turn_rad_s: The Earth's rate about z, rad/s.

    Returns:
        Sines and their rates, 1/s, each of shape (S, N).
    """
    way = states[None, :, :3] - sites_r_m[:, None, :]
    # Seen from the turning Earth, where the zenith stands still.
    r, v = states[:, :3], states[:, 3:]
    turned = np.stack(
        (v[:, 0] + turn_rad_s * r[:, 1], v[:, 1] - turn_rad_s * r[:, 0], v[:, 2]), axis=-1
    )
    distance = np.sqrt((way * way).sum(axis=-1))
    sine = (way @ sites_up[:, :, None])[..., 0] / distance
    rise = sites_up @ turned.T
    closing = (way * turned[None, :, :]).sum(axis=-1) / distance
    return sine, (rise - sine * closing) / distance
