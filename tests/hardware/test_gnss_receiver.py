"""`gnss_receiver`: its messages read back by other people's parsers, its line, and whole constellations of receivers."""

from __future__ import annotations

import contextlib
import io
import itertools
import math
import os
import select
import time
from collections import Counter
from datetime import UTC, datetime

import numpy as np
import pytest
from harness.cosmos_command import LOOSE, CosmosCommand
from harness.waiting import wait_until
from pyubx2 import NMEA_PROTOCOL, UBX_PROTOCOL, UBXReader

from madns_runtime.config import DURATION_S_MAX
from madns_runtime.errors import MachineError, PluginError
from madns_runtime.hardware.gnss_messages import GnssMessage, ToldQuality, encode
from madns_runtime.hardware.gnss_solution import GnssSolution, geodetic
from madns_runtime.hardware.kind_registry import prepare
from madns_runtime.recording.reader import read_stream
from madns_runtime.simulations.constellation.orbit.earth import (
    days_since_j2000,
    fixed_to_teme,
    geodetic_to_fixed,
    gmst_rad,
)
from madns_runtime.simulations.constellation.truth.element_set import LAST_YEAR
from tests.hardware.bench import Terminal
from tests.hardware.driving import opened

QUALITY = ToldQuality(
    position_m=2.5, velocity_m_s=0.05, time_ns=30, satellites=12, dilution=1.2, geoid_m=40.0
)
LEO = (-6_123_456.78914, 1_234_567.89126, -3_210_987.65432)
SPEED = (1234.5678, 5678.9123, -4321.0987)
EPOCH = "2026-03-20T12:00:00Z"
ALL_MESSAGES = GnssMessage.__args__


def unix_s(text):
    return datetime.fromisoformat(text).timestamp()


def solution(utc="2026-03-20T12:34:56.700Z", position=LEO, velocity=SPEED):
    return GnssSolution.of((unix_s(utc), *position, *velocity), 18)


def parsed(data):
    stream = io.BytesIO(data)
    return [m for _, m in UBXReader(stream, protfilter=NMEA_PROTOCOL | UBX_PROTOCOL, quitonerror=2)]


def read_back(name, of=None):
    [message] = parsed(encode(name, of or solution(), QUALITY))
    return message


def position_of(message):
    """Return the position of NAV-HPPOSECEF, m: pyubx2 joins both parts of each component, cm."""
    return 1e-2 * np.array([message.ecefX, message.ecefY, message.ecefZ])


def test_gps_time_is_ahead_of_utc_by_the_leap_seconds():
    # 2017 began with GPS week 1930, whose first midnight of UTC is 18 s into it.
    first = solution("2017-01-01T00:00:00Z")
    assert (first.week, first.time_of_week_ms) == (1930, 18_000)
    last = solution("2016-12-31T23:59:41.999Z")
    assert (last.week, last.time_of_week_ms) == (1929, 604_799_999)
    assert GnssSolution.of((unix_s("2017-01-01T00:00:00Z"), *LEO, *SPEED), 0).time_of_week_ms == 0


@pytest.mark.parametrize(
    ("utc", "leap_s"),
    [
        ("1980-01-06T00:00:00Z", 0),
        ("1999-01-01T00:00:00Z", 13),
        ("2000-01-01T12:00:00Z", 13),
        ("2005-12-31T23:59:59.999Z", 13),
        ("2006-01-01T00:00:00Z", 14),
        ("2012-01-01T00:00:00Z", 15),
        ("2015-07-01T00:00:00Z", 17),
        ("2016-12-31T23:59:59.9994Z", 17),
        ("2016-12-31T23:59:59.9996Z", 18),  # on a whole millisecond it is 2017
        ("2017-01-01T00:00:00Z", 18),
        ("2199-12-31T23:59:59Z", 18),
    ],
)
def test_a_receiver_knows_the_leap_seconds_of_its_epoch(tmp_path, utc, leap_s):
    assert gps_minus_utc_s(tmp_path, utc) == (leap_s, leap_s)
    assert gps_minus_utc_s(tmp_path, utc, leap_seconds=18) == (18, 18)


def gps_minus_utc_s(folder, utc, **parameters):
    """Return what a receiver tells of it, and what the two times that it tells differ by, within a day."""
    parameters |= {"link": "gps", "messages": ["NAV-TIMEGPS", "NAV-TIMEUTC"]}
    with opened("gnss_receiver", folder, **parameters) as device:
        device.read()
        computer = os.open(folder / "gps", os.O_RDONLY | os.O_NOCTTY)
        device.write({"epoch": (unix_s(utc), *LEO, *SPEED)}, 0.0)
        gps, told = heard(computer, 2)
        os.close(computer)
    of_day_s = 3600 * told.hour + 60 * told.min + told.sec + told.nano * 1e-9
    return gps.leapS, round(gps.iTOW * 1e-3 - of_day_s, 6) % 86_400


def test_every_year_that_a_scenario_may_have_is_within_the_limits_of_an_epoch(tmp_path):
    prepared = prepare("gnss_receiver", {"link": "gps"}, tmp_path)
    [epoch] = [channel for channel in prepared.channels if channel.name == "epoch"]

    assert epoch.limits[1] >= unix_s(f"{LAST_YEAR - 1}-12-31T23:59:59Z") + DURATION_S_MAX


def test_an_epoch_is_brought_to_a_whole_millisecond_by_its_velocity():
    base = 1_700_000_000.0
    moved = GnssSolution.of((base + 0.33333, *LEO, *SPEED), 18)
    near = GnssSolution.of((base + 0.2 + 2e-7, *LEO, *SPEED), 18)

    assert moved.millisecond == 333
    expected = [r - 0.00033 * v for r, v in zip(LEO, SPEED, strict=True)]
    assert moved.position_m == pytest.approx(expected, abs=3e-3)
    assert (near.millisecond, near.position_m) == (200, LEO)


def test_heights_and_latitudes_are_those_of_the_ellipsoid():
    degrees = np.radians([-90.0, -89.999, -45.0, -1e-6, 0.0, 23.4, 60.0, 89.9999, 90.0])
    heights = [0.0, 780e3, 2e6, 36e6]
    for latitude, height_m in itertools.product(degrees, heights):
        place, _ = geodetic_to_fixed(*(np.array([n]) for n in (latitude, -2.1, height_m)))
        found = geodetic(tuple(place[0]))
        assert found[0] == pytest.approx(latitude, abs=1e-13)
        assert found[2] == pytest.approx(height_m, abs=2e-8)
        if abs(latitude) < 1.5707:
            assert found[1] == pytest.approx(-2.1, abs=1e-12)


def test_pyubx2_reads_a_position_to_a_tenth_of_a_millimetre():
    message = read_back("NAV-HPPOSECEF")

    assert message.iTOW == solution().time_of_week_ms == 477_314_700
    assert position_of(message) == pytest.approx(LEO, abs=5.1e-5)
    assert (message.invalidEcef, message.pAcc) == (0, 2500.0)  # mm


def test_pyubx2_reads_navigation_within_the_digits_of_its_fields():
    told = read_back("NAV-PVT")
    latitude, longitude, height_m = geodetic(LEO)

    when = (told.year, told.month, told.day, told.hour, told.min, told.second, told.nano)
    assert when == (2026, 3, 20, 12, 34, 56, 700_000_000)
    assert (told.iTOW, told.fixType, told.gnssFixOk, told.numSV) == (477_314_700, 3, 1, 12)
    assert (told.validDate, told.validTime, told.fullyResolved, told.invalidLlh) == (1, 1, 1, 0)
    assert told.lat == pytest.approx(math.degrees(latitude), abs=5.1e-8)
    assert told.lon == pytest.approx(math.degrees(longitude), abs=5.1e-8)
    assert told.height == pytest.approx(1e3 * height_m, abs=0.51)
    assert told.hMSL == pytest.approx(1e3 * (height_m - 40.0), abs=0.51)
    north, east, down = solution().velocity_ned_m_s(latitude, longitude)
    assert [told.velN, told.velE, told.velD] == pytest.approx(
        [1e3 * north, 1e3 * east, 1e3 * down], abs=0.51
    )
    assert math.hypot(told.velN, told.velE, told.velD) == pytest.approx(
        1e3 * math.hypot(*SPEED), abs=1.0
    )
    assert told.gSpeed == pytest.approx(1e3 * math.hypot(north, east), abs=0.51)
    assert told.headMot == pytest.approx(math.degrees(math.atan2(east, north)) % 360, abs=1e-5)
    assert (told.hAcc, told.sAcc, told.pDOP) == (2500, 50, 1.2)


def test_pyubx2_reads_the_other_messages():
    told = read_back("NAV-POSECEF")
    assert [told.ecefX, told.ecefY, told.ecefZ] == [round(100 * r) for r in LEO]
    told = read_back("NAV-VELECEF")
    assert [told.ecefVX, told.ecefVY, told.ecefVZ] == [round(100 * v) for v in SPEED]
    told = read_back("NAV-TIMEUTC")
    assert (told.year, told.month, told.day) == (2026, 3, 20)
    assert (told.hour, told.min, told.sec, told.nano) == (12, 34, 56, 700_000_000)
    assert (told.validTOW, told.validWKN, told.validUTC) == (1, 1, 1)
    told = read_back("NAV-TIMEGPS")
    assert (told.iTOW, told.fTOW, told.week, told.leapS) == (477_314_700, 0, 2410, 18)


@pytest.mark.parametrize("position", [LEO, (5.0, -3.0, 6_900_000.0), (6.9e6, -1e-9, 1e-9)])
def test_sentences_are_read_within_their_digits(position):
    of = solution(position=position)
    latitude, longitude, height_m = geodetic(position)
    gga, rmc = read_back("GGA", of), read_back("RMC", of)

    for told in (gga, rmc):
        assert (told.lat, told.lon) == pytest.approx(
            (math.degrees(latitude), math.degrees(longitude)), abs=2e-9
        )
        assert told.time.isoformat() == "12:34:56.700000"
    assert gga.alt == pytest.approx(height_m - 40.0, abs=5.1e-4)
    assert (gga.sep, gga.numSV, gga.quality) == (40.0, 12, 1)
    assert rmc.date.isoformat() == "2026-03-20"
    north, east, _ = of.velocity_ned_m_s(latitude, longitude)
    assert rmc.spd == pytest.approx(math.hypot(north, east) * 3600 / 1852, abs=5.1e-4)
    assert rmc.cog == pytest.approx(math.degrees(math.atan2(east, north)) % 360, abs=5.1e-4)


def test_a_position_that_a_field_cannot_hold_is_said_to_be_invalid():
    far = solution(position=(42_164_000.0, 0.0, 0.0))

    assert read_back("NAV-HPPOSECEF", far).invalidEcef == 1
    assert read_back("NAV-PVT", far).invalidLlh == 1


# The line --------------------------------------------------------------------------------------------


def epoch(number):
    return {"epoch": (unix_s(EPOCH) + number, *LEO, *SPEED)}


def heard(fd, wanted):
    """Return what comes over a line until it is idle with so many bytes of messages there."""
    data, deadline_s = b"", time.monotonic() + 120
    while True:
        assert time.monotonic() < deadline_s
        if select.select([fd], [], [], 0.1)[0]:
            data += os.read(fd, 65_536)
        elif data.count(b"\xb5\x62") + data.count(b"$GN") >= wanted:
            return parsed(data)


def test_a_flight_computer_reads_the_receivers_pseudo_terminal(tmp_path):
    link = tmp_path / "lines" / "gps"
    with opened("gnss_receiver", tmp_path, link="lines/gps", messages=list(ALL_MESSAGES)) as device:
        device.read()
        computer = os.open(link, os.O_RDONLY | os.O_NOCTTY)
        device.write(epoch(0), 0.0)
        messages = heard(computer, len(ALL_MESSAGES))
        os.close(computer)
        assert device.read().values == {"epochs": 1.0}

    assert [m.identity for m in messages] == [*ALL_MESSAGES[:6], "GNGGA", "GNRMC"]
    assert not link.is_symlink()


def test_what_nobody_reads_gives_way_to_the_newest_and_nothing_is_cut(tmp_path):
    counted = Counter()
    with opened("gnss_receiver", tmp_path, link="gps") as device:
        device.count = lambda name, number: counted.update({name: number})
        device.read()
        for number in range(200):
            device.write(epoch(number), 0.0)
        computer = os.open(tmp_path / "gps", os.O_RDONLY | os.O_NOCTTY)
        messages = heard(computer, 3)
        device.write(epoch(200), 0.0)
        messages += heard(computer, 3)
        os.close(computer)
        health = device.health()

    assert health["epochs_overwritten"] == counted["epochs_overwritten"] > 0
    assert health["epochs_given_up"] == 0
    assert len(messages) % 3 == 0
    assert messages[-1].sec == 20
    assert len(messages) < 3 * 200


def test_it_writes_to_a_serial_port_and_refuses_what_is_none(tmp_path):
    terminal = Terminal()
    with opened("gnss_receiver", tmp_path, port=terminal.port, messages=["NAV-PVT"]) as device:
        device.write(epoch(0), 0.0)
        assert [m.identity for m in heard(terminal.fd, 1)] == ["NAV-PVT"]
        with pytest.raises(MachineError, match="another program has it open"):
            prepare("gnss_receiver", {"port": terminal.port}, tmp_path).make().open()
    terminal.close()
    for port, why in ((tmp_path / "none", "No such file"), ("/dev/null", "no serial port")):
        with pytest.raises(MachineError, match=why):
            prepare("gnss_receiver", {"port": str(port)}, tmp_path).make().open()


def test_a_port_that_is_pulled_out_is_gone_before_its_next_epoch(tmp_path):
    terminal = Terminal()
    with opened("gnss_receiver", tmp_path, port=terminal.port) as device:
        os.write(terminal.fd, b"order")
        wait_until(lambda: device.read() and device.health()["heard_bytes"])
        assert device.read().values == {"epochs": 0.0}  # idle, and not gone
        terminal.close()
        with pytest.raises(MachineError, match="/dev/pts/.* is gone"):
            device.read()

    assert device.health()["heard_bytes"] == 5


def test_a_link_takes_no_place_of_something_else_and_tells_who_took_its_own(tmp_path):
    (tmp_path / "file").write_text("mine")
    with (
        opened("gnss_receiver", tmp_path, link="file") as device,
        pytest.raises(MachineError, match="something else is there"),
    ):
        device.read()
    with opened("gnss_receiver", tmp_path, link="gps") as first:
        first.read()
        with opened("gnss_receiver", tmp_path, link="gps") as second:
            second.read()
            with pytest.raises(MachineError, match="tells receivers apart"):
                first.read()
    assert (tmp_path / "file").read_text() == "mine"


def test_it_writes_either_to_a_port_or_to_a_terminal_of_its_own(tmp_path):
    for parameters in ({}, {"port": "/dev/ttyUSB0", "link": "gps"}):
        with pytest.raises(PluginError, match="a link to its pseudo-terminal, or a port"):
            prepare("gnss_receiver", parameters, tmp_path)
    assert prepare("gnss_receiver", {"port": "/dev/ttyUSB0"}, tmp_path).needs.groups == ("dialout",)


# A constellation of receivers --------------------------------------------------------------------------

SCENARIO = """
name: receivers
simulation: constellation
agents: {count: %d, tick_hz: 10}
time: {duration_s: %g}
hardware:
  armed: true
  stale_ratio: 1
  lost: 1000
  stimulus_late: 1
  stimulus_underruns: 1000
  on_device_loss: continue
  devices:
    - name: gps
      kind: gnss_receiver
      rate_hz: 10
      parameters: {link: "lines/${name}", messages: [NAV-PVT, NAV-HPPOSECEF, NAV-TIMEUTC, GGA, RMC]}
parameters:
  epoch_utc: "2026-03-20T12:00:00Z"
  satellites: {walker: "60:%d/1/0", altitude_km: 600}
  vehicles:
    - stimuli: [{source: gnss_epoch, channel: gps.epoch, rate_hz: 10}]
"""


class Computers:
    """Flight computers that read one receiver each."""

    def __init__(self, folder, names):
        self.fds = {}
        self.data = dict.fromkeys(names, b"")
        wait_until(
            lambda: all((folder / "lines" / name).is_symlink() for name in names), "all lines"
        )
        for name in names:
            self.fds[os.open(folder / "lines" / name, os.O_RDONLY | os.O_NOCTTY)] = name

    def read(self, timeout_s):
        for fd in select.select(list(self.fds), [], [], timeout_s)[0]:
            with contextlib.suppress(OSError):  # the receiver is gone
                data = os.read(fd, 65_536)
                self.data[self.fds[fd]] += data
                if data:
                    continue
            self.close(fd)

    def close(self, fd):
        os.close(fd)
        del self.fds[fd]


def fly(tmp_path, count, duration_s):
    """Fly receivers that computers read, and return run.json, its folder and each computer's messages."""
    scenario = tmp_path / "receivers.yaml"
    scenario.write_text(SCENARIO % (count, duration_s, count))
    cosmos = CosmosCommand(tmp_path)
    names = [f"agent-{number:02d}" for number in range(1, count + 1)]
    with cosmos.start_run(scenario, *LOOSE) as process:
        try:
            computers = Computers(tmp_path, names)
            deadline_s = time.monotonic() + duration_s + 120
            while computers.fds:
                assert time.monotonic() < deadline_s
                computers.read(1.0)
            out, err = process.communicate(timeout=120)
        except BaseException:
            process.kill()
            raise
    assert process.returncode == 0, (out, err)
    [folder] = cosmos.runs.glob("0001-receivers")
    return folder, {name: parsed(data) for name, data in computers.data.items()}


def judge(folder, name, messages):
    """Compare a computer's messages with the truth of its vehicle, and return how many positions there were."""
    tow_0_ms = solution(EPOCH).time_of_week_ms
    truth = {}
    for tick, *state in read_stream(folder / "agents" / name / "state.jsonl").records():
        angle = -gmst_rad(days_since_j2000(datetime.fromisoformat(EPOCH), tick / 10))
        truth[tow_0_ms + 100 * tick] = fixed_to_teme(np.array(state[:3]), angle)
    positions = [m for m in messages if m.identity == "NAV-HPPOSECEF" and m.iTOW in truth]
    for message in positions:
        assert position_of(message) == pytest.approx(truth[message.iTOW], abs=0.01)
    tows = [message.iTOW for message in positions]
    assert tows == sorted(set(tows))
    for message in messages:
        if message.identity == "NAV-PVT" and message.iTOW in truth:
            latitude, longitude, height_m = geodetic(tuple(truth[message.iTOW]))
            # 1e-7 deg and 1 mm of the fields, and what the digits of a date make of the Earth's turn.
            assert message.lat == pytest.approx(math.degrees(latitude), abs=6e-8)
            assert message.lon == pytest.approx(math.degrees(longitude), abs=6e-8)
            assert message.height == pytest.approx(1e3 * height_m, abs=1.0)
        if message.identity == "GNGGA":
            at = datetime.combine(datetime.fromisoformat(EPOCH), message.time, UTC)
            tow_ms = tow_0_ms + round((at.timestamp() - unix_s(EPOCH)) * 1e3)
            if tow_ms in truth:
                latitude, longitude, height_m = geodetic(tuple(truth[tow_ms]))
                assert message.lat == pytest.approx(math.degrees(latitude), abs=3e-9)
                assert message.lon == pytest.approx(math.degrees(longitude), abs=3e-9)
                assert message.alt == pytest.approx(height_m, abs=1e-3)
    return len(positions)


@pytest.mark.process
def test_flight_computers_of_several_vehicles_read_their_own_true_positions(tmp_path):
    folder, messages = fly(tmp_path, 2, 3)

    for name, told in messages.items():
        assert {m.identity for m in told} == {
            "NAV-PVT", "NAV-HPPOSECEF", "NAV-TIMEUTC", "GNGGA", "GNRMC",
        }  # fmt: skip
        assert judge(folder, name, told) >= 3
        state = read_stream(folder / "devices" / name / "gps" / "epoch.jsonl").records()
        assert len(list(state)) >= 3
    assert not list((tmp_path / "lines").iterdir())


@pytest.mark.nightly
@pytest.mark.process
def test_ten_receivers_at_ten_hertz_tell_the_truth_for_a_minute(tmp_path):
    folder, messages = fly(tmp_path, 10, 60)

    counts = {name: judge(folder, name, told) for name, told in messages.items()}
    assert len(counts) == 10
    assert min(counts.values()) >= 540, counts
