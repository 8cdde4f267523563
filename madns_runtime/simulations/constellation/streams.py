"""
All that a constellation records: what each stream is called, its fields and their units.

Light, so that `cosmos validate` asks for it without numpy, and on neither side of the wall: these are names.
"""

from __future__ import annotations

from dataclasses import replace

from madns_runtime.plugin.api import DeclaredStream
from madns_runtime.recording.records import Field
from madns_runtime.simulations.constellation.parameters import ConstellationParameters

COMMAND_KINDS = ("delta_v", "torque", "ballistic", "dipole")
COMMAND_FRAMES = ("inertial", "rtn", "body")
COMMAND_STATUSES = ("accepted", "executed", "postponed", "refused")
LINK_OUTCOMES = (
    "delivered", "no_line_of_sight", "out_of_range", "no_contact", "lost", "queue_full", "unknown_receiver",
    "out_of_order", "no_truth",
)  # fmt: skip
"""All words of their fields, as the types say that have no place here, see `messages` and `truth.radio`."""

STATE = (
    Field("tick", "", "int"),
    Field("x_teme_m", "m", digits=5),
    Field("y_teme_m", "m", digits=5),
    Field("z_teme_m", "m", digits=5),
    Field("vx_teme_m_s", "m/s", digits=8),
    Field("vy_teme_m_s", "m/s", digits=8),
    Field("vz_teme_m_s", "m/s", digits=8),
)
"""Truth at every tick, or as often as the scenario says; a tick without truth has no record."""

ELEMENTS = (
    Field("tick", "", "int"),
    Field("a_m", "m", digits=3),
    Field("e", "1", digits=10),
    Field("i_deg", "deg", digits=8),
    Field("raan_deg", "deg", digits=8),
    Field("argp_deg", "deg", digits=7),
    Field("mean_anomaly_deg", "deg", digits=7),
)
"""Osculating elements of the state, in the scenario's gravity constants; none of a vehicle on an escape orbit."""

TRUTH_CHANGES = (
    Field("revision", "", "int"),
    Field("from_s", "s"),
    Field("heard_s", "s"),
    Field("left_s", "s"),
)
"""Truth that a maneuver changed, when its first segment was here: left_s until this agent's own from_s, T_m or
the beginning of a burn."""

ATTITUDE = (
    Field("tick", "", "int"),
    Field("q1", "1", digits=12),
    Field("q2", "1", digits=12),
    Field("q3", "1", digits=12),
    Field("q4", "1", digits=12),
    Field("wx_body_rad_s", "rad/s", digits=12),
    Field("wy_body_rad_s", "rad/s", digits=12),
    Field("wz_body_rad_s", "rad/s", digits=12),
)
"""Truth of a rigid body: quaternion, scalar last, inertial to body, and body rates."""

COMMANDS = (
    Field("tick", "", "int"),
    Field("number", "", "int"),
    Field("kind", "", "str", words=COMMAND_KINDS),
    Field("at_s", "s"),
    Field("frame", "", "str", words=COMMAND_FRAMES),
    Field("x", "m/s | N m | m^2/kg"),
    Field("y", "m/s | N m"),
    Field("z", "m/s | N m"),
    Field("duration_s", "s"),
)
"""Commands of flight software; their results are in command_results. Where a vehicle has magnetorquers the vector may
also be in A m^2: see `commands_fields`."""

COMMAND_RESULTS = (
    Field("tick", "", "int"),
    Field("number", "", "int"),
    Field("status", "", "str", words=COMMAND_STATUSES),
    Field("at_s", "s"),
    Field("revision", "", "int"),
    Field("delta_v_m_s", "m/s"),
    Field("propellant_kg", "kg"),
    Field("reason", "", "str"),
)
"""Results of commands, at the tick that told flight software."""

MESSAGES = (
    Field("tick", "", "int"),
    Field("way", "", "str", words=("sent", "received")),
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

FLIGHT_ANSWERS = (
    Field("tick", "", "int"),
    Field("t_s", "s"),
    Field("answer_us", "us"),
)
"""Answers of flight software behind an interface: time from sending a tick's report until its answer came."""

FLIGHT_CLOCK = (
    Field("t_s", "s"),
    Field("offset_s", "s"),
    Field("drift_ppm", "1e-6"),
)
"""The flight software's own clock: simulated time minus it, and how much faster it runs; once per second."""

TRUTH = (
    Field("sent_s", "s"),
    Field("agent", "", "str"),
    Field("revision", "", "int"),
    Field("t0_s", "s"),
    Field("knot_s", "s"),
    Field("knots", "", "int"),
    Field("states", "", "packed"),
    Field("attitude", "", "packed"),
)
"""One record a segment: *knots* knots every knot_s from t0_s on. states packs (knots, 6) float64, m and m/s, TEME;
attitude (knots, 7) of a rigid body, else null; see `truth.segment_records`."""

LINKS = (
    Field("sent_s", "s"),
    Field("sender", "", "str"),
    Field("number", "", "int"),
    Field("to", "", "str"),
    Field("outcome", "", "str", words=LINK_OUTCOMES),
    Field("arrives_s", "s"),
    Field("distance_m", "m"),
    Field("size_bytes", "B", "int"),
)
"""Stream "links": one record a LinkEvent."""

CONTACTS = (
    Field("event", "", "str", words=("rise", "set")),
    Field("agent", "", "str"),
    Field("station", "", "str"),
    Field("rise_s", "s"),
    Field("set_s", "s"),
    Field("elevation_deg_max", "deg"),
)
"""Stream "contacts": one record when a pass begins, one when it ends."""

MANEUVERS = (
    Field("commanded_s", "s"),
    Field("agent", "", "str"),
    Field("number", "", "int"),
    Field("kind", "", "str", words=COMMAND_KINDS),
    Field("status", "", "str", words=COMMAND_STATUSES),
    Field("heard_s", "s"),
    Field("at_s", "s"),
    Field("executed_s", "s"),
    Field("dv_commanded_m_s", "m/s"),
    Field("dv_given_m_s", "m/s"),
    Field("propagation_s", "s"),
    Field("network_s", "s"),
    Field("slack_s", "s"),
    Field("propellant_kg", "kg"),
    Field("reason", "", "str"),
)
"""One record a command: at_s is T_m as commanded, executed_s as it became (none if refused); propagation_s
is T_p, network_s T_n, slack_s (T_m - T_s) - (T_p + 2 T_n), for a finite burn with its beginning for T_m."""

STUCK_THRUSTERS = (
    Field("t_s", "s"),
    Field("agent", "", "str"),
    Field("state", "", "str", words=("open", "closed", "empty", "mended")),
    Field("dv_given_m_s", "m/s"),
    Field("propellant_kg", "kg"),
)
"""One record per second while a thruster that is stuck open burns, and one at its end: state is open, closed (by flight
software), empty or mended; dv_given_m_s what it has given since it stuck; there is none before the first."""

INVARIANTS = (
    Field("t_s", "s"),
    Field("agent", "", "str"),
    Field("energy_j_kg", "J/kg"),
    Field("momentum_m2_s", "m^2/s"),
    Field("momentum_z_m2_s", "m^2/s"),
    Field("energy_drift", "1"),
    Field("momentum_z_drift", "1"),
)
"""One record per vehicle and window; drifts are relative to simulated time zero or to the end of the last
maneuver, and missing where there is none in the window to compare with."""

SLOTS = (
    Field("t_s", "s"),
    Field("satellites", "", "int"),
    Field("slot_error_deg_rms", "deg"),
    Field("slot_error_deg_max", "deg"),
    Field("worst", "", "str"),
)
"""Slot errors by truth at one time, over the satellites whose agents live and fly software with even slots; null where
nobody is left. worst is the agent with the largest."""

SLOT_ERRORS = (
    Field("t_s", "s"),
    Field("agent", "", "str"),
    Field("slot_error_deg", "deg"),
)
"""One record per satellite of those: how far it is ahead of its slot by truth, the common phase being that of all."""

SAMPLE = (Field("tick", "", "int"), Field("t_s", "s"))
"""The first fields of every instrument: when it measured."""

ESTIMATES = (Field("tick", "", "int"),)
"""Estimates of flight software follow: it names them in the run."""

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
    "_n_m_s": "N m s",
    "_a_m2": "A m^2",
    "_t": "T",
}
"""Units that end the name of an estimate."""


def _of_sensor(fields: tuple[Field, ...]) -> tuple[Field, ...]:
    """Return the same fields with every digit: what truth rounds away may be what a sensor's noise is made of."""
    return tuple(replace(field, digits=None) for field in fields)


OF_HOST = {
    "truth": TRUTH,
    "invariants": INVARIANTS,
    "maneuvers": MANEUVERS,
    "stuck_thrusters": STUCK_THRUSTERS,
    "links": LINKS,
    "contacts": CONTACTS,
    "slots": SLOTS,
    "slot_errors": SLOT_ERRORS,
}
OF_AGENTS = {
    "state": STATE,
    "elements": ELEMENTS,
    "attitude": ATTITUDE,
    "truth_changes": TRUTH_CHANGES,
    "commands": COMMANDS,
    "command_results": COMMAND_RESULTS,
    "messages": MESSAGES,
    "refusals": REFUSALS,
    "flight_answers": FLIGHT_ANSWERS,
    "flight_clock": FLIGHT_CLOCK,
    "gyro": (*SAMPLE, *_of_sensor(ATTITUDE[5:])),
    "gnss": (*SAMPLE, *_of_sensor(STATE[1:])),
    "accelerometer": (
        *SAMPLE,
        Field("ax_m_s2", "m/s^2"),
        Field("ay_m_s2", "m/s^2"),
        Field("az_m_s2", "m/s^2"),
    ),
    "star_tracker": (*SAMPLE, *_of_sensor(ATTITUDE[1:5])),
    "sun_sensor": (*SAMPLE, Field("sx", "1"), Field("sy", "1"), Field("sz", "1")),
    "clock_sensor": (*SAMPLE, Field("clock_s", "s")),
    "magnetometer": (*SAMPLE, Field("bx_t", "T"), Field("by_t", "T"), Field("bz_t", "T")),
}
SENSOR_STREAMS = (
    "gnss",
    "gyro",
    "accelerometer",
    "magnetometer",
    "star_tracker",
    "sun_sensor",
    "clock_sensor",
)
"""Streams of sensors, in the order of a report."""
OF_AGENTS |= {
    f"{name}_{beside}": OF_AGENTS[name] for name in SENSOR_STREAMS for beside in ("truth", "model")
}
"""Beside the readings of a sensor that is hardware: what one without errors would have measured at the same time, and
what the model of it did, if there is one. Their tick is the reading's."""


def declared_streams(
    parameters: ConstellationParameters, agents: tuple[str, ...]
) -> tuple[DeclaredStream, ...]:
    """Return every stream that a host or a vehicle may open, whatever the parameters; see `plugin.api.Simulation`."""
    return (
        *(DeclaredStream(role="host", name=name, fields=OF_HOST[name]) for name in OF_HOST),
        *(
            DeclaredStream(role="agent", name=name, fields=fields)
            for name, fields in (OF_AGENTS | {"commands": commands_fields(parameters)}).items()
        ),
        DeclaredStream(role="agent", name="estimates", fields=ESTIMATES, is_open=True),
    )


def commands_fields(parameters: ConstellationParameters) -> tuple[Field, ...]:
    """Return the fields of the stream commands of a run: the same in all its vehicles, with all units that they may have."""
    bodies = (vehicle.attitude for vehicle in parameters.vehicles)
    if not any(body is not None and body.magnetorquers is not None for body in bodies):
        return COMMANDS
    return tuple(
        replace(field, unit=f"{field.unit} | A m^2") if field.name in "xyz" else field
        for field in COMMANDS
    )


def unit_of(name: str) -> str:
    """Return the unit that ends a name, the longest that fits; empty if there is none."""
    endings = [ending for ending in UNITS if name.endswith(ending)]
    return UNITS[max(endings, key=len)] if endings else ""
