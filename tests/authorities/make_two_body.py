"""
Write two_body.json: two-body states by universal variables in 60-digit decimal arithmetic.

Shares nothing with the program: other method (universal variables, Stumpff series), other numbers
(decimal), other input (states, not elements). Run it with plain Python to make the file again.
Source of the method: Battin, An Introduction to the Mathematics and Methods of Astrodynamics, 4.5.
"""

import json
from decimal import Decimal, getcontext
from pathlib import Path

getcontext().prec = 60
MU_M3_S2 = Decimal(398600441500000)
CASES = {
    "circular LEO at 780 km, 86.4 deg": (
        (7158136.3, 0.0, 0.0),
        (0.0, 468.55625, 7447.53125),
    ),
    "elliptic LEO, e 0.02": ((-4500000.5, 4200000.25, 3100000.0), (-5200.5, -5600.25, 300.125)),
    "Molniya, e 0.72, from perigee": ((3100000.0, 0.0, -6100000.0), (0.0, 10022.5, 0.0)),
    "geostationary": ((42164170.0, 0.0, 0.0), (0.0, 3074.65625, 0.0)),
    "retrograde, e 0.09": ((0.0, -7500000.0, 100000.0), (-7000.0, 0.0, 3000.0)),
}
TIMES_S = (10, 600, 3600, 7200, 14400)


def stumpff(z):
    """Return c2 and c3 of z by their series: sums of (-z)^k / (2k+2)! and / (2k+3)!."""
    c2 = c3 = Decimal(0)
    term = Decimal(1) / 2
    k = 0
    while abs(term) > Decimal(10) ** -58:
        c2 += term
        c3 += term / (2 * k + 3)
        k += 1
        term *= -z / ((2 * k + 1) * (2 * k + 2))
    return c2, c3


def propagate(r, v, t):
    """Return position and velocity after t seconds."""
    r, v = [Decimal(x) for x in r], [Decimal(x) for x in v]
    t, root = Decimal(t), MU_M3_S2.sqrt()
    r0 = sum(x * x for x in r).sqrt()
    sigma = sum(a * b for a, b in zip(r, v, strict=True)) / root
    alpha = 2 / r0 - sum(x * x for x in v) / MU_M3_S2
    chi = root * alpha * t
    for _ in range(200):
        c2, c3 = stumpff(alpha * chi * chi)
        time = sigma * chi**2 * c2 + (1 - alpha * r0) * chi**3 * c3 + r0 * chi
        slope = (
            chi**2 * c2 + sigma * chi * (1 - alpha * chi**2 * c3) + r0 * (1 - alpha * chi**2 * c2)
        )
        step = (root * t - time) / slope
        chi += step
        if abs(step) < Decimal(10) ** -45:
            break
    else:
        raise ArithmeticError("Newton's method did not end")
    c2, c3 = stumpff(alpha * chi * chi)
    f, g = 1 - chi**2 * c2 / r0, t - chi**3 * c3 / root
    position = [f * a + g * b for a, b in zip(r, v, strict=True)]
    radius = sum(x * x for x in position).sqrt()
    f_dot = root / (radius * r0) * chi * (alpha * chi**2 * c3 - 1)
    g_dot = 1 - chi**2 * c2 / radius
    assert abs(f * g_dot - f_dot * g - 1) < Decimal(10) ** -40
    return position, [f_dot * a + g_dot * b for a, b in zip(r, v, strict=True)]


def main():
    """Write the file beside this one."""
    cases = []
    for name, (r, v) in CASES.items():
        states = []
        for t in TIMES_S:
            position, velocity = propagate(r, v, t)
            states.append([t, *(float(x) for x in position + velocity)])
        cases.append({"name": name, "state_m_m_s": [*r, *v], "t_s_and_states": states})
    document = {
        "source": "make_two_body.py: universal variables in 60-digit decimals, rounded to float64",
        "mu_m3_s2": float(MU_M3_S2),
        "cases": cases,
    }
    path = Path(__file__).with_name("two_body.json")
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
