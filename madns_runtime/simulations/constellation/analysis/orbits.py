"""Figures of a constellation: orbits, elements, r and v, angular momentum, energy (thesis, appendix D)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from madns_runtime.analysis.breaks import gap_starts
from madns_runtime.analysis.lines import generic_blocks, grouped_lines
from madns_runtime.analysis.sampling import (
    drawn_series,
    evenly,
    largest_size,
    with_breaks,
    with_gaps,
)
from madns_runtime.analysis.tables import RecordedRun, RecordedTable
from madns_runtime.analysis.values import (
    Axis,
    Block,
    Figure,
    FigureChoice,
    Floats,
    ReportRemark,
    Series,
    SpaceFigure,
    SpacePath,
    TableBlock,
    headings,
)

POINTS_MAX, POINTS_MIN, POINTS_ALL = 400, 100, 14_000
POINTS_PER_ORBIT_MIN = 24
"""With fewer an orbit looks like a polygon, and a day of orbits like anything."""
POSITION = tuple(re.compile(rf"^{axis}(_[a-z0-9]+)??_(k?m)$") for axis in "xyz")
VELOCITY = tuple(re.compile(rf"^v{axis}(_[a-z0-9]+)??_(k?m)_s$") for axis in "xyz")
NODE = "raan_deg"
GROUP = "satellite"

State = tuple[Floats, Floats, Floats, str]
"""Time, s, shape (N,); position, km, and velocity, km/s, shape (N, 3); the satellite's label."""
ELEMENT_NAMES = {
    "a": "semi-major axis",
    "e": "eccentricity",
    "i": "inclination",
    "raan": "node",
    "argp": "argument of perigee",
    "mean_anomaly": "mean anomaly",
    "true_anomaly": "true anomaly",
}
EARTH_RADIUS_KM = 6378.137
MU_KM3_S2 = 398600.4418
"""For drawing whole orbits only; physics is the simulation's business."""
ORBIT_POINTS = 120
ONE_PATH_EACH_MAX = 24


def state_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return the orbits in space, and position, velocity and angular momentum of a satellite to choose."""
    names = state_fields([field.name for field in table.fields])
    if names is None:
        return generic_blocks(table, run)
    states = {agent: _read_state(table, run, agent, names) for agent in table.sources}
    states = {agent: state for agent, state in states.items() if len(state[0])}
    if not states:
        return [ReportRemark(text="No state was recorded.")]
    frame = _frame(names[0][0])
    figures: list[Figure | SpaceFigure] = [
        orbit_figure(
            {label: r_km for _, r_km, _, label in states.values()},
            [ellipse(r_km[-1], v_km_s[-1]) for _, r_km, v_km_s, _ in states.values()],
            f"Orbits{frame}",
        ),
        _vectors(
            {label: (t_s, (r_km, v_km_s)) for t_s, r_km, v_km_s, label in states.values()},
            f"Position and velocity{frame}",
            (Axis(quantity="position", unit="km"), Axis(quantity="velocity", unit="km/s")),
        ),
        _vectors(
            {label: (t, (np.cross(r, v),)) for t, r, v, label in states.values()},
            f"Specific angular momentum{frame}",
            (Axis(quantity="h", unit="km²/s"),),
        ),
    ]
    from_s = min(t_s[0] for t_s, *_ in states.values())
    if from_s <= min(run.time_of(table, agent)[0][0] for agent in states):
        return [*figures]
    cut = f" From {from_s:g} s on: more points would not fit."
    return [replace(figure, note=f"{figure.note}{cut}".strip()) for figure in figures]


def truth_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return what the host itself recorded of truth, in words: its numbers are packed."""
    name = run.document.get("run")
    text = (
        f"The host recorded {table.rows} segments of truth, of every satellite and to the bit; "
        f"cosmos tabulate {name} --rate-hz 10 makes a table of them, at any rate."
    )
    return [ReportRemark(text=text)]


def elements_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return the elements of a satellite to choose, and what they were at the end of all."""
    fields = [
        f for f in table.fields if f.kind in ("float", "int") and f.name not in ("t_s", "tick")
    ]
    if not table.rows or not fields:
        return [ReportRemark(text="No elements were recorded.")]
    panels = [Axis(quantity=_element_name(f.name), unit=_told_unit(f.unit)) for f in fields]
    points = _points(len(table.sources))
    choices, rows = [], []
    for agent in table.sources:
        t_s, _ = run.time_of(table, agent)
        returns = run.returns(table, agent)
        marks = []
        columns = [run.values(table, agent, f.name) * _scale(f.unit) for f in fields]
        for panel, (field, values) in enumerate(zip(fields, columns, strict=True)):
            shown = values
            if field.name == NODE and np.isfinite(values).all():
                shown = np.unwrap(values, period=360.0)  # it moves slowly, over 360 deg as well
            mark = Series(x=t_s, y=shown, panel=panel, tone="main")
            marks.append(drawn_series(mark, points, unit=field.unit, returns=returns))
        choices.append(FigureChoice(name=_satellite(run, agent), marks=marks))
        rows.append([_satellite(run, agent), *(_last(values) for values in columns)])
    titles = [panel.label for panel in panels]
    return [
        Figure(
            title="Classical orbital elements, osculating",
            panels=panels,
            choices=choices,
            group=GROUP,
        ),
        TableBlock(title="Elements at the end", headings=headings("satellite", *titles), rows=rows),
    ]


def invariants_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return what a model without losses must conserve: drift of all satellites, energy of one to choose."""
    if not table.rows or not table.has("t_s", "agent", "energy_drift"):
        return generic_blocks(table, run)
    columns = table.read("host", [field.name for field in table.fields])
    agents = columns["agent"].astype(str)
    by_agent = {name: np.flatnonzero(agents == name) for name in dict.fromkeys(agents.tolist())}
    numbers = {
        name: values.astype(np.float64) for name, values in columns.items() if name != "agent"
    }
    blocks: list[Block] = []
    for name, title in (
        ("energy_drift", "Relative drift of the specific orbital energy"),
        ("momentum_z_drift", "Relative drift of the angular momentum about the pole"),
    ):
        if name in numbers:
            blocks += grouped_lines(
                {
                    who: (numbers["t_s"][rows], numbers[name][rows])
                    for who, rows in by_agent.items()
                },
                title=title,
                y=Axis(quantity="relative"),
                note="Against its value at simulated time zero, or after the vehicle's last maneuver;"
                " one point per vehicle and window of truth.",
                form="joined points",
            )
    if "energy_j_kg" in numbers:
        blocks.append(_energy(run, numbers, by_agent))
    blocks.append(_drift_table(run, numbers, by_agent))
    return blocks


def _energy(
    run: RecordedRun, numbers: dict[str, Floats], by_agent: dict[str, NDArray[np.int64]]
) -> Figure:
    choices = []
    for agent, rows in by_agent.items():
        energy = numbers["energy_j_kg"][rows]
        mark = Series(
            x=numbers["t_s"][rows],
            y=energy - energy[0],
            name="E − E₀",
            form="joined points",
            note=f"E₀ = {energy[0]:.9g} J/kg",
        )
        choices.append(FigureChoice(name=_satellite(run, agent), marks=[mark]))
    return Figure(
        title="Specific orbital energy against its first value",
        note="Kinetic and potential energy, with every force of the model that has a potential.",
        y=Axis(quantity="E − E₀", unit="J/kg"),
        choices=choices,
        group=GROUP,
    )


def _drift_table(
    run: RecordedRun, numbers: dict[str, Floats], by_agent: dict[str, NDArray[np.int64]]
) -> TableBlock:
    wanted = [
        (name, title)
        for name, title in (
            ("energy_j_kg", "energy at the end, MJ/kg"),
            ("energy_drift", "energy drift, worst"),
            ("momentum_z_drift", "momentum drift, worst"),
        )
        if name in numbers
    ]
    rows = []
    for agent, index in by_agent.items():
        cells: list[object] = [_satellite(run, agent)]
        for name, _ in wanted:
            values = numbers[name][index]
            cells.append(_megajoules(values) if name == "energy_j_kg" else largest_size(values))
        rows.append(cells)
    titles = [title for _, title in wanted]
    return TableBlock(
        title="Conserved quantities", headings=headings("satellite", *titles), rows=rows
    )


def state_fields(
    names: Sequence[str], *kinds: Sequence[re.Pattern[str]]
) -> tuple[list[str], list[str]] | None:
    """Return the fields of position and of velocity among *names*; None if one is not there."""
    found = [
        [name for pattern in patterns for name in [n for n in names if pattern.match(n)][:1]]
        for patterns in kinds or (POSITION, VELOCITY)
    ]
    return (found[0], found[1]) if all(len(axes) == 3 for axes in found) else None


def _read_state(
    table: RecordedTable, run: RecordedRun, agent: str, names: tuple[list[str], list[str]]
) -> State:
    t_s, _ = run.time_of(table, agent)
    km = [1.0 if "_km" in names[part][0] else 1e-3 for part in (0, 1)]
    r_km, v_km_s = (
        np.column_stack([run.values(table, agent, n) for n in names[part]]) * km[part]
        for part in (0, 1)
    )
    chosen = _drawn(t_s, r_km, v_km_s, _points(len(table.sources)))
    # One that was away has no line through what it did not fly, least of all through the Earth.
    returns = np.searchsorted(chosen, run.returns(table, agent))
    starts = np.union1d(returns, gap_starts(t_s[chosen], len(chosen)))
    starts = starts[(starts > 0) & (starts < len(chosen))]
    _, r_km = with_breaks(t_s[chosen], r_km[chosen], starts)
    t_s, v_km_s = with_breaks(t_s[chosen], v_km_s[chosen], starts)
    return t_s, r_km, v_km_s, _satellite(run, agent)


def _drawn(t_s: Floats, r_km: Floats, v_km_s: Floats, points: int) -> NDArray[np.int64]:
    """Return which states to draw: evenly spread ones if they still show orbits, else the last that do."""
    count = len(t_s)
    if count <= points:
        return np.arange(count)
    alpha = 2.0 / np.linalg.norm(r_km[-1]) - v_km_s[-1] @ v_km_s[-1] / MU_KM3_S2
    turn_s = 2.0 * np.pi / np.sqrt(MU_KM3_S2 * max(float(alpha), 1e-12) ** 3)
    records = turn_s / POINTS_PER_ORBIT_MIN / (t_s[-1] - t_s[0]) * (count - 1)
    if not records < count / points:
        return evenly(count, points)
    return np.arange(count - 1, -1, -max(int(records), 1))[:points][::-1]


def _frame(field_name: str) -> str:
    match = POSITION[0].match(field_name)
    return f" ({match[1][1:].upper()})" if match and match[1] else ""


def _points(sources: int) -> int:
    return min(max(POINTS_ALL // max(sources, 1), POINTS_MIN), POINTS_MAX)


def _satellite(run: RecordedRun, agent: str) -> str:
    name = run.agent_summary(agent).get("satellite")
    return f"{agent} · {name}" if isinstance(name, str) and name else agent


def _vectors(
    states: dict[str, tuple[Floats, tuple[Floats, ...]]], title: str, panels: Sequence[Axis]
) -> Figure:
    """Return components and magnitude of vectors over time; *states* holds times, s, and one vector per panel."""
    choices = []
    for label, (t_s, vectors) in states.items():
        marks = []
        for panel, values in enumerate(vectors):
            marks += [
                Series(x=t_s, y=values[:, index], name=letter, panel=panel)
                for index, letter in enumerate("xyz")
            ]
            size = np.linalg.norm(values, axis=1)
            marks.append(Series(x=t_s, y=size, name="magnitude", form="dotted", panel=panel))
        choices.append(FigureChoice(name=label, marks=marks))
    return Figure(title=title, panels=panels, columns=1, choices=choices, group=GROUP)


def _element_name(field_name: str) -> str:
    stem = re.sub(r"_(deg|rad|k?m)$", "", field_name)
    return ELEMENT_NAMES.get(stem, stem.replace("_", " "))


def _scale(unit: str) -> float:
    return 1e-3 if unit == "m" else 1.0


def _told_unit(unit: str) -> str:
    return {"m": "km", "1": "", "deg": "°"}.get(unit, unit)


def _last(values: Floats) -> float | None:
    finite = values[np.isfinite(values)]
    return float(finite[-1]) if finite.size else None


def _megajoules(values: Floats) -> str | None:
    """Return the last energy with all the figures by which satellites of one shell differ."""
    last = _last(values)
    return None if last is None else f"{last / 1e6:.6f}"


def orbit_figure(
    flown_km: Mapping[str, Floats], ellipses_km: Sequence[Floats], title: str
) -> SpaceFigure:
    """
    Return the orbits of all vehicles about the Earth.

    Args:
        flown_km: Label of each vehicle and its positions, shape (N, 3), km, any inertial frame.
        ellipses_km: The whole orbit of each, as `ellipse` makes it.
        title: The figure's.
    """
    if len(flown_km) <= ONE_PATH_EACH_MAX:
        flown = [SpacePath(points=path, name=label) for label, path in flown_km.items()]
    else:
        every = with_gaps(list(flown_km.values()))
        flown = [SpacePath(points=every, name="flown", tone="main")]
    ends = np.array([path[-1] for path in flown_km.values()])
    whole = with_gaps(ellipses_km)
    return SpaceFigure(
        title=title,
        note="What was flown in colour, the orbit that it belongs to in grey, the Earth to scale. Drag to turn.",
        unit="km",
        paths=[SpacePath(points=whole, name="osculating orbits", is_background=True), *flown],
        spots=SpacePath(points=ends, name="satellites at the end", tone="warm"),
        spot_names=list(flown_km),
        sphere_radius=EARTH_RADIUS_KM,
    )


def ellipse(r_km: Floats, v_km_s: Floats) -> Floats:
    """Return the whole two-body orbit through a state, shape (ORBIT_POINTS, 3), km; empty if it is open."""
    h = np.cross(r_km, v_km_s)
    distance = np.linalg.norm(r_km)
    e = np.cross(v_km_s, h) / MU_KM3_S2 - r_km / distance
    eccentricity = np.linalg.norm(e)
    if not np.isfinite(eccentricity) or eccentricity >= 1.0 or not np.any(h):
        return np.empty((0, 3))
    towards = e / eccentricity if eccentricity > 1e-8 else r_km / distance
    across = np.cross(h / np.linalg.norm(h), towards)
    anomaly = np.linspace(0.0, 2 * np.pi, ORBIT_POINTS)
    radius = (h @ h) / MU_KM3_S2 / (1 + eccentricity * np.cos(anomaly))
    orbit: Floats = radius[:, None] * (
        np.cos(anomaly)[:, None] * towards + np.sin(anomaly)[:, None] * across
    )
    return orbit
