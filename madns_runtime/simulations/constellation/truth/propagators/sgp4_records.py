"""Element sets as sgp4's records, and what SGP4 says of one. Needs no numpy: `cosmos validate` asks."""

from __future__ import annotations

import math
from datetime import UTC, datetime

from madns_runtime.errors import ConfigurationError, MissingExtraError
from madns_runtime.simulations.constellation.orbit.constants import SECONDS_PER_DAY
from madns_runtime.simulations.constellation.truth.element_set import ElementSet

try:
    from sgp4.api import SGP4_ERRORS, WGS72, Satrec
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
    element_set: ElementSet, epoch_utc: datetime, t_s: float, *, may_fall: bool = False
) -> str | None:
    """
    Return why SGP4 has no state of a satellite at a time; None if it has one.

    Args:
        element_set: Of the satellite.
        epoch_utc: UTC of t_s = 0.
        t_s: Time, s.
        may_fall: Whether the satellite may be lower than the Earth's equator is.
    """
    try:
        record = to_satrec(element_set)
    except (ConfigurationError, ValueError, OverflowError) as error:
        return f"cannot be read by SGP4: {error}"
    whole, part = julian_date(epoch_utc)
    days, rest_s = divmod(t_s, SECONDS_PER_DAY)
    error_number, r_km, v_km_s = record.sgp4(whole + days, part + rest_s / SECONDS_PER_DAY)
    if error_number and not (may_fall and error_number == DECAYED):
        return f"SGP4: {SGP4_ERRORS.get(error_number, error_number)}, at {t_s:g} s"
    if not all(math.isfinite(number) for number in (*r_km, *v_km_s)):
        return f"SGP4: expected a finite state, got {r_km} km, at {t_s:g} s"
    return None
