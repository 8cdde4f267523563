"""
Write passes.json: passes of ten Iridium satellites over three places, by Skyfield (MIT licence).

Skyfield is no dependency: run this in an environment of its own with `pip install skyfield` to make the
file again, with no network beyond that. Sidereal time, ellipsoid, frames, elevation and the search for
events are Skyfield's; SGP4 is the same library on both sides, since it is not what is compared. UT1 is
set to UTC, as the program has it: it does not know their difference.
"""

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path

import skyfield
from skyfield.api import EarthSatellite, load, wgs84
from skyfield.searchlib import find_discrete, find_maxima

HERE = Path(__file__).parent
TLE = HERE.parents[1] / "scenarios/data/iridium10.tle"
EPOCH = datetime(2017, 3, 7, 12, tzinfo=UTC)
SPAN_S = 43_200
TT_MINUS_UTC_S = 37 + 32.184
STATIONS = {
    "svalbard": (78.23, 15.39, 500.0, 5.0),
    "kourou": (5.17, -52.69, 10.0, 10.0),
    "adelaide": (-34.73, 138.6, 30.0, 30.0),
}
EPSILON_DAYS = 2e-4 / 86_400  # a day number in one float resolves 4e-5 s


def passes(timescale, satellite, station):
    """Return [rise_s, culmination_s, set_s, highest elevation in deg] of every whole pass."""
    *place, mask = station
    site = wgs84.latlon(place[0], place[1], elevation_m=place[2])
    start = timescale.from_datetime(EPOCH)
    end = timescale.from_datetime(EPOCH + timedelta(seconds=SPAN_S))

    def elevation(t):
        return (satellite - site).at(t).altaz()[0].degrees

    def is_up(t):
        return elevation(t) >= mask

    elevation.step_days = is_up.step_days = 10 / 86_400

    def seconds(t):
        return (t.whole - start.whole + (t.tt_fraction - start.tt_fraction)) * 86_400

    times, up = find_discrete(start, end, is_up, epsilon=EPSILON_DAYS)
    if not len(times):
        return []
    peaks, heights = find_maxima(start, end, elevation, epsilon=EPSILON_DAYS)
    events = list(zip([float(x) for x in seconds(times)], up, strict=True))
    tops = list(zip([float(x) for x in seconds(peaks)], heights, strict=True))
    found = []
    for (rise_s, rises), (set_s, still) in zip(events, events[1:], strict=False):
        if not rises or still:
            continue
        top_s, height = max((t for t in tops if rise_s < t[0] < set_s), key=lambda top: top[1])
        found.append([round(rise_s, 6), round(top_s, 4), round(set_s, 6), round(float(height), 6)])
    return found


def main():
    """Write the file."""
    timescale = load.timescale(delta_t=TT_MINUS_UTC_S)
    lines = TLE.read_text().splitlines()
    result = {
        "source": f"Skyfield {'.'.join(map(str, skyfield.VERSION))}, see make_passes.py",
        "elements": TLE.name,
        "epoch_utc": EPOCH.isoformat(),
        "span_s": SPAN_S,
        "stations": {
            name: dict(
                zip(
                    ("latitude_deg", "longitude_deg", "altitude_m", "elevation_deg_min"),
                    station,
                    strict=True,
                )
            )
            for name, station in STATIONS.items()
        },
        "columns": ["rise_s", "culmination_s", "set_s", "elevation_deg_max"],
        "passes": {},
    }
    for first in range(0, len(lines), 3):
        name = lines[first].strip()
        satellite = EarthSatellite(lines[first + 1], lines[first + 2], name, timescale)
        result["passes"][name] = {
            station: passes(timescale, satellite, place) for station, place in STATIONS.items()
        }
    (HERE / "passes.json").write_text(json.dumps(result, indent=1) + "\n")


main()
