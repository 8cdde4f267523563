import dataclasses

import pytest

from madns_runtime.health.snapshot import (
    CpuTimes,
    DiskCounters,
    DiskSpace,
    Memory,
    NetworkCounters,
    Reading,
    compute_cpu_percent,
    compute_rate,
    decode_throttling,
    parse_throttled,
    to_record,
)
from madns_runtime.recording.records import HEALTH

BEFORE = Reading(
    utc="2026-01-02T03:04:05.000+00:00",
    monotonic_s=100.0,
    cpus=(CpuTimes(busy_s=10.0, total_s=100.0), CpuTimes(busy_s=20.0, total_s=100.0)),
    core_temperature_c=48.3,
    throttled_bits=0x50005,
    memory=Memory(total_bytes=1000, used_bytes=400, free_bytes=600, percent=40.0),
    disk_space=DiskSpace(total_bytes=2000, used_bytes=500, free_bytes=1500, percent=25.0),
    disk=DiskCounters(
        reads=1, writes=2, read_bytes=3000, written_bytes=4000, read_time_ms=5, write_time_ms=6
    ),
    network=NetworkCounters(
        sent_bytes=10_000,
        received_bytes=20_000,
        sent_packets=3,
        received_packets=4,
        errors=5,
        drops=6,
        loopback_bytes=7,
    ),
    udp_sockets=8,
    tcp_connections=9,
    load=(0.5, 0.25, 0.125),
    process_uptime_s=1.0,
    board_uptime_s=1234.5,
)
AFTER = dataclasses.replace(
    BEFORE,
    monotonic_s=104.0,
    cpus=(CpuTimes(busy_s=12.0, total_s=104.0), CpuTimes(busy_s=24.0, total_s=104.0)),
    disk=dataclasses.replace(BEFORE.disk, read_bytes=3400, written_bytes=4000),
    network=dataclasses.replace(BEFORE.network, sent_bytes=10_800, received_bytes=19_000),
)


def test_record_has_every_field_of_the_stream_in_any_case():
    expected = {field.name for field in HEALTH.fields}
    bare = dataclasses.replace(
        BEFORE,
        core_temperature_c=None,
        throttled_bits=None,
        disk_space=None,
        disk=None,
        network=None,
        udp_sockets=None,
        tcp_connections=None,
        load=None,
        board_uptime_s=None,
    )

    assert set(to_record(BEFORE, None)) == expected
    assert set(to_record(AFTER, BEFORE)) == expected
    assert set(to_record(bare, bare)) == expected


def test_two_looks_tell_loads_and_rates():
    record = to_record(AFTER, BEFORE)

    assert record["cpu_percent_by_core"] == [50.0, 100.0]
    assert record["cpu_percent"] == 75.0
    assert record["network_sent_bytes_per_s"] == 200.0
    assert record["disk_read_bytes_per_s"] == 100.0
    assert record["disk_written_bytes_per_s"] == 0.0
    assert record["network_received_bytes_per_s"] is None  # the counter went back


def test_one_look_tells_no_loads_and_rates():
    record = to_record(BEFORE, None)

    assert record["cpu_percent"] is None
    assert record["cpu_percent_by_core"] is None
    assert record["network_sent_bytes_per_s"] is None


def test_values_of_one_look_are_recorded_as_they_are():
    record = to_record(BEFORE, None)

    assert record["core_temperature_c"] == 48.3
    assert record["throttling"] == (
        "under_voltage",
        "throttled",
        "under_voltage_occurred",
        "throttled_occurred",
    )
    assert (record["ram_used_bytes"], record["disk_free_bytes"], record["disk_reads"]) == (
        400,
        1500,
        1,
    )
    assert (record["loopback_bytes"], record["network_drops"]) == (7, 6)
    assert (record["load_1min"], record["load_15min"]) == (0.5, 0.125)


@pytest.mark.parametrize(
    ("bits", "expected"),
    [
        (None, None),
        (0, ()),
        (0x1, ("under_voltage",)),
        (0x8, ("soft_temperature_limit",)),
        (0x20002, ("frequency_capped", "frequency_capped_occurred")),
        (0x10, ("bit_4",)),
    ],
)
def test_throttling_bits_have_names(bits, expected):
    assert decode_throttling(bits) == expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("50005\n", 0x50005),
        ("0x50000", 0x50000),
        ("throttled=0x4\n", 4),
        ("0", 0),
        ("", None),
        ("?", None),
    ],
)
def test_throttled_text_is_hexadecimal(text, expected):
    assert parse_throttled(text) == expected


def test_load_is_nothing_when_processors_came_or_no_time_passed():
    one = (CpuTimes(busy_s=1.0, total_s=2.0),)

    assert compute_cpu_percent(one, one * 2) == []
    assert compute_cpu_percent(one, one) == [0.0]


@pytest.mark.parametrize(
    ("before", "now", "elapsed_s", "expected"),
    [
        (10, 30, 2.0, 10.0),
        (None, 30, 2.0, None),
        (10, None, 2.0, None),
        (10, 30, 0.0, None),
        (30, 10, 1.0, None),
    ],
)
def test_rate_is_told_only_where_it_means_something(before, now, elapsed_s, expected):
    assert compute_rate(before, now, elapsed_s) == expected
