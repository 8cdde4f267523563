"""Lines in space as plotly.js takes them: the one figure that needs WebGL, for browsers keep few of such at a time."""

from __future__ import annotations

from typing import Any

import numpy as np

from cosmos_cli.report.style import PALETTE, TONES, base_layout
from madns_runtime.analysis.sampling import with_gaps
from madns_runtime.analysis.values import Floats, SpaceFigure, SpacePath

Trace = dict[str, Any]
SPHERE_COLOUR, GRATICULE_COLOUR = "#cfdeea", "#a9bfd1"
BACKGROUND_COLOUR = "#98a6b5"
GRATICULE_HEIGHT = 1.003
"""Of the sphere's radius: above it, so that it shows."""


def space_traces(figure: SpaceFigure) -> list[Trace]:
    """Return the sphere, the paths and the spots."""
    traces = [] if figure.sphere_radius is None else _sphere(figure.sphere_radius)
    place = 0
    for path in figure.paths:
        if path.is_background:
            trace = _scatter3d(path.points, BACKGROUND_COLOUR, 1, path.name) | {"hoverinfo": "skip"}
        else:
            trace = _scatter3d(path.points, _colour(path, place), 5, path.name)
            place += 1
        traces.append(trace)
    if figure.spots is not None:
        spots = _scatter3d(figure.spots.points, "", 1, figure.spots.name)
        spots["mode"] = "markers"
        spots["marker"] = {"size": 3.5, "color": _colour(figure.spots, 0)}
        if figure.spot_names:
            spots |= {"text": list(figure.spot_names), "hovertemplate": "%{text}<extra></extra>"}
        del spots["line"]
        traces.append(spots)
    return traces


def space_layout(figure: SpaceFigure) -> dict[str, Any]:
    """Return a scene without axes, in which all that is drawn has its true proportions."""
    hidden = {"visible": False, "showspikes": False}
    scene = {
        "xaxis": hidden,
        "yaxis": hidden,
        "zaxis": hidden,
        "aspectmode": "manual",
        "aspectratio": _proportions(figure),
        "camera": {"eye": {"x": 0.92, "y": 0.92, "z": 0.5}},
    }
    return base_layout(scene=scene, showlegend=False, margin={"l": 0, "r": 0, "t": 0, "b": 0})


def _colour(path: SpacePath, place: int) -> str:
    return PALETTE[place % len(PALETTE)] if path.tone == "palette" else TONES[path.tone]


def _proportions(figure: SpaceFigure) -> dict[str, float]:
    """Return the sides of the box of all that is drawn, the longest 1: so it fits whatever its shape."""
    drawn = [path.points for path in (*figure.paths, figure.spots) if path is not None]
    if figure.sphere_radius is not None:
        drawn.append(figure.sphere_radius * np.array([[-1.0] * 3, [1.0] * 3]))
    every = np.concatenate([np.empty((0, 3)), *drawn])
    every = every[np.isfinite(every).all(axis=1)]
    sides = np.ptp(every, axis=0) if len(every) else np.zeros(3)
    # A single point, or none, or farther apart than a float tells.
    if not 0.0 < sides.max() < np.inf:
        sides = np.ones(3)
    return dict(zip("xyz", (sides / sides.max()).tolist(), strict=True))


def _scatter3d(points: Floats, colour: str, width: float, name: str) -> Trace:
    return {
        "type": "scatter3d",
        "mode": "lines",
        "name": name,
        "x": points[:, 0].copy(),
        "y": points[:, 1].copy(),
        "z": points[:, 2].copy(),
        "line": {"width": width, "color": colour},
        "hovertemplate": "%{fullData.name}<extra></extra>",
    }


def _sphere(radius: float) -> list[Trace]:
    """Return a calm sphere and its graticule."""
    longitude, latitude = np.linspace(0, 2 * np.pi, 61), np.linspace(-np.pi / 2, np.pi / 2, 31)
    x = radius * np.outer(np.cos(latitude), np.cos(longitude))
    y = radius * np.outer(np.cos(latitude), np.sin(longitude))
    z = radius * np.outer(np.sin(latitude), np.ones_like(longitude))
    digits = max(0, 4 - int(np.log10(radius)))
    sphere: Trace = {
        "type": "surface",
        "x": x.round(digits).tolist(),
        "y": y.round(digits).tolist(),
        "z": z.round(digits).tolist(),
        "surfacecolor": np.zeros_like(z).tolist(),
        "colorscale": [[0, SPHERE_COLOUR], [1, SPHERE_COLOUR]],
        "showscale": False,
        "hoverinfo": "skip",
        "lighting": {"ambient": 0.94, "diffuse": 0.12, "specular": 0.0, "roughness": 1.0},
        "contours": {axis: {"highlight": False} for axis in "xyz"},
    }
    angle = np.linspace(0, 2 * np.pi, 73)
    flat, zero = np.cos(angle), np.zeros_like(angle)
    meridians = [
        np.column_stack([flat * np.cos(lon), flat * np.sin(lon), np.sin(angle)])
        for lon in np.radians(range(0, 180, 30))
    ]
    parallels = [
        np.column_stack([np.cos(lat) * flat, np.cos(lat) * np.sin(angle), zero + np.sin(lat)])
        for lat in np.radians(range(-60, 61, 30))
    ]
    circles = radius * GRATICULE_HEIGHT * with_gaps([*meridians, *parallels])
    graticule = _scatter3d(circles, GRATICULE_COLOUR, 1, "graticule") | {"hoverinfo": "skip"}
    return [sphere, graticule]
