"""The orbits in space: the one figure that needs WebGL, for browsers keep few of such at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from cosmos_cli.report.model import Choice, Figure, Trace
from cosmos_cli.report.sampling import Floats
from cosmos_cli.report.style import ACCENT, PALETTE, WARM, base_layout

EARTH_RADIUS_KM = 6378.137
MU_KM3_S2 = 398600.4418
"""For drawing whole orbits only; physics is the simulation's business."""
ORBIT_POINTS = 120
ONE_TRACE_EACH_MAX = 24


def orbit_figure(
    flown_km: Mapping[str, Floats], ellipses_km: Sequence[Floats], title: str
) -> Figure:
    """
    Return the orbits of all vehicles about the Earth.

    Args:
        flown_km: Label of each vehicle and its positions, shape (N, 3), km, any inertial frame.
        ellipses_km: The whole orbit of each, as `ellipse` makes it.
        title: The figure's.
    """
    labels = list(flown_km)
    if len(flown_km) <= ONE_TRACE_EACH_MAX:
        flown = [
            _scatter3d(path, PALETTE[index % len(PALETTE)], 5, label)
            for index, (label, path) in enumerate(flown_km.items())
        ]
    else:
        flown = [_scatter3d(_with_gaps(list(flown_km.values())), ACCENT, 4, "flown")]
    ends = np.array([path[-1] for path in flown_km.values()])
    whole = _scatter3d(_with_gaps(ellipses_km), "#98a6b5", 1, "osculating orbits")
    whole["hoverinfo"] = "skip"
    points = _scatter3d(ends, WARM, 1, "satellites at the end")
    points |= {"mode": "markers", "marker": {"size": 3.5, "color": WARM}, "text": labels}
    points["hovertemplate"] = "%{text}<extra></extra>"
    traces = [*_earth(), whole, *flown, points]
    hidden = {"visible": False, "showspikes": False}
    scene = {
        "xaxis": hidden,
        "yaxis": hidden,
        "zaxis": hidden,
        "aspectmode": "manual",
        "aspectratio": _proportions([*ellipses_km, *flown_km.values()]),
        "camera": {"eye": {"x": 0.92, "y": 0.92, "z": 0.5}},
    }
    return Figure(
        title=title,
        note="What was flown in colour, the orbit that it belongs to in grey, the Earth to scale. Drag to turn.",
        choices=[Choice(name="", traces=traces)],
        layout=base_layout(scene=scene, showlegend=False, margin={"l": 0, "r": 0, "t": 0, "b": 0}),
        height_px=560,
        is_square=True,
    )


def _proportions(paths_km: Sequence[Floats]) -> dict[str, float]:
    """Return the sides of the box of all that is drawn, the longest 1: so it fits whatever its shape."""
    corners = np.array([[-EARTH_RADIUS_KM] * 3, [EARTH_RADIUS_KM] * 3])
    every = np.concatenate([corners, *paths_km])
    sides = np.nanmax(every, axis=0) - np.nanmin(every, axis=0)
    return dict(zip("xyz", (sides / sides.max()).tolist(), strict=True))


def _scatter3d(points_km: Floats, colour: str, width: float, name: str) -> Trace:
    return {
        "type": "scatter3d",
        "mode": "lines",
        "name": name,
        "x": points_km[:, 0].copy(),
        "y": points_km[:, 1].copy(),
        "z": points_km[:, 2].copy(),
        "line": {"width": width, "color": colour},
        "hovertemplate": f"{name}<extra></extra>",
    }


def _with_gaps(pieces: Sequence[Floats]) -> Floats:
    gap = np.full((1, 3), np.nan)
    return np.concatenate([part for piece in pieces for part in (piece, gap)])


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


def _earth() -> list[Trace]:
    """Return a calm sphere and its graticule."""
    longitude, latitude = np.linspace(0, 2 * np.pi, 61), np.linspace(-np.pi / 2, np.pi / 2, 31)
    x = EARTH_RADIUS_KM * np.outer(np.cos(latitude), np.cos(longitude))
    y = EARTH_RADIUS_KM * np.outer(np.cos(latitude), np.sin(longitude))
    z = EARTH_RADIUS_KM * np.outer(np.sin(latitude), np.ones_like(longitude))
    sphere: Trace = {
        "type": "surface",
        "x": x.round(0).tolist(),
        "y": y.round(0).tolist(),
        "z": z.round(0).tolist(),
        "surfacecolor": np.zeros_like(z).tolist(),
        "colorscale": [[0, "#cfdeea"], [1, "#cfdeea"]],
        "showscale": False,
        "hoverinfo": "skip",
        "lighting": {"ambient": 0.94, "diffuse": 0.12, "specular": 0.0, "roughness": 1.0},
        "contours": {axis: {"highlight": False} for axis in "xyz"},
    }
    meridians = [_circle(longitude=np.radians(d)) for d in range(0, 180, 30)]
    parallels = [_circle(latitude=np.radians(d)) for d in range(-60, 61, 30)]
    graticule = _scatter3d(_with_gaps([*meridians, *parallels]), "#a9bfd1", 1, "graticule")
    graticule["hoverinfo"] = "skip"
    return [sphere, graticule]


def _circle(longitude: float | None = None, latitude: float | None = None) -> Floats:
    angle = np.linspace(0, 2 * np.pi, 73)
    radius = EARTH_RADIUS_KM * 1.003
    if longitude is not None:
        flat = np.cos(angle)
        points = [flat * np.cos(longitude), flat * np.sin(longitude), np.sin(angle)]
    else:
        ring, height = np.cos(latitude or 0.0), np.sin(latitude or 0.0)
        points = [ring * np.cos(angle), ring * np.sin(angle), np.full_like(angle, height)]
    return radius * np.column_stack(points)
