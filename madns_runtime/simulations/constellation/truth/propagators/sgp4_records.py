"""Element sets as sgp4's records, and what SGP4 says of one. Needs no numpy: `cosmos validate` asks."""

from __future__ import annotations

import math
from datetime import UTC, datetime

from madns_runtime.errors import ConfigurationError, MissingExtraError
from madns_runtime.simulations.constellation.orbit.constants import (
    EARTH_POLAR_RADIUS_M,
    SECONDS_PER_DAY,
)
from madns_runtime.simulations.constellation.truth.element_set import ElementSet

try:
    from sgp4.api import SGP4_ERRORS, WGS72, Satrec
except ImportError as error:
    raise MissingExtraError("sgp4", "host") from error

DECAYED = 6
"""Error of a satellite below the equatorial radius; its state is computed all the same."""
SHRUNK_SHARE = 0.01
"""Of the semi-major axis: whose mean orbit changes less meanwhile is neither down nor beyond what SGP4's series bear."""
LOOKS_MAX = 20_000
"""States of one set that are looked at: a tenth of a second. Beyond that they lie further apart than knots."""
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
    # Imported late: it reads XML, for which `cosmos validate` of a scenario with TLEs has no use.
    from sgp4 import omm

    fields = dict(element_set.omm)
    # sgp4 keeps catalogue numbers in five characters; longer ones change no orbit and are left out.
    if not fields["NORAD_CAT_ID"].isdigit() or int(fields["NORAD_CAT_ID"]) > 339_999:
        fields["NORAD_CAT_ID"] = "0"
    record = Satrec()
    omm.initialize(record, fields, WGS72)
    # sgp4 2.27 takes an OMM's epoch as days since 1949 in one float: 0.3 us, or 2 mm of orbit, are lost.
    record.jdsatepoch, record.jdsatepochF = julian_date(element_set.epoch_utc)
    return record


def why_not(
    element_set: ElementSet, epoch_utc: datetime, until_s: float = 0.0, *, knot_s: float = 1.0
) -> str | None:
    """
    Return why SGP4 cannot follow a satellite from the start on; None if it can, or does until it meets the Earth.

    Args:
        element_set: Of the satellite.
        epoch_utc: UTC of t = 0.
        until_s: End of the time in question, s.
        knot_s: Time between the states that are asked for, s.
    """
    try:
        record = to_satrec(element_set)
    except (ConfigurationError, ValueError, OverflowError) as error:
        return f"cannot be read by SGP4: {error}"
    fault, _ = _look(record, epoch_utc, 0.0, may_fall=False)
    if fault or until_s <= 0.0:
        return fault
    begins_radii = record.am
    for t_s in (until_s / 2.0, until_s):
        fault, _ = _look(record, epoch_utc, t_s)
        if fault or abs(record.am / begins_radii - 1.0) > SHRUNK_SHARE:
            return _fault_in_flight(record, epoch_utc, until_s, knot_s)
    return None


def _fault_in_flight(
    record: Satrec, epoch_utc: datetime, until_s: float, knot_s: float
) -> str | None:
    """Return why there is no state of a satellite that has not met the Earth before; None if there always is one."""
    looks = min(LOOKS_MAX, math.ceil(until_s / knot_s))
    for number in range(1, looks + 1):
        fault, radius_m = _look(record, epoch_utc, until_s * number / looks)
        if fault or radius_m < EARTH_POLAR_RADIUS_M:
            return fault
    return None


def _look(
    record: Satrec, epoch_utc: datetime, t_s: float, *, may_fall: bool = True
) -> tuple[str | None, float]:
    """Return why SGP4 has no state at a time, None if it has one, and how far from the Earth's centre that is, m."""
    whole, part = julian_date(epoch_utc)
    days, rest_s = divmod(t_s, SECONDS_PER_DAY)
    error_number, r_km, v_km_s = record.sgp4(whole + days, part + rest_s / SECONDS_PER_DAY)
    fault = None
    if error_number and not (may_fall and error_number == DECAYED):
        fault = f"SGP4: {SGP4_ERRORS.get(error_number, error_number)}, at {t_s:g} s"
    elif not all(math.isfinite(number) for number in (*r_km, *v_km_s)):
        fault = f"SGP4: expected a finite state, got {r_km} km, at {t_s:g} s"
    return fault, math.hypot(*r_km) * 1000.0
