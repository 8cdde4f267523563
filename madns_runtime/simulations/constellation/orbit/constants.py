"""Gravity models by name, each with its source. SI units."""

from __future__ import annotations

from dataclasses import dataclass

SECONDS_PER_DAY = 86_400.0
EARTH_RATE_RAD_S = 7.292115e-5
"""Rotation of the Earth about TEME's z axis, rad/s. Source: WGS-84, NIMA TR8350.2, 3rd ed."""
EARTH_RADIUS_M = 6_378_137.0
"""Equatorial radius of the Earth's ellipsoid, m. Source: WGS-84, NIMA TR8350.2, 3rd ed., table 3.1."""
EARTH_FLATTENING = 1.0 / 298.257223563
"""Of the same ellipsoid; same source."""
EARTH_POLAR_RADIUS_M = EARTH_RADIUS_M * (1.0 - EARTH_FLATTENING)
"""Smallest distance from the Earth's centre to its surface, m."""
GRAVITY_RADIUS_M_MIN = 3e6
"""Nearer to the centre than that gravity grows no more: who met the Earth is there on paper alone, until a call ends, and
no integrator could follow a steep fall through the centre."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GravityModel:
    """The constants of a gravity model that belong together; never mix those of two models."""

    name: str
    mu_m3_s2: float
    """Gravitational parameter of the Earth, m^3/s^2."""
    radius_m: float
    """Equatorial radius that belongs to j2, m."""
    j2: float
    """Second zonal harmonic, not normalised."""
    j3: float
    """Third zonal harmonic, not normalised."""
    j4: float
    """Fourth zonal harmonic, not normalised."""


EGM_96 = GravityModel(
    name="EGM-96",
    mu_m3_s2=3.986004415e14,
    radius_m=6_378_136.3,
    j2=1.0826266835531513e-3,
    j3=-2.5326564853322355e-6,
    j4=-1.619621591367e-6,
)
"""
Source: Lemoine et al., NASA/TP-1998-206861; jn = -sqrt(2 n + 1) Cn0 with C20 = -0.484165371736e-3,
C30 = 0.957254173792e-6, C40 = 0.539873863789e-6.
"""

WGS_84 = GravityModel(
    name="WGS-84",
    mu_m3_s2=3.986004418e14,
    radius_m=6_378_137.0,
    j2=1.0826298213133048e-3,
    j3=-2.5326564853322355e-6,
    j4=-1.619621591367e-6,
)
"""
Source: NIMA TR8350.2, 3rd ed.; j2 = -sqrt(5) C20, C20 = -0.484166774985e-3. That edition names EGM96
as the gravity model beside its ellipsoid: j3 and j4 are EGM96's.
"""

WGS_72 = GravityModel(
    name="WGS-72",
    mu_m3_s2=3.986008e14,
    radius_m=6_378_135.0,
    j2=1.082616e-3,
    j3=-2.53881e-6,
    j4=-1.65597e-6,
)
"""Source: Hoots and Roehrich, Spacetrack Report No. 3; the constants that element sets are fitted with."""

GRAVITY_MODELS = {model.name: model for model in (EGM_96, WGS_84, WGS_72)}
"""A new model is one more line above and its name in parameters.py."""
