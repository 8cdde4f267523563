"""What a vehicle records beside its truth: one schema a kind, each on its own side of the wall."""

from __future__ import annotations

from madns_runtime.recording.records import Field

ATTITUDE = (
    Field("tick", "", "int"),
    Field("q1", "1"),
    Field("q2", "1"),
    Field("q3", "1"),
    Field("q4", "1"),
    Field("wx_body_rad_s", "rad/s"),
    Field("wy_body_rad_s", "rad/s"),
    Field("wz_body_rad_s", "rad/s"),
)
"""Truth of a rigid body: quaternion, scalar last, inertial to body, and body rates."""

COMMANDS = (
    Field("tick", "", "int"),
    Field("number", "", "int"),
    Field("kind", "", "str"),
    Field("at_s", "s"),
    Field("frame", "", "str"),
    Field("x", "m/s | N m | m^2/kg"),
    Field("y", "m/s | N m"),
    Field("z", "m/s | N m"),
    Field("duration_s", "s"),
)
"""What flight software commanded; what became of it is in command_results."""

COMMAND_RESULTS = (
    Field("tick", "", "int"),
    Field("number", "", "int"),
    Field("status", "", "str"),
    Field("at_s", "s"),
    Field("revision", "", "int"),
    Field("delta_v_m_s", "m/s"),
    Field("propellant_kg", "kg"),
    Field("reason", "", "str"),
)
"""What flight software was told of its commands, at the tick that told it."""

MESSAGES = (
    Field("tick", "", "int"),
    Field("way", "", "str"),
    Field("peer", "", "str"),
    Field("sent_s", "s"),
    Field("arrives_s", "s"),
    Field("payload_bytes", "B", "int"),
)
"""Messages by radio. way: sent or received; a sent one's arrival is the host's to know: its sent_s stands for it."""

REFUSALS = (
    Field("tick", "", "int"),
    Field("number", "", "int"),
    Field("to", "", "str"),
    Field("sent_s", "s"),
    Field("reason", "", "str"),
)
"""Messages that were refused, at the tick that told flight software of it; there is none before the first."""

UNITS = {
    "_m": "m",
    "_km": "km",
    "_m_s": "m/s",
    "_km_s": "km/s",
    "_m_s2": "m/s^2",
    "_deg": "deg",
    "_deg_s": "deg/s",
    "_rad": "rad",
    "_rad_s": "rad/s",
    "_s": "s",
    "_kg": "kg",
    "_m2_kg": "m^2/kg",
    "_n": "N",
    "_n_m": "N m",
    "_t": "T",
}
"""Units that end the name of an estimate."""


def unit_of(name: str) -> str:
    """Return the unit that ends a name, the longest that fits; empty if there is none."""
    endings = [ending for ending in UNITS if name.endswith(ending)]
    return UNITS[max(endings, key=len)] if endings else ""
