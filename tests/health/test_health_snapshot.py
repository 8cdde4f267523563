import pytest

from madns_runtime.health.snapshot import (
    CpuTimes,
    HealthReading,
    compute_cpu_percent,
    compute_rate,
    decode_throttling,
    parse_throttled,
    to_record,
)
from madns_runtime.recording.records import HEALTH

BEFORE = HealthReading(
    cpus=(CpuTimes(busy_s=10.0, total_s=100.0), CpuTimes(busy_s=20.0, total_s=100.0)),
    values={
        "utc": "2026-01-02T03:04:05.000+00:00",
        "monotonic_s": 100.0,
        "core_temperature_c": 48.3,
        "throttled_bits": 0x50005,
        "ram_total_bytes": 1000,
        "ram_used_bytes": 400,
        "ram_free_bytes": 600,
        "ram_percent": 40.0,
        "disk_total_bytes": 2000,
        "disk_used_bytes": 500,
        "disk_free_bytes": 1500,
        "disk_percent": 25.0,
        "disk_reads": 1,
        "disk_writes": 2,
        "disk_read_bytes": 3000,
        "disk_written_bytes": 4000,
        "disk_read_time_ms": 5,
        "disk_write_time_ms": 6,
        "network_sent_bytes": 10_000,
        "network_received_bytes": 20_000,
        "network_sent_packets": 3,
        "network_received_packets": 4,
        "network_errors": 5,
        "network_drops": 6,
        "loopback_bytes": 7,
        "udp_sockets": 8,
        "tcp_connections": 9,
        "load_1min": 0.5,
        "load_5min": 0.25,
        "load_15min": 0.125,
        "process_uptime_s": 1.0,
        "board_uptime_s": 1234.5,
    },
)
AFTER = HealthReading(
    cpus=(CpuTimes(busy_s=12.0, total_s=104.0), CpuTimes(busy_s=24.0, total_s=104.0)),
    values={
        **BEFORE.values,
        "monotonic_s": 104.0,
        "disk_read_bytes": 3400,
        "network_sent_bytes": 10_800,
        "network_received_bytes": 19_000,
    },
)


def test_record_has_every_field_of_the_stream_in_any_case():
    expected = {field.name for field in HEALTH.fields}
    always = ("utc", "monotonic_s", "process_uptime_s")
    values = {name: value for name, value in BEFORE.values.items() if name in always}
    bare = HealthReading(cpus=BEFORE.cpus, values=values)

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
