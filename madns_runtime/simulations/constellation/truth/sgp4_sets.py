"""
Element sets through SGP4: the one place that imports sgp4.

SGP4's constants are WGS-72, those that the sets were fitted with, whatever gravity model numerical
propagation uses. Output is TEME, turned from km into m.
"""

from __future__ import annotations

from datetime import UTC, datetime
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import ConfigurationError, MissingExtraError
from madns_runtime.simulations.constellation.orbit.constants import SECONDS_PER_DAY
from madns_runtime.simulations.constellation.truth.element_sets import ElementSet

try:
    from sgp4 import omm
    from sgp4.api import SGP4_ERRORS, WGS72, Satrec, SatrecArray
except ImportError as error:
    raise MissingExtraError("sgp4", "host") from error

DECAYED = 6
"""Error of a satellite below the equatorial radius; its state is computed all the same."""
_J2000_UTC = datetime(2000, 1, 1, 12, tzinfo=UTC)
_J2000_JD = 2_451_545.0


def julian_date(moment_utc: datetime) -> tuple[float, float]:
    """Return the Julian date as whole and part of a day, so that microseconds are kept."""
    passed = moment_utc - _J2000_UTC
    return _J2000_JD + passed.days, (passed.seconds + passed.microseconds * 1e-6) / SECONDS_PER_DAY


def to_satrec(element_set: ElementSet) -> Satrec:
    """Return sgp4's record of an element set."""
    if element_set.lines is not None:
        return Satrec.twoline2rv(*element_set.lines, WGS72)
    fields = dict(element_set.omm)
    # sgp4 keeps catalogue numbers in five characters; longer ones change no orbit and are left out.
    if not fields["NORAD_CAT_ID"].isdigit() or int(fields["NORAD_CAT_ID"]) > 339_999:
        fields["NORAD_CAT_ID"] = "0"
    record = Satrec()
    omm.initialize(record, fields, WGS72)
    # sgp4 2.27 takes an OMM's epoch as days since 1949 in one float: 0.3 us, or 2 mm of orbit, are lost.
    record.jdsatepoch, record.jdsatepochF = julian_date(element_set.epoch_utc)
    return record


@lru_cache(maxsize=64)
def _fleet_records(element_sets: tuple[ElementSet, ...]) -> SatrecArray:
    """Cached, since a worker gets the same parts of the fleet with every window."""
    return SatrecArray([to_satrec(element_set) for element_set in element_sets])


def sgp4_states(
    element_sets: tuple[ElementSet, ...],
    epoch_utc: datetime,
    t_s: NDArray[np.float64],
    *,
    may_fall: bool = False,
) -> NDArray[np.float64]:
    """
    Return the states of a fleet by SGP4.

    Args:
        element_sets: N sets.
        epoch_utc: UTC of t_s = 0.
        t_s: Times, shape (K,), s.
        may_fall: Whether satellites may be lower than the Earth's equator is.

    Returns:
        States, shape (N, K, 6), m and m/s, TEME.

    Raises:
        ConfigurationError: A set cannot be propagated to a time; names the satellites, when first, and why.

    Accuracy: within 1.2e-7 km of the verification vectors that the sgp4 package ships.
    """
    whole, part = julian_date(epoch_utc)
    # Whole days stay apart from the rest, which would lose digits beside them.
    days, rest_s = np.divmod(np.asarray(t_s, dtype=np.float64), SECONDS_PER_DAY)
    errors, r_km, v_km_s = _fleet_records(element_sets).sgp4(
        whole + days, part + rest_s / SECONDS_PER_DAY
    )
    if may_fall:
        errors = np.where(errors == DECAYED, 0, errors)
    faults = []
    for n in np.flatnonzero(errors.any(axis=1)).tolist():
        k = int(np.argmax(errors[n] > 0))
        why = SGP4_ERRORS.get(int(errors[n, k]), str(errors[n, k]))
        faults.append(f"{element_sets[n].name}: SGP4: {why}, at {t_s[k]:g} s")
    if faults:
        raise ConfigurationError("\n".join(faults))
    return np.concatenate((r_km, v_km_s), axis=2) * 1000.0
