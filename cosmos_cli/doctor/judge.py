"""From what was probed to findings: the one table of checks. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from cosmos_cli.doctor import computer, disk, leftovers, network, operator, realtime
from cosmos_cli.doctor.case import Case
from cosmos_cli.doctor.finding import CheckRemark, Finding

Check = Callable[[Case], Iterator[CheckRemark]]

CHECKS: Mapping[str, Check] = {
    "system": computer.system,
    "feasibility": operator.feasibility,
    "udp": network.udp,
    "udp_unasked": network.udp_unasked,
    "receive_buffer": network.receive_buffer,
    "receive_drops": network.receive_drops,
    "link": network.link,
    "link_errors": network.link_errors,
    "mtu": network.mtu,
    "wifi": network.wifi,
    "throttled": computer.throttled,
    "temperature": computer.temperature,
    "governor": realtime.governor,
    "preempt_rt": realtime.preempt_rt,
    "realtime": realtime.realtime,
    "realtime_throttling": realtime.realtime_throttling,
    "wake_up": realtime.wake_up,
    "busy": realtime.busy,
    "steal": realtime.steal,
    "cpu_quota": realtime.cpu_quota,
    "processors": realtime.processors,
    "cpu_affinity": realtime.cpu_affinity,
    "timer": realtime.timer,
    "clock_source": realtime.clock_source,
    "clock": computer.clock,
    "memory": computer.memory,
    "memory_lock": realtime.memory_lock,
    "swap": computer.swap,
    "disk_space": disk.disk_space,
    "disk_writable": disk.disk_writable,
    "disk_write": disk.disk_write,
    "living": leftovers.living,
    "uncollected": leftovers.uncollected,
    "cut_off": operator.cut_off,
    "environments": leftovers.environments,
    "radios": computer.radios,
    "uptime": computer.uptime,
    "sudo": computer.sudo,
    "container": operator.container,
    "open_files": operator.open_files,
    "devices": operator.devices,
    "ssh_agent": operator.ssh_agent,
    "ssh_files": operator.ssh_files,
    "uv": operator.uv,
}
"""By the word that scripts may rely on, in the order in which a person reads them."""


def judge(case: Case) -> list[Finding]:
    """Return what all checks find on one machine; what was not or cannot be probed is not judged."""
    return [
        Finding(machine=case.machine, check=name, remark=remark)
        for name, check in CHECKS.items()
        for remark in check(case)
    ]
