"""Element sets: the four syntaxes agree, and a bad file is named with its line."""

import re
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from constellation_fakes import SCENARIOS

from madns_runtime.errors import ConfigurationError
from madns_runtime.simulations.constellation.orbit.constants import EARTH_POLAR_RADIUS_M, EGM_96
from madns_runtime.simulations.constellation.parameters import Sgp4Propagator
from madns_runtime.simulations.constellation.truth.element_sets import read_element_sets
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    propagate,
)
from madns_runtime.simulations.constellation.truth.propagators.sgp4_propagator import sgp4_states
from madns_runtime.simulations.constellation.truth.propagators.sgp4_records import julian_date
from madns_runtime.simulations.constellation.truth.tle_files import tle_checksum

DATA = SCENARIOS / "data"
TLE = (DATA / "iridium10.tle").read_text()
CSV = (DATA / "iridium10.csv").read_text()
JSON = (DATA / "iridium10.json").read_text()
XML = (DATA / "iridium10.xml").read_text()
EPOCH = datetime(2017, 3, 7, 13, 32, 57, tzinfo=UTC)


def faults_of(path, text):
    path.write_text(text)
    with pytest.raises(ConfigurationError) as caught:
        read_element_sets(path)
    return [line.removeprefix(f"{path}:") for line in str(caught.value).splitlines()]


@pytest.mark.parametrize("suffix", ["csv", "json", "xml"])
def test_omm_gives_the_positions_of_the_tle_it_was_made_from(suffix):
    t_s = np.arange(0.0, 14_401.0, 600.0)
    expected = sgp4_states(read_element_sets(DATA / "iridium10.tle"), EPOCH, t_s)

    sets = read_element_sets(DATA / f"iridium10.{suffix}")

    assert [s.name for s in sets] == [s.name for s in read_element_sets(DATA / "iridium10.tle")]
    # Kepler's equation inside SGP4 ends at 1e-12 rad.
    assert np.abs(sgp4_states(sets, EPOCH, t_s) - expected)[..., :3].max() < 1e-5


@pytest.mark.parametrize("text", [TLE, CSV, JSON, XML], ids=["tle", "csv", "json", "xml"])
def test_a_file_without_a_telling_suffix_is_told_by_its_content(tmp_path, text):
    path = tmp_path / "sets.txt"
    path.write_text(text)

    assert len(read_element_sets(path)) == 10


def test_epochs_are_exact_to_the_microsecond():
    for suffix in ("tle", "csv", "json", "xml"):
        first = read_element_sets(DATA / f"iridium10.{suffix}")[0]

        assert first.epoch_utc == datetime(2017, 3, 7, 7, 18, 54, 808_992, tzinfo=UTC)


def test_tle_works_without_names_with_comments_and_with_windows_line_ends(tmp_path):
    lines = TLE.splitlines()
    path = tmp_path / "sets.tle"
    path.write_text("# comment\r\n" + "\r\n".join(lines[1:3] + ["", "0 " + lines[3], *lines[4:6]]))

    assert [s.name for s in read_element_sets(path)] == ["24792", "IRIDIUM 7"]


@pytest.mark.parametrize(
    ("written", "blank"),
    [("1 24792U 97020A   05066.30", "1 24792U 97020A    5066.30"), (" 02330-4 ", "  233 -4 ")],
    ids=["year", "bstar"],
)
def test_blanks_for_zeros_in_a_tle_are_those_zeros_to_sgp4_too(tmp_path, written, blank):
    name, line1, line2 = TLE.splitlines()[:3]
    line1 = line1.replace("1 24792U 97020A   17066.30", "1 24792U 97020A   05066.30")
    line1 = f"{line1[:53]} 02330-4 {line1[62:68]}"
    states = []
    for place, text in enumerate((line1, line1.replace(written, blank))):
        assert place == 0 or text != line1
        path = tmp_path / f"{place}.tle"
        path.write_text(f"{name}\n{text}{tle_checksum(text)}\n{line2}\n")
        (element_set,) = read_element_sets(path)
        states.append(sgp4_states((element_set,), element_set.epoch_utc, np.array([0.0, 6000.0])))

    assert np.array_equal(*states)


def test_a_wrong_checksum_is_named_with_its_line(tmp_path):
    lines = TLE.splitlines()
    lines[4] = lines[4].replace("17066", "17067")

    assert faults_of(tmp_path / "a.tle", "\n".join(lines)) == [
        "5: checksum: expected 7, got '6'; the line is damaged"
    ]


def test_every_fault_of_a_file_is_reported_at_once(tmp_path):
    lines = TLE.splitlines()
    lines[1] = lines[1][:60]
    lines[5] = lines[5].replace("24793", "24799")[:68]
    lines[5] += str(tle_checksum(lines[5]))
    del lines[-1]

    faults = faults_of(tmp_path / "a.tle", "\n".join(lines))

    assert faults == [
        "2: expected 69 columns, got 60",
        "6: expected catalogue number 24793, got 24799",
        "29: expected line 2 of a TLE to follow, the file ends",
    ]


@pytest.mark.parametrize("missing", [0, 1, 2])
def test_no_lost_tle_line_goes_unnoticed(tmp_path, missing):
    lines = TLE.splitlines()
    del lines[12 + missing]
    path = tmp_path / "a.tle"
    path.write_text("\n".join(lines))

    if missing == 0:
        # Only the name is gone: the set flies under its number.
        assert read_element_sets(path)[4].name == "24796"
    else:
        assert faults_of(path, "\n".join(lines))


def test_a_number_that_is_none_is_named_with_line_and_field(tmp_path):
    text = CSV.replace("86.4011", "polar", 1)

    assert faults_of(tmp_path / "a.csv", text) == [
        "3: INCLINATION: expected a number within [0, 180], got 'polar'"
    ]


def test_a_missing_column_is_named(tmp_path):
    assert faults_of(tmp_path / "a.csv", CSV.replace("BSTAR", "B*", 1)) == [
        "1: expected the columns of an OMM, missing BSTAR"
    ]


def test_json_faults_carry_the_line_of_their_set(tmp_path):
    text = JSON.replace('"ECCENTRICITY": 0.0002196', '"ECCENTRICITY": 1.2', 1)

    assert faults_of(tmp_path / "a.json", text) == [
        "4: ECCENTRICITY: expected a number within [0, 0.9999], got '1.2'"
    ]


def test_broken_json_and_xml_are_named_with_their_place(tmp_path):
    assert faults_of(tmp_path / "a.json", "[\n{,") == [
        "2:2: Expecting property name enclosed in double quotes"
    ]
    assert faults_of(tmp_path / "a.xml", "<ndm>\n<omm></ndm>")[0].startswith("2:")


def test_the_theory_may_be_written_as_the_standard_does(tmp_path):
    path = tmp_path / "a.xml"
    path.write_text(XML.replace("<MEAN_ELEMENT_THEORY>SGP4", "<MEAN_ELEMENT_THEORY>SGP/SGP4"))
    (tmp_path / "b.xml").write_text(XML)

    assert read_element_sets(path) == read_element_sets(tmp_path / "b.xml")


def test_elements_of_another_theory_or_frame_are_refused(tmp_path):
    text = XML.replace("<MEAN_ELEMENT_THEORY>SGP4", "<MEAN_ELEMENT_THEORY>DSST", 1).replace(
        "<REF_FRAME>TEME", "<REF_FRAME>GCRF", 1
    )

    assert faults_of(tmp_path / "a.xml", text) == [
        "4: REF_FRAME: expected TEME, got 'GCRF'",
        "4: MEAN_ELEMENT_THEORY: expected SGP4, got 'DSST'",
    ]


def test_an_epoch_without_microseconds_is_read_and_one_with_a_zone_is_not(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(CSV.replace("2017-03-07T07:18:54.808992", "2017-03-07T07:18:54"))
    assert read_element_sets(path)[0].epoch_utc == datetime(2017, 3, 7, 7, 18, 54, tzinfo=UTC)

    assert "EPOCH" in faults_of(path, CSV.replace("54.808992", "54.808992+02:00"))[0]


NAMESPACE = "urn:ccsds:schema:ndmxml"
PREFIXED = re.sub(r"<(/?)(?=\w)", r"<\1n:", XML).replace("<n:ndm", f'<n:ndm xmlns:n="{NAMESPACE}"')


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.csv", CSV.replace("2017-03-07T", "2017-066T")),
        ("a.json", JSON.replace("2017-03-07T", "2017-066T")),
        ("a.csv", CSV.replace("2017-03-07T", "2017-03-07 ")),
        ("a.xml", XML.replace("<ndm", f'<ndm xmlns="{NAMESPACE}"', 1)),
        ("a.xml", PREFIXED),
        ("a.csv", "\n \n" + CSV),
        ("a.txt", "\n" + CSV),
        ("a.csv", CSV.replace(",", ", ")),
        ("a.tle", TLE.replace("IRIDIUM", "#1 IRI")),
    ],
    ids=[
        *("day of year csv", "day of year json", "blank for T", "default namespace", "prefix"),
        *("empty lines", "empty line txt", "blanks", "name with a number sign"),
    ],
)
def test_other_legal_forms_of_the_same_sets_are_read(tmp_path, name, text):
    assert text != {"csv": CSV, "json": JSON, "xml": XML, "tle": TLE}.get(name[2:])
    path = tmp_path / name
    path.write_text(text)
    plain = read_element_sets(DATA / f"iridium10.{name[2:].replace('txt', 'csv')}")

    found = read_element_sets(path)

    expected = [
        s.name.replace("IRIDIUM", "#1 IRI" if name == "a.tle" else "IRIDIUM") for s in plain
    ]
    assert [s.name for s in found] == expected
    assert [(s.lines, s.omm, s.epoch_utc) for s in found] == [
        (s.lines, s.omm, s.epoch_utc) for s in plain
    ]
    assert len({s.place for s in found}) == len(plain)


@pytest.mark.parametrize("date", ["2017-W10-2", "2017-000", "2017-366", "20170307", "0001-000"])
def test_dates_that_ccsds_does_not_have_are_refused(tmp_path, date):
    found = faults_of(tmp_path / "a.csv", CSV.replace("2017-03-07", date, 1))

    assert found[0].startswith("2: EPOCH: expected such as 2017-03-07T07:18:55.000000 or 2017-066T")


def test_faults_below_empty_lines_have_their_own_line(tmp_path):
    lines = ("\n\n" + CSV.replace("86.4011", "polar", 1)).splitlines()

    assert faults_of(tmp_path / "a.csv", "\n".join(lines))[0].startswith("5: INCLINATION")
    lines[2] = lines[2].replace("BSTAR", "B*")
    assert faults_of(tmp_path / "a.csv", "\n".join(lines))[0].startswith("3: expected the columns")


@pytest.mark.parametrize("name", ["a.txt", "a.kvn", "a.tle", "a.csv"])
def test_kvn_is_called_kvn(tmp_path, name):
    [fault] = faults_of(
        tmp_path / name, "CCSDS_OMM_VERS = 2.0\nOBJECT_NAME = ISS\nORIGINATOR = X\n"
    )

    assert "OMM as KVN" in fault


@pytest.mark.parametrize("comment", ["# 1 is old", "#", "#old", "#" + "1" * 24, "#1 SAT\n# one"])
def test_comments_above_a_set_without_a_name_are_no_names(tmp_path, comment):
    path = tmp_path / "a.tle"
    path.write_text("\n".join((comment, *TLE.splitlines()[1:3])))

    assert [s.name for s in read_element_sets(path)] == ["24792"]


def test_six_digit_catalogue_numbers_are_flown(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(CSV.replace("24792", "799500100"))

    states = sgp4_states(read_element_sets(path), EPOCH, np.zeros(1))

    assert np.isfinite(states).all()


@pytest.mark.parametrize("name", ["a.tle", "a.csv", "a.json", "a.xml", "a.txt"])
def test_an_empty_file_is_refused(tmp_path, name):
    assert faults_of(tmp_path / name, "")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ConfigurationError, match=r"nowhere\.tle: no such file"):
        read_element_sets(tmp_path / "nowhere.tle")


def test_a_folder_or_a_binary_file_is_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="expected a file, got a folder"):
        read_element_sets(tmp_path)
    (tmp_path / "a.tle").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(ConfigurationError, match="cannot be read"):
        read_element_sets(tmp_path / "a.tle")


@pytest.mark.parametrize(
    ("name", "text", "fault"),
    [
        ("a.json", "[" * 100_000, " maximum recursion"),
        ("a.json", '[{"EPOCH": ' + "1" * 5000 + "}]", " Exceeds the limit"),
        ("a.csv", "x" * 200_000, "0: field larger"),
        ("a.csv", CSV.splitlines()[0] + "\n" + "x" * 200_000, "1: field larger"),
        ("a.json", JSON.replace("2017-", "9999-", 1), "2: EPOCH: expected such as"),
        ("a.json", JSON.replace("2017-", "1956-", 1), "2: EPOCH: expected such as"),
        ("a.json", JSON.replace("2017-", "2200-", 1), "2: EPOCH: expected such as"),
    ],
    ids=[
        "brackets",
        "digits",
        "wide head",
        "wide field",
        "last year",
        "before Sputnik",
        "beyond series",
    ],
)
def test_what_no_element_set_looks_like_is_refused(tmp_path, name, text, fault):
    found = faults_of(tmp_path / name, text)

    assert found[0].startswith(fault), found[0]


def test_a_day_beyond_its_year_is_refused(tmp_path):
    line = TLE.splitlines()[1][:20] + "367.00000000" + TLE.splitlines()[1][32:68]
    text = "\n".join((line + str(tle_checksum(line)), TLE.splitlines()[2]))

    assert faults_of(tmp_path / "a.tle", text) == [
        "1: expected a day of its year, got 17367.00000000"
    ]


def test_a_long_list_of_faults_is_cut(tmp_path):
    faults = faults_of(tmp_path / "a.tle", "x" * 30 + "\n" + ("y" * 30 + "\n") * 100)

    assert len(faults) == 21
    assert faults[-1].endswith("and 81 more")


def test_a_set_that_sgp4_cannot_propagate_is_named():
    sets = read_element_sets(DATA / "iridium10.csv")
    fields = dict(sets[3].omm) | {"BSTAR": "1e3"}
    broken = type(sets[3])(
        name="WRECK", epoch_utc=sets[3].epoch_utc, omm=tuple(sorted(fields.items()))
    )

    with pytest.raises(ConfigurationError, match="^WRECK: SGP4: .*, at [012] s$"):
        sgp4_states((*sets[:3], broken), EPOCH, np.arange(3.0))


def test_a_set_that_falls_is_followed_down_to_the_earth_and_stands_still_there():
    high, low = read_element_sets(DATA / "iridium10.csv")[:2]
    fields = dict(low.omm) | {"MEAN_MOTION": "16.45", "BSTAR": "0.05", "ECCENTRICITY": "0.0005"}
    falling = replace(low, omm=tuple(sorted(fields.items())))
    knots_s = np.arange(0.0, 3000.0, 10.0)
    parameters = PropagationParameters(
        settings=Sgp4Propagator(kind="sgp4"),
        gravity=EGM_96,
        epoch_utc=low.epoch_utc,
        element_sets=(high, falling),
    )

    found = propagate(np.full((2, 6), 7e6), 0.0, knots_s, parameters)

    radii_m = np.linalg.norm(found[..., :3], axis=2)
    met = int(np.argmax(radii_m[1] < EARTH_POLAR_RADIUS_M))
    assert 0 < met < 299
    assert radii_m[1, met] > EARTH_POLAR_RADIUS_M - 10e3
    assert not found[1, met + 1 :, 3:].any()
    assert np.abs(radii_m[0] - 7.15e6).max() < 3e4
    with pytest.raises(ConfigurationError, match=f"^{falling.name}: SGP4: .*, at .* s$"):
        sgp4_states((high, falling), low.epoch_utc, knots_s)


# 180 km up, with the drag of a balloon: down after three hours. After four SGP4 has no states of it, later some again.
BALLOON = """FALL
1 25544U 98067A   20045.18587073  .00000950  00000-0  10000-0 0  9995
2 25544  51.6443 242.2052 0010000 264.6060 207.3845 16.10000000212795
"""
DOWN_S, WITHOUT_S = 10_640.0, 14_400.0


@pytest.fixture
def beside_a_balloon(tmp_path):
    (tmp_path / "a.tle").write_text(BALLOON)
    (balloon,) = read_element_sets(tmp_path / "a.tle")
    high = replace(read_element_sets(DATA / "iridium10.csv")[0], epoch_utc=balloon.epoch_utc)
    parameters = PropagationParameters(
        settings=Sgp4Propagator(kind="sgp4"),
        gravity=EGM_96,
        epoch_utc=balloon.epoch_utc,
        element_sets=(high, balloon),
    )
    return np.full((2, 6), 7e6), parameters


@pytest.mark.parametrize("window_s", [300.0, 21_600.0])
def test_a_set_that_sgp4_does_not_know_after_its_fall_ends_nobody_else(beside_a_balloon, window_s):
    states, parameters = beside_a_balloon
    alone = parameters.of([0])
    for from_s in np.arange(0.0, 21_600.0, window_s):
        knots_s = np.arange(from_s, from_s + window_s + 1.0, 10.0)

        found = propagate(states, from_s, knots_s, parameters)

        assert np.array_equal(found[:1], propagate(states[:1], from_s, knots_s, alone))
        down_m = np.linalg.norm(found[1, knots_s > DOWN_S + 20.0, :3], axis=-1)
        assert np.abs(down_m - EARTH_POLAR_RADIUS_M).max(initial=0.0) < 1e3
        states = found[:, -1]
    assert not states[1, 3:].any()


def test_a_set_without_states_that_has_not_fallen_ends_the_run(beside_a_balloon):
    _, parameters = beside_a_balloon

    with pytest.raises(ConfigurationError, match="^FALL: SGP4: mean eccentricity .* at 14"):
        propagate(np.full((2, 6), 7e6), WITHOUT_S, WITHOUT_S + np.arange(9.0), parameters)


def test_julian_dates_are_those_of_the_almanac():
    assert julian_date(datetime(2000, 1, 1, 12, tzinfo=UTC)) == (2_451_545.0, 0.0)
    assert sum(julian_date(datetime(1957, 10, 4, 19, 26, 24, tzinfo=UTC))) == 2_436_116.31
    whole, part = julian_date(datetime(2017, 3, 7, 12, 0, 0, 1, tzinfo=UTC))
    assert (whole, part) == (2_457_820.0, 1e-6 / 86_400.0)


def test_sources_are_named_for_every_data_file():
    text = (DATA / "SOURCES.md").read_text()
    listed = re.findall(r"^\| ([^ |][^|]*\.\w+) \|", text, flags=re.M)
    named = {name for cell in listed for name in _files_of(cell)}
    there = {path.name for path in Path(DATA).iterdir() if path.is_file()}

    assert named == there - {"SOURCES.md", "make_ring.py"}
    assert "`python scenarios/data/make_ring.py`" in text


def _files_of(cell):
    """Return the names in "a.csv, .json, b.tle"; what is an ending alone is of the file before it."""
    stem = ""
    for name in cell.split(", "):
        stem = stem if name.startswith(".") else Path(name).stem
        yield f"{stem}{Path(f'x{name}').suffix}"
