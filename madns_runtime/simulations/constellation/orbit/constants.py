"""Gravity models by name, each with its source. SI units."""

from __future__ import annotations

from dataclasses import dataclass

SECONDS_PER_DAY = 86_400.0


@dataclass(frozen=True, slots=True)
class GravityModel:
    """The constants of a gravity model that belong together; never mix those of two models."""

    name: str
    mu_m3_s2: float
    """Gravitational parameter of the Earth, m^3/s^2."""
    radius_m: float
    """Equatorial radius that belongs to j2, m."""
    j2: float
    """Second zonal harmonic, not normalised."""


EGM_96 = GravityModel("EGM-96", 3.986004415e14, 6_378_136.3, 1.0826266835531513e-3)
"""Source: Lemoine et al., NASA/TP-1998-206861; j2 = -sqrt(5) C20, C20 = -0.484165371736e-3."""

WGS_84 = GravityModel("WGS-84", 3.986004418e14, 6_378_137.0, 1.0826298213133048e-3)
"""Source: NIMA TR8350.2, 3rd ed.; j2 = -sqrt(5) C20, C20 = -0.484166774985e-3."""

WGS_72 = GravityModel("WGS-72", 3.986008e14, 6_378_135.0, 1.082616e-3)
"""Source: Hoots and Roehrich, Spacetrack Report No. 3; the constants that element sets are fitted with."""

GRAVITY_MODELS = {model.name: model for model in (EGM_96, WGS_84, WGS_72)}
"""A new model is one more line above and its name in parameters.py."""
