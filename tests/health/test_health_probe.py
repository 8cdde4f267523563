import os
import subprocess
import sys

import pytest

from madns_runtime.health import probe
from madns_runtime.health.probe import Probe, ProcessUsage, pss_bytes
from madns_runtime.recording.records import HEALTH


def put(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


@pytest.fixture
def root(tmp_path):
    """Return an empty machine, to be furnished."""
    (tmp_path / "root").mkdir()
    return tmp_path / "root"


def test_machine_without_sensors_has_no_temperature_and_no_flags(tmp_path, root):
    reading = Probe(tmp_path, root=root).read()

    assert reading.values["core_temperature_c"] is None
    assert reading.values["throttled_bits"] is None
    assert reading.values["udp_sockets"] is None


def test_processors_own_thermal_zone_is_preferred(tmp_path, root):
    zones = root / "sys/class/thermal"
    put(zones / "thermal_zone0/type", "battery\n")
    put(zones / "thermal_zone0/temp", "21000\n")
    put(zones / "thermal_zone1/type", "cpu-thermal\n")
    put(zones / "thermal_zone1/temp", "48312\n")

    assert Probe(tmp_path, root=root).read().values["core_temperature_c"] == 48.312


def test_any_thermal_zone_is_better_than_none(tmp_path, root):
    put(root / "sys/class/thermal/thermal_zone0/type", "odd\n")
    put(root / "sys/class/thermal/thermal_zone0/temp", "21000\n")

    assert Probe(tmp_path, root=root).read().values["core_temperature_c"] == 21.0


@pytest.mark.parametrize("text", ["", "no number"])
def test_zone_that_gives_no_number_is_no_temperature(tmp_path, root, text):
    put(root / "sys/class/thermal/thermal_zone0/type", "cpu-thermal\n")
    put(root / "sys/class/thermal/thermal_zone0/temp", text)

    assert Probe(tmp_path, root=root).read().values["core_temperature_c"] is None


@pytest.mark.parametrize("folder", ["soc/soc:firmware", "soc@107c000000/soc@107c000000:firmware"])
def test_firmwares_throttling_flags_are_read(tmp_path, root, folder):
    put(root / "sys/devices/platform" / folder / "get_throttled", "50005\n")

    assert Probe(tmp_path, root=root).read().values["throttled_bits"] == 0x50005


def test_sockets_of_both_families_are_counted(tmp_path, root):
    put(
        root / "proc/net/sockstat",
        "sockets: used 9\nTCP: inuse 5 orphan 0 tw 0 alloc 7 mem 1\nUDP: inuse 3 mem 0\nUDPLITE: inuse 9\n",
    )
    put(root / "proc/net/sockstat6", "TCP6: inuse 2\nUDP6: inuse 4\nUDPLITE6: inuse 9\n")
    reading = Probe(tmp_path, root=root).read()

    assert (reading.values["tcp_connections"], reading.values["udp_sockets"]) == (7, 7)


def test_this_machine_can_be_read(tmp_path):
    reading = Probe(tmp_path).read()
    values = reading.values

    assert len(reading.cpus) >= 1
    assert all(0 <= cpu.busy_s <= cpu.total_s for cpu in reading.cpus)
    assert 0 < values["ram_used_bytes"] < values["ram_total_bytes"]
    assert values["disk_total_bytes"] > 0
    assert values["utc"].endswith("+00:00")
    assert values.keys() < {field.name for field in HEALTH.fields}


def test_vanished_directory_has_no_space(tmp_path):
    assert "disk_total_bytes" not in Probe(tmp_path / "none").read().values


def test_usage_is_a_record_of_the_process_stream():
    usage = ProcessUsage()
    t_s, cpu_percent, rss_bytes, major_faults, voluntary, involuntary = usage.read(1.5)

    assert t_s == 1.5
    assert cpu_percent >= 0
    assert rss_bytes > 1_000_000
    assert min(major_faults, voluntary, involuntary) >= 0
    assert usage.read()[0] is None


def test_usage_is_since_the_last_call():
    usage = ProcessUsage()
    total = 0
    while usage.read()[1] == 0.0:  # until the processor's clock has moved
        total += sum(range(1000))
    # Beside which what is computed between its two clocks is nothing.
    total += sum(range(3_000_000))

    assert usage.read()[1] <= 100.0 * 1.5


def test_each_agent_of_a_process_counts_since_its_own_last_record(monkeypatch):
    now = {"wall": 0.0, "cpu": 0.0}
    monkeypatch.setattr(probe.time, "monotonic", lambda: now["wall"])
    monkeypatch.setattr(probe.time, "process_time", lambda: now["cpu"])
    first, second = ProcessUsage(), ProcessUsage()
    now |= {"wall": 5.0, "cpu": 1.0}
    shares = [first.read()[1]]
    now |= {"wall": 5.001}
    shares.append(second.read()[1])

    assert shares == [20.0, pytest.approx(20.0, abs=0.1)]


@pytest.mark.skipif(not os.path.exists("/proc/self/smaps_rollup"), reason="the kernel has none")
def test_proportional_memory_of_a_process_is_told():
    assert pss_bytes(os.getpid()) > 1_000_000


@pytest.mark.process
def test_proportional_memory_of_a_dead_process_is_none():
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()

    assert pss_bytes(child.pid) is None
