"""
Write satellites of one circular orbit, with slot errors, as Orbit Mean-Elements Messages (OMM, CSV).

    python scenarios/data/make_ring.py --count 93 --altitude-km 780 --inclination-deg 86.4 > ring93.csv
    python scenarios/data/make_ring.py --count 77 --spacing-deg 2 --wave-share 0.5 --name CHAIN > chain77.csv

They are evenly spaced, all around or by --spacing-deg, but for errors of a normal distribution and, with
--wave-share, half a wave from the first to the last, which neighbours see least of. Errors are scaled to
exactly the spread asked for and free of a common part. The same seed gives the same file.
"""

from __future__ import annotations

import argparse
import math
import sys

import numpy as np

MU_KM3_S2, RADIUS_KM, J2 = 398_600.8, 6378.135, 1.082616e-3
"""WGS-72, the constants of element sets. Source: Hoots and Roehrich, Spacetrack Report No. 3."""
COLUMNS = (
    "OBJECT_NAME,OBJECT_ID,EPOCH,MEAN_MOTION,ECCENTRICITY,INCLINATION,RA_OF_ASC_NODE,ARG_OF_PERICENTER,"
    "MEAN_ANOMALY,EPHEMERIS_TYPE,CLASSIFICATION_TYPE,NORAD_CAT_ID,ELEMENT_SET_NO,REV_AT_EPOCH,BSTAR,"
    "MEAN_MOTION_DOT,MEAN_MOTION_DDOT"
)


def kozai_revs_per_day(a_km: float, i_rad: float) -> float:
    """Return the mean motion that an element set of this mean semi-major axis carries, rev/day."""
    brouwer_rad_s = math.sqrt(MU_KM3_S2 / a_km**3)
    share = 0.75 * J2 * (RADIUS_KM / a_km) ** 2 * (3.0 * math.cos(i_rad) ** 2 - 1.0)
    return brouwer_rad_s * (1.0 + share) * 86_400.0 / math.tau


def slot_errors_deg(
    count: int, rms_deg: float, seed: int, *, wave_share: float = 0.0
) -> np.ndarray:
    """
    Return errors with this root mean square and no mean, shape (count,).

    Args:
        count: Satellites.
        rms_deg: Root mean square, deg.
        seed: Of the normal distribution.
        wave_share: Share of the variance that lies in half a wave from the first to the last.
    """
    noise = np.random.default_rng(seed).normal(size=count)
    noise -= noise.mean()
    if not wave_share:
        return noise * rms_deg / math.sqrt(float(np.mean(noise**2)))
    wave = np.cos(math.pi * (np.arange(count) + 0.5) / count)
    # Free of the wave, the rest adds to it as variances do.
    noise -= wave * float(noise @ wave) / float(wave @ wave)
    noise *= math.sqrt((1.0 - wave_share) / float(np.mean(noise**2)))
    wave *= math.sqrt(wave_share / float(np.mean(wave**2)))
    return rms_deg * (noise + wave)


def main() -> None:
    """Write the file to stdout."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--count", type=int, default=93)
    parser.add_argument(
        "--altitude-km", type=float, default=780.0, help="of the mean semi-major axis"
    )
    parser.add_argument("--inclination-deg", type=float, default=86.4)
    parser.add_argument("--rms-deg", type=float, default=0.2, help="slot errors at the epoch")
    parser.add_argument("--seed", type=int, default=93)
    parser.add_argument("--spacing-deg", type=float, help="between slots; 360 / count by default")
    parser.add_argument(
        "--wave-share", type=float, default=0.0, help="of the errors' variance, in half a wave"
    )
    parser.add_argument("--name", default="RING", help="of the satellites, before their number")
    parser.add_argument("--epoch", default="2020-05-06T00:00:00.000000")
    given = parser.parse_args()
    revs = kozai_revs_per_day(6378.1363 + given.altitude_km, math.radians(given.inclination_deg))
    lines = [COLUMNS]
    errors = slot_errors_deg(given.count, given.rms_deg, given.seed, wave_share=given.wave_share)
    for number, error in enumerate(errors.tolist()):
        spacing = given.spacing_deg
        slot = 360.0 * number / given.count if spacing is None else spacing * number
        latitude = (slot + error) % 360.0
        lines.append(
            f"{given.name}-{number + 1:02d},2020-900A,{given.epoch},{revs:.8f},.0000000,{given.inclination_deg:.4f},"
            f"0.0000,0.0000,{latitude:.6f},0,U,{90001 + number},999,1,0,0,0"
        )
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
