"""A real run whose sockets are sent what is none of theirs: it goes on, and every datagram is told of, by reason."""

import json
import os
import socket
import struct
import subprocess
import sys

import pytest
from harness.ports import free_port
from harness.waiting import wait_until

from madns_runtime.protocol.datagram import OVERHEAD_BYTES, PREFIX, Role
from madns_runtime.protocol.messages import VERSION

pytestmark = pytest.mark.process

EACH = 40
"""Datagrams of each kind: beyond the count that is worth a remark."""


def forged(session, *, version=VERSION, role=Role.AGENT, agent=1, size=200):
    """Return a datagram that claims to be of the run, without its key."""
    head = PREFIX.pack(version, role, agent, int.from_bytes(os.urandom(4)), session)
    return head + os.urandom(max(OVERHEAD_BYTES, size) - len(head))


def attacks(session):
    """Return a datagram of each kind that a host refuses, by the reason."""
    return {
        "mac": lambda: forged(session),
        "version": lambda: forged(session, version=VERSION + 1),
        "session": lambda: forged(os.urandom(8)),
        "unknown_agent": lambda: forged(session, agent=999),
        "oversize": lambda: forged(session, size=1500),
        "short": lambda: os.urandom(20),
    }


def session_of(runs):
    plan = next(iter(runs.glob("*/plan.json")), None)
    return bytes.fromhex(json.loads(plan.read_text())["session"]) if plan else None


def agents_ports(host_port):
    """Return the ports of sockets on this computer that are connected to the host's."""
    with open("/proc/net/udp", encoding="ascii") as file:
        rows = [line.split() for line in file][1:]
    return [int(row[1].split(":")[1], 16) for row in rows if row[2].endswith(f":{host_port:04X}")]


def send_as(source_port, port, data):
    """Send a datagram that claims to come from another socket: root's privilege."""
    udp = struct.pack("!HHHH", source_port, port, 8 + len(data), 0) + data
    here = socket.inet_aton("127.0.0.1")
    head = struct.pack("!BBHHHBBH4s4s", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0, here, here)
    with socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_RAW) as raw:
        raw.sendto(head + udp, ("127.0.0.1", 0))


def is_running(runs):
    events = next(iter(runs.glob("*/agents/agent-01/events.jsonl")), None)
    return events is not None and "RUN_SIMULATION" in events.read_text()


def test_refused_datagrams_are_told_by_reason_of_host_and_agents(tmp_path):
    runs, port = tmp_path / "runs", free_port(kind=socket.SOCK_DGRAM)
    scenario = tmp_path / "small.yaml"
    scenario.write_text(
        "name: small\nsimulation: counter\nagents: {count: 2, tick_hz: 10}\n"
        f"time: {{duration_s: 10, rtf_tolerance: 100}}\nnetwork: {{port: {port}}}\n"
        "deadline: {max_miss_ratio: 1}\ntimeouts: {agents_ready_s: 120, silence_s: 30, complete_s: 60}\n"
    )
    environment = {**os.environ, "COSMOS_STATE_DIR": str(tmp_path / "state")}
    cosmos = [sys.executable, "-m", "cosmos_cli.app"]
    with subprocess.Popen(
        [*cosmos, "run", str(scenario), "--json", "--quiet", "--runs", str(runs)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=environment,
    ) as process:
        try:
            wait_until(lambda: is_running(runs) or process.poll() is not None, "no run")
            session = session_of(runs)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as attacker:
                for make in attacks(session).values():
                    for _ in range(EACH):
                        attacker.sendto(make(), ("127.0.0.1", port))
            if os.geteuid() == 0:
                ports = wait_until(lambda: agents_ports(port), "no agent's socket")
                for _ in range(EACH):
                    send_as(port, ports[0], forged(session, role=Role.HOST))
            out, err = process.communicate(timeout=120)
        finally:
            process.kill()
    result = json.loads(out)

    assert result["status"] == "complete", err
    host = result["datagrams"]["host"]
    assert {reason: host["by_reason"].get(reason) for reason in attacks(b"")} == dict.fromkeys(
        attacks(b""), EACH
    )
    assert host["refused"] == sum(host["by_reason"].values())
    assert any("host: " in r and f"wrong seal {EACH}" in r for r in result["remarks"])
    if os.geteuid() == 0:
        agents = result["datagrams"]["agents"].values()
        assert sorted(agent["refused"] for agent in agents) == [0, EACH]
        assert result["datagrams"]["refused"] == host["refused"] + EACH
    report = [*cosmos, "report", str(runs / result["run"])]
    shown = subprocess.run(report, capture_output=True, text=True, check=True, env=environment)
    assert "Datagrams refused, by process and reason" in shown.stdout
    assert "wrong seal" in shown.stdout
