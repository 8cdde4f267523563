"""
The propagators: each computes states at knots from states at a time, for many vehicles in one call.

They stand behind one signature, `propagate(states (N, 6) in m and m/s, t0_s, knots_s, parameters) -> (N, K, 6)`,
so that a scenario chooses one by name: numerical integration by scipy, in machine code by numba or by
Basilisk, mean elements by SGP4, or a class of the user's own. `forces` holds the accelerations that the
integrators share, `attitude` integrates that of a `rigid_body` along its orbit.
"""
