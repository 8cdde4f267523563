"""What flies is known to fly before anything is launched: every nonsense in element sets has a file and a line."""

import json
import random
import re
import subprocess
import sys

import numpy as np
import pytest
from constellation_fakes import SCENARIOS, parameters
from pydantic import ValidationError

from cosmos_cli.models.parameters import adapter_of
from madns_runtime.simulations.constellation.check import find_faults
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.parameters import ConstellationParameters
from madns_runtime.simulations.constellation.truth.element_set import NUMBERS
from madns_runtime.simulations.constellation.truth.initial_states import load_fleet
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    propagate,
)
from madns_runtime.simulations.constellation.truth.tle_files import tle_checksum

DATA = SCENARIOS / "data"
TEXTS = {
    suffix: (DATA / f"iridium10.{suffix}").read_text() for suffix in ("tle", "csv", "json", "xml")
}
DAY_S = 86_400.0
SGP4 = {"kind": "sgp4"}


def faults(folder, name, text, *, count=2, duration_s=DAY_S, **rest):
    (folder / name).write_text(text)
    params = parameters({"elements": name}, **rest)
    prefix = f"parameters.satellites.elements: {folder}/"
    found = find_faults(params, count, folder, duration_s=duration_s)
    return [fault.removeprefix(prefix) for fault in found]


def tle(line, start, columns):
    """Put other columns into a line of the TLE, and make its checksum right."""
    lines = TEXTS["tle"].splitlines()
    changed = lines[line - 1][:start] + columns + lines[line - 1][start + len(columns) : 68]
    lines[line - 1] = changed + str(tle_checksum(changed))
    return "\n".join(lines)


@pytest.mark.parametrize("name", ["a.tle", "a.csv", "a.json", "a.xml"])
def test_sets_that_are_none_of_sgp4_are_refused_by_their_ephemeris_type(tmp_path, name):
    suffix = name[2:]
    changes = {
        "csv": (",0,U,", ",{},U,"),
        "json": ('"EPHEMERIS_TYPE": 0,', '"EPHEMERIS_TYPE": {},'),
        "xml": ("<EPHEMERIS_TYPE>0<", "<EPHEMERIS_TYPE>{}<"),
    }

    def found(kind):
        if suffix == "tle":
            return faults(tmp_path, name, tle(2, 62, kind))
        before, after = changes[suffix]
        return faults(tmp_path, name, TEXTS[suffix].replace(before, after.format(kind), 1))

    assert [found(kind) for kind in "02"] == [[], []]
    (fault,) = found("4")
    assert "EPHEMERIS_TYPE: expected 0, a set of SGP4, got 4: SGP4-XP" in fault


@pytest.mark.parametrize(
    ("line", "start", "columns", "fault"),
    [
        (3, 8, "999.9000", "3: INCLINATION: expected a number within [0, 180], got '999.9000'"),
        (
            3,
            17,
            "400.0000",
            "3: RA_OF_ASC_NODE: expected a number within [-360, 360], got '400.0000'",
        ),
        (3, 26, "9999999", "3: ECCENTRICITY: expected a number within [0, 0.9999], got '.9999999'"),
        (3, 34, "999.0000", "3: ARG_OF_PERICENTER: expected"),
        (3, 43, "999.0000", "3: MEAN_ANOMALY: expected"),
        (
            3,
            52,
            " 0.00000000",
            "3: MEAN_MOTION: expected a number within [0.001, 20], got ' 0.00000000'",
        ),
        (3, 52, "99.00000000", "3: MEAN_MOTION: expected"),
        (3, 8, " 86.4O04", "3: expected the columns of line 2 of a TLE"),
        (2, 53, "garbage!", "2: expected the columns of line 1 of a TLE"),
        (2, 53, " 99999+9", "2: BSTAR: expected a number within [-10, 10], got '.99999e+9'"),
        (2, 44, " 99999+9", "2: MEAN_MOTION_DDOT: expected"),
        (2, 33, " .0000Q181", "2: expected the columns of line 1 of a TLE"),
        (2, 18, "17366.00000000", "2: expected a day of its year, got 17366.00000000"),
        (2, 18, "17000.00000000", "2: expected a day of its year, got 17000.00000000"),
        (2, 18, "  066.0", "2: expected a year and a day of it as 17066.0, got '  066.0"),
        (2, 18, "17 6 .0", "2: expected a year and a day of it as 17066.0, got '17 6 .0"),
        (
            2,
            18,
            "57066.00000000",
            "2: IRIDIUM 8: expected an epoch within 366 days of the start 2017-",
        ),
        (3, 26, "7000000", "2: IRIDIUM 8: expected a perigee above the ground, got -4231 km"),
        (3, 52, "18.00000000", "2: IRIDIUM 8: expected a perigee above the ground, got -"),
    ],
    ids=str,
)
def test_nonsense_in_a_tle_with_a_right_checksum_is_found(tmp_path, line, start, columns, fault):
    found = faults(tmp_path, "a.tle", tle(line, start, columns))

    assert len(found) == 1, found
    assert found[0].startswith(f"a.tle:{fault}"), found[0]


def test_what_is_sound_has_no_faults(tmp_path):
    for suffix, text in TEXTS.items():
        assert faults(tmp_path, f"a.{suffix}", text, count=10, propagator=SGP4) == []


def with_value(suffix, key, value):
    """Give the first set of a file another value."""
    text = TEXTS[suffix]
    if suffix == "csv":
        head, first, *rest = text.splitlines()
        row = first.split(",")
        row[head.split(",").index(key)] = value
        return "\n".join((head, ",".join(row), *rest))
    if suffix == "json":
        return re.sub(rf'("{key}": ?)[^,}}]+', rf"\g<1>{value}", text, count=1)
    return re.sub(rf"(<{key}>)[^<]*", rf"\g<1>{value}", text, count=1)


@pytest.mark.parametrize("suffix", ["csv", "json", "xml"])
@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(
            (key, bad)
            for key in NUMBERS
            for bad in ("NaN", "Infinity", "1e999", "1_0", "0x10", '"x"')
        ),
        ("MEAN_MOTION", "0"),
        ("ECCENTRICITY", "1.0"),
        ("ECCENTRICITY", "-0.1"),
        ("INCLINATION", "999.9"),
        ("BSTAR", "1e300"),
        ("BSTAR", "[1]"),
        ("EPOCH", '"2017-13-45"'),
    ],
    ids=str,
)
def test_nonsense_in_an_omm_is_found(tmp_path, suffix, key, value):
    found = faults(tmp_path, f"a.{suffix}", with_value(suffix, key, value))

    assert found, value
    assert all(re.match(rf"a\.{suffix}:[0-9]+:", fault) for fault in found), found
    assert "expected" in found[0] or "Expecting" in found[0], found[0]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("CLASSIFICATION_TYPE", "unclassified"),
        ("ELEMENT_SET_NO", "9" * 30),
        ("REV_AT_EPOCH", "1.0"),
    ],
)
def test_what_changes_no_orbit_may_be_anything(tmp_path, key, value):
    (first, *rest) = json.loads(TEXTS["json"])

    assert faults(tmp_path, "a.json", json.dumps([{**first, key: value}, *rest])) == []


@pytest.mark.parametrize("name", ["A\nB", "A\u202eB", "A" * 201, ""])
def test_a_name_that_no_table_can_hold_is_found_in_the_file(tmp_path, name):
    first, second, *_ = json.loads(TEXTS["json"])
    named = {**second, "OBJECT_NAME": name, "NORAD_CAT_ID": ""}

    (fault,) = faults(tmp_path, "a.json", json.dumps([first, named], indent=0))

    assert re.match(r"a\.json:[0-9]+: expected a name of at most 200 printable characters", fault)
    assert faults(tmp_path, "a.json", json.dumps([first, named]), count=1) == []  # who flies not


@pytest.mark.parametrize("long", ["entry", "EPOCH", "REF_FRAME"])
def test_a_fault_of_an_omm_shows_the_beginning_of_what_is_wrong(tmp_path, long):
    sets = json.loads(TEXTS["json"])
    wrong = sets if long == "entry" else {**sets[0], long: "x" * 10_000}

    (fault,) = faults(tmp_path, "a.json", json.dumps([wrong]))

    assert "expected" in fault
    assert len(fault) < 250


def test_a_value_that_is_given_twice_is_found(tmp_path):
    csv_text, json_text, xml_text = (TEXTS[suffix] for suffix in ("csv", "json", "xml"))
    head, *rows = csv_text.splitlines()
    twice = [f"{head},BSTAR", *(f"{row},1" for row in rows)]
    more = [head, f"{rows[0]},1", *rows[1:]]
    doubled = json_text.replace('"BSTAR"', '"INCLINATION": 1, "BSTAR"', 1)
    again = xml_text.replace("<BSTAR>", "<INCLINATION>1</INCLINATION><BSTAR>", 1)

    assert faults(tmp_path, "a.csv", "\n".join(twice)) == [
        "a.csv:1: expected every column once, got BSTAR again"
    ]
    assert faults(tmp_path, "a.csv", "\n".join(more)) == [
        f"a.csv:2: expected {len(head.split(','))} values, got more"
    ]
    assert (
        "expected every field once, got INCLINATION again" in faults(tmp_path, "a.json", doubled)[0]
    )
    assert re.match(
        r"a\.xml:[0-9]+: expected INCLINATION once", faults(tmp_path, "a.xml", again)[0]
    )


def test_a_satellite_that_would_fly_twice_is_found_with_both_lines(tmp_path):
    lines = TEXTS["tle"].splitlines()
    text = "\n".join((*lines[:3], "IRIDIUM EIGHT", *lines[1:3]))

    assert faults(tmp_path, "a.tle", text) == [
        "a.tle:5: IRIDIUM EIGHT: expected every satellite once, got catalogue number 24792 as in "
        f"{tmp_path}/a.tle:2; choose by satellites.names"
    ]


def test_what_does_not_fly_may_be_old_or_twice_in_the_file(tmp_path):
    lines = TEXTS["tle"].splitlines()
    text = "\n".join((*lines, "OLD", *tle(2, 18, "57066.00000000").splitlines()[1:3], *lines[:3]))

    assert faults(tmp_path, "a.tle", text, count=10) == []


def test_sgp4_is_asked_at_the_start_and_until_the_end(tmp_path):
    # A perigee of 80 km: drag makes the orbit rounder than round after 21 minutes, before it meets the Earth.
    low = with_value("csv", "MEAN_MOTION", "16.2")
    eccentricity = low.splitlines()[1].split(",")[4]
    low = low.replace("5.7411e-05", "0.01", 1).replace(eccentricity, "0.02", 1)

    assert faults(tmp_path, "a.csv", low, propagator=SGP4, duration_s=60.0) == []
    (fault,) = faults(tmp_path, "a.csv", low, propagator=SGP4, duration_s=20 * DAY_S)
    assert re.match(r"a\.csv:2: IRIDIUM 8: SGP4: mean eccentricity .*, at \d+(\.\d+)? s", fault), (
        fault
    )
    # Other propagators ask SGP4 for the start alone.
    assert faults(tmp_path, "a.csv", low, duration_s=20 * DAY_S) == []
    (fault,) = faults(tmp_path, "a.csv", low, epoch_utc="2017-06-07T00:00:00Z")
    assert re.match(r"a\.csv:2: IRIDIUM 8: SGP4: .* at 0 s", fault), fault


@pytest.mark.parametrize("duration_s", [14_000.0, 14_300.0, 15_500.0, 20_000.0, 21_600.0])
def test_what_sgp4_does_not_know_after_a_fall_is_no_fault(tmp_path, duration_s):
    fallen = (
        "1 25544U 98067A   20045.18587073  .00000950  00000-0  10000-0 0  9995\n"
        "2 25544  51.6443 242.2052 0010000 264.6060 207.3845 16.10000000212795\n"
    )

    assert faults(tmp_path, "a.tle", fallen, count=1, propagator=SGP4, duration_s=duration_s) == []


@pytest.mark.parametrize(
    ("satellites", "rest", "fault"),
    [
        ({"walker": "1" * 5000 + ":66/6/2", "altitude_km": 780.0}, {}, "walker: expected"),
        ({"walker": "86.4:" + "6" * 5000 + "/6/2", "altitude_km": 780.0}, {}, "walker: expected"),
        ({"walker": "nan:66/6/2", "altitude_km": 780.0}, {}, "walker: expected"),
        ({"walker": "999.9:66/6/2", "altitude_km": 780.0}, {}, "walker: expected an inclination"),
        (
            {"keplerian": [{"name": "A", "a_km": 6500, "e": 0.5}, {"name": "B", "a_km": 7000}]},
            {},
            "keplerian[0]: perigee lies 3128.1 km below",
        ),
        (
            {"walker": "86.4:66/6/2", "altitude_km": 780.0},
            {"epoch_utc": "9999-12-31T23:59:59Z"},
            "expected a year from 1957 to 2199",
        ),
        (
            {"walker": "86.4:66/6/2", "altitude_km": 780.0},
            {"epoch_utc": "0001-01-01T00:00:00Z"},
            "expected a year from 1957 to 2199",
        ),
    ],
    ids=lambda value: str(value)[:40],
)
def test_nonsense_in_patterns_elements_and_epochs_is_found(tmp_path, satellites, rest, fault):
    found = find_faults(parameters(satellites, **rest), 2, tmp_path)

    assert len(found) == 1, found
    assert fault in found[0]


@pytest.mark.parametrize("key", ["raan_deg", "argp_deg", "mean_anomaly_deg", "i_deg", "e", "a_km"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1e9])
def test_numbers_of_an_orbit_are_bounded(key, value):
    orbit = {"name": "A", "a_km": 7000.0} | {key: value}

    with pytest.raises(ValidationError, match=key):
        adapter_of(ConstellationParameters).validate_python({"satellites": {"keplerian": [orbit]}})


ALPHABET = ' 0123456789.+-eENaAZ²\u0661,"{}[]<>/:\n\tx'


def mutated(text, chance):
    """Change some characters of a file; of a TLE often one line, with its checksum right again."""
    characters = list(text)
    for _ in range(chance.randint(1, 4)):
        at = chance.randrange(min(len(characters), 900))
        characters[at : at + chance.randint(0, 2)] = chance.choice(ALPHABET) * chance.randint(0, 2)
    lines = "".join(characters).split("\n")
    for number, line in enumerate(lines):
        if line[:2] in ("1 ", "2 ") and len(line) >= 69 and chance.random() < 0.8:
            lines[number] = line[:68] + str(tle_checksum(line[:68]))
    return "\n".join(lines)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["tle", "csv", "json", "xml"])
def test_of_whatever_is_found_sound_the_states_are_finite(tmp_path, suffix):
    chance = random.Random(f"seed of {suffix}")
    sound = 0
    for _ in range(400):
        found = faults(tmp_path, f"a.{suffix}", mutated(TEXTS[suffix], chance), propagator=SGP4)
        assert all(
            re.match(rf"a\.{suffix}(:[0-9]+)?:|parameters\.", f) or "agents" in f for f in found
        ), found
        if found:
            continue
        sound += 1
        params = parameters({"elements": f"a.{suffix}"}, propagator=SGP4)
        fleet = load_fleet(params, 2, tmp_path)
        assert np.isfinite(fleet.states).all()
        propagation = PropagationParameters(
            settings=params.propagator,
            gravity=EGM_96,
            epoch_utc=fleet.epoch_utc,
            element_sets=fleet.element_sets,
        )
        propagate(fleet.states, 0.0, np.array([0.0, DAY_S]), propagation)
    assert 10 < sound < 390


@pytest.mark.process
def test_validate_names_file_and_line_and_ends_with_2(tmp_path):
    (tmp_path / "a.tle").write_text(tle(3, 52, " 0.00000000"))
    (tmp_path / "a.yaml").write_text(
        "name: a\nsimulation: constellation\nagents: {count: 2}\ntime: {duration_s: 60}\n"
        "parameters: {satellites: {elements: a.tle}}\n"
    )

    command = [sys.executable, "-m", "cosmos_cli.start", "validate", "a.yaml", "--json"]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=120
    )

    assert done.returncode == 2, done.stderr
    (fault,) = json.loads(done.stdout)["error"]["faults"]
    assert (fault["line"], fault["path"]) == (5, "parameters.satellites.elements")
    assert "a.tle:3: MEAN_MOTION: expected a number within [0.001, 20]" in fault["message"]
