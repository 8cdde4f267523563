"""Figures of a constellation: orbits, elements, r and v, angular momentum, energy (thesis, appendix D)."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cosmos_cli.report.figures.generic import generic_blocks
from cosmos_cli.report.figures.orbit_scene import MU_KM3_S2, ellipse, orbit_figure
from cosmos_cli.report.model import Block, Choice, Figure, Remark, TableBlock, Trace, headings
from cosmos_cli.report.sampling import Floats, evenly, thin
from cosmos_cli.report.source import Source
from cosmos_cli.report.style import (
    PALETTE,
    grid_layout,
    groups_of_agents,
    layout,
    line,
)
from cosmos_cli.tables import TableReader

POINTS_MAX, POINTS_MIN, POINTS_ALL = 400, 100, 14_000
POINTS_PER_ORBIT_MIN = 24
"""With fewer an orbit looks like a polygon, and a day of orbits like anything."""
POSITION = tuple(re.compile(rf"^{axis}(_[a-z0-9]+)??_(k?m)$") for axis in "xyz")
VELOCITY = tuple(re.compile(rf"^v{axis}(_[a-z0-9]+)??_(k?m)_s$") for axis in "xyz")
NODE = "raan_deg"
GROUP = "satellite"


def state_blocks(table: TableReader, source: Source) -> list[Block]:
    """Return the orbits in space, and position, velocity and angular momentum of a satellite to choose."""
    names = _state_fields(table)
    if names is None:
        return generic_blocks(table, source)
    states = {agent: _read_state(table, source, agent, names) for agent in table.sources}
    states = {agent: state for agent, state in states.items() if len(state[0])}
    if not states:
        return [Remark(text="No state was recorded.")]
    frame = _frame(names[0][0])
    figures = [
        orbit_figure(
            {label: r_km for _, r_km, _, label in states.values()},
            [ellipse(r_km[-1], v_km_s[-1]) for _, r_km, v_km_s, _ in states.values()],
            f"Orbits{frame}",
        ),
        _vectors(
            states,
            f"Position and velocity{frame}",
            lambda t, r, v: _components(t, (r, "xyz", 1), (v, "xyz", 2)),
            ("position, km", "velocity, km/s"),
        ),
        _vectors(
            states,
            f"Specific angular momentum{frame}",
            lambda t, r, v: _components(t, (np.cross(r, v), "xyz", 1)),
            ("h, km²/s",),
        ),
    ]
    from_s = min(t_s[0] for t_s, *_ in states.values())
    if from_s <= min(source.time_of(table, agent)[0][0] for agent in states):
        return [*figures]
    cut = f" From {from_s:g} s on: more points would not fit."
    return [replace(figure, note=f"{figure.note}{cut}".strip()) for figure in figures]


def elements_blocks(table: TableReader, source: Source) -> list[Block]:
    """Return the elements of a satellite to choose, and what they were at the end of all."""
    fields = [
        f for f in table.fields if f.kind in ("float", "int") and f.name not in ("t_s", "tick")
    ]
    if not table.rows or not fields:
        return [Remark(text="No elements were recorded.")]
    titles = [f"{_element_name(f.name)}{_told_unit(f.unit)}" for f in fields]
    figure_layout, height_px = grid_layout(titles, x_title="simulated time, s")
    points = _points(len(table.sources))
    choices, rows = [], []
    for agent in table.sources:
        t_s, _ = source.time_of(table, agent)
        traces = []
        columns = [source.values(table, agent, f.name) * _scale(f.unit) for f in fields]
        for number, (field, values) in enumerate(zip(fields, columns, strict=True), start=1):
            axes: Trace = {"xaxis": f"x{number}", "yaxis": f"y{number}"}
            shown = values
            if field.name == NODE and np.isfinite(values).all():
                shown = np.unwrap(values, period=360.0)  # it moves slowly, over 360 deg as well
            traces.append(line(*thin(t_s, shown, points), titles[number - 1], **axes))
        choices.append(Choice(name=_satellite(source, agent), traces=traces))
        rows.append([_satellite(source, agent), *(_last(values) for values in columns)])
    return [
        Figure(
            title="Classical orbital elements, osculating",
            choices=choices,
            layout=figure_layout,
            height_px=height_px,
            group=GROUP,
        ),
        TableBlock(title="Elements at the end", headings=headings("satellite", *titles), rows=rows),
    ]


def invariants_blocks(table: TableReader, source: Source) -> list[Block]:
    """Return what a model without losses must conserve: drift of all satellites, energy of one to choose."""
    if not table.rows or not table.has("t_s", "agent", "energy_drift"):
        return generic_blocks(table, source)
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
            blocks.append(_drift(numbers, by_agent, name, title))
    if "energy_j_kg" in numbers:
        blocks.append(_energy(source, numbers, by_agent))
    blocks.append(_drift_table(source, numbers, by_agent))
    return blocks


def _drift(
    numbers: dict[str, Floats], by_agent: dict[str, NDArray[np.int64]], name: str, title: str
) -> Figure:
    choices = []
    for label, group in groups_of_agents(tuple(by_agent)):
        traces = [
            line(numbers["t_s"][rows], numbers[name][rows], agent, index, mode="lines+markers")
            | {"marker": {"size": 4}}
            for index, agent in enumerate(group)
            for rows in [by_agent[agent]]
        ]
        choices.append(Choice(name=label, traces=traces))
    figure_layout = layout("simulated time, s", "relative", showlegend=True)
    figure_layout["yaxis"] |= {"exponentformat": "power"}
    return Figure(
        title=title,
        note="Against its value at simulated time zero, or after the vehicle's last maneuver;"
        " one point a vehicle and window of truth.",
        choices=choices,
        layout=figure_layout,
        group="agents",
    )


def _energy(
    source: Source, numbers: dict[str, Floats], by_agent: dict[str, NDArray[np.int64]]
) -> Figure:
    choices = []
    for agent, rows in by_agent.items():
        energy = numbers["energy_j_kg"][rows]
        trace = line(numbers["t_s"][rows], energy - energy[0], "E − E₀", mode="lines+markers")
        trace["hovertemplate"] = f"%{{x:.0f}} s: E₀ %{{y:+.3g}} J/kg, E₀ = {energy[0]:.9g} J/kg"
        choices.append(Choice(name=_satellite(source, agent), traces=[trace]))
    figure_layout = layout("simulated time, s", "E − E₀, J/kg")
    figure_layout["yaxis"] |= {"exponentformat": "power"}
    return Figure(
        title="Specific orbital energy against its first value",
        note="Kinetic and potential energy, with every force of the model that has a potential.",
        choices=choices,
        layout=figure_layout,
        group=GROUP,
    )


def _drift_table(
    source: Source, numbers: dict[str, Floats], by_agent: dict[str, NDArray[np.int64]]
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
        cells: list[object] = [_satellite(source, agent)]
        for name, _ in wanted:
            values = numbers[name][index]
            cells.append(_megajoules(values) if name == "energy_j_kg" else _worst(values))
        rows.append(cells)
    titles = [title for _, title in wanted]
    return TableBlock(
        title="Conserved quantities", headings=headings("satellite", *titles), rows=rows
    )


BuildTraces = Callable[[Floats, Floats, Floats], list[Trace]]
State = tuple[Floats, Floats, Floats, str]
"""Time, s, shape (N,); position, km, and velocity, km/s, shape (N, 3); the satellite's label."""


def _state_fields(table: TableReader) -> tuple[list[str], list[str]] | None:
    names = [field.name for field in table.fields]
    found: list[list[str]] = []
    for patterns in (POSITION, VELOCITY):
        matches = [next((n for n in names if pattern.match(n)), None) for pattern in patterns]
        if None in matches:
            return None
        found.append([name for name in matches if name is not None])
    return found[0], found[1]


def _read_state(
    table: TableReader, source: Source, agent: str, names: tuple[list[str], list[str]]
) -> State:
    t_s, _ = source.time_of(table, agent)
    km = [1.0 if "_km" in names[part][0] else 1e-3 for part in (0, 1)]
    r_km, v_km_s = (
        np.column_stack([source.values(table, agent, n) for n in names[part]]) * km[part]
        for part in (0, 1)
    )
    chosen = _drawn(t_s, r_km, v_km_s, _points(len(table.sources)))
    return t_s[chosen], r_km[chosen], v_km_s[chosen], _satellite(source, agent)


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


def _satellite(source: Source, agent: str) -> str:
    name = source.agent_summary(agent).get("satellite")
    return f"{agent} · {name}" if isinstance(name, str) and name else agent


def _vectors(
    states: dict[str, State], title: str, build: BuildTraces, titles: Sequence[str]
) -> Figure:
    figure_layout, height_px = grid_layout(
        titles, columns=1, row_px=200, x_title="simulated time, s"
    )
    for number in range(1, len(titles) + 1):
        figure_layout[f"yaxis{number}"] |= {"exponentformat": "none", "separatethousands": True}
    figure_layout["showlegend"] = True
    figure_layout["margin"] = {"l": 64, "r": 16, "t": 70, "b": 44}
    # Between the mode bar and the titles.
    figure_layout["legend"] |= {"yref": "container", "y": 1 - 28 / height_px, "yanchor": "top"}
    choices = [
        Choice(name=label, traces=build(t_s, r_km, v_km_s))
        for t_s, r_km, v_km_s, label in states.values()
    ]
    return Figure(
        title=title, choices=choices, layout=figure_layout, height_px=height_px, group=GROUP
    )


def _components(t_s: Floats, *vectors: tuple[Floats, str, int]) -> list[Trace]:
    traces = []
    for values, letters, number in vectors:
        axes = {"xaxis": f"x{number}", "yaxis": f"y{number}", "showlegend": number == 1}
        for index, letter in enumerate(letters):
            traces.append(line(t_s, values[:, index], letter, index, **axes))
        norm = line(t_s, np.linalg.norm(values, axis=1), "magnitude", 3, **axes)
        norm["line"] = {"width": 1.3, "color": PALETTE[3], "dash": "dot"}
        traces.append(norm)
    return traces


ELEMENT_NAMES = {
    "a": "semi-major axis",
    "e": "eccentricity",
    "i": "inclination",
    "raan": "node",
    "argp": "argument of perigee",
    "mean_anomaly": "mean anomaly",
    "true_anomaly": "true anomaly",
}


def _element_name(field_name: str) -> str:
    stem = re.sub(r"_(deg|rad|k?m)$", "", field_name)
    return ELEMENT_NAMES.get(stem, stem.replace("_", " "))


def _scale(unit: str) -> float:
    return 1e-3 if unit == "m" else 1.0


def _told_unit(unit: str) -> str:
    return {"m": ", km", "1": "", "": "", "deg": ", °"}.get(unit, f", {unit}")


def _last(values: Floats) -> float | None:
    finite = values[np.isfinite(values)]
    return float(finite[-1]) if finite.size else None


def _megajoules(values: Floats) -> str | None:
    """Return the last energy with all the figures by which satellites of one shell differ."""
    last = _last(values)
    return None if last is None else f"{last / 1e6:.6f}"


def _worst(values: Floats) -> float | None:
    finite = np.abs(values[np.isfinite(values)])
    return float(finite.max()) if finite.size else None
