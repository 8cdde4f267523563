"""Checks of the computer itself: its power, heat, clock, memory and system. Pure."""

from __future__ import annotations

from collections.abc import Iterator

from cosmos_cli.doctor.case import Case
from cosmos_cli.doctor.finding import CheckRemark, Severity

THROTTLED_BITS = (
    (0, "under-voltage"),
    (1, "frequency capped"),
    (2, "throttled"),
    (3, "soft temperature limit"),
)
"""Of vcgencmd get_throttled: now; sixteen bits above, since boot."""
SINCE_BOOT_SHIFT = 16
POWER_CURE = (
    "a power supply of at least 5.1 V and 3 A, a short thick cable, fewer devices on its USB ports"
)
HEAT_CURE = "a heat sink or a fan, and room around it"
TEMPERATURE_C_ERROR = 80.0
"""A Raspberry Pi slows itself down from here."""
TEMPERATURE_C_WARNING = 70.0
CLOCK_S_NOTE = 1.0
CLOCK_S_WARNING = 86_400.0
"""Certificates and package lists are refused by a clock so far off."""
MEMORY_BYTES_ERROR = 48 * 1024**2
MEMORY_BYTES_WARNING = 160 * 1024**2
AGENT_BYTES = 16 * 1024**2
"""Of an agent's process with numpy (measured 14.5 MB)."""
SWAP_BYTES_WARNING = 64 * 1024**2
UPTIME_S_SETTLED = 60.0
UPTIME_S_OLD = 180 * 86_400.0


def system(case: Case) -> Iterator[CheckRemark]:
    """Tell what it is."""
    facts = case.facts
    words = [
        facts.board.model,
        facts.board.machine,
        facts.board.os_name,
        f"Python {'.'.join(map(str, facts.python.version))}",
    ]
    yield CheckRemark(found=", ".join(filter(None, words)))


def throttled(case: Case) -> Iterator[CheckRemark]:
    """Decode the bits of a Raspberry Pi's firmware."""
    bits = case.facts.throttled
    if bits is None:
        return
    now = [name for bit, name in THROTTLED_BITS if bits >> bit & 1]
    earlier = [name for bit, name in THROTTLED_BITS if bits >> bit + SINCE_BOOT_SHIFT & 1]
    only_earlier = [name for name in earlier if name not in now]
    if now:
        yield CheckRemark(
            level=Severity.ERROR, found=f"now: {', '.join(now)}", cure=_throttle_cure(now)
        )
    if only_earlier:
        yield CheckRemark(
            level=Severity.WARNING,
            found=f"since it was started: {', '.join(only_earlier)}",
            cure=f"{_throttle_cure(only_earlier)}; `cosmos reboot` clears the mark",
        )
    if not now and not only_earlier:
        yield CheckRemark(found="neither throttled nor under-voltage since it was started")


def _throttle_cure(names: list[str]) -> str:
    is_power = "under-voltage" in names
    is_heat = "soft temperature limit" in names or (not is_power)
    return "; ".join(filter(None, [POWER_CURE if is_power else "", HEAT_CURE if is_heat else ""]))


def temperature(case: Case) -> Iterator[CheckRemark]:
    """Hot processors slow themselves down."""
    found_c = case.facts.temperature_c
    if found_c is None:
        return
    level, found = (
        (Severity.ERROR, "hot: it slows down")
        if found_c >= TEMPERATURE_C_ERROR
        else (Severity.WARNING, "warm")
        if found_c >= TEMPERATURE_C_WARNING
        else (Severity.OK, "temperature")
    )
    yield CheckRemark(
        level=level,
        found=found,
        cure=HEAT_CURE if level != Severity.OK else "",
        figure=found_c,
        unit="°C",
    )


def clock(case: Case) -> Iterator[CheckRemark]:
    """Tell how far its wall clock is off; records carry it, runs have a clock exchange of their own."""
    service = case.part("busy").get("time_service")
    is_disciplined = service or case.part("kernel").get("is_clock_synchronized")
    exact = case.part("round_trips").get("clock_offset_s")
    offset_s = abs(exact if exact is not None else case.facts.clock_offset_s)
    kept = f"wall clock kept by {service}" if service else "wall clock is kept"
    if not case.is_here and offset_s >= CLOCK_S_NOTE:
        yield CheckRemark(
            level=Severity.WARNING if offset_s >= CLOCK_S_WARNING else Severity.NOTE,
            found="wall clock differs from this computer's by",
            cure=_clock_cure(case, has_service=bool(service)),
            figure=offset_s,
            unit="s",
        )
    elif not is_disciplined:
        yield CheckRemark(
            level=Severity.NOTE,
            found="no time service keeps its wall clock (runs keep their own time)",
            cure=_clock_cure(case, has_service=False),
        )
    elif case.is_here:
        yield CheckRemark(found=kept)
    else:
        yield CheckRemark(found=f"{kept}, off by", figure=offset_s * 1e3, unit="ms")


def _clock_cure(case: Case, *, has_service: bool) -> str:
    if has_service:
        return "give its time service a server that it can reach, such as this computer"
    return case.cure("cosmos_packages: [chrony]", "sudo timedatectl set-ntp true")


def memory(case: Case) -> Iterator[CheckRemark]:
    """Memory that is left, against what the agents there need."""
    free_bytes = case.facts.memory_available_bytes
    if free_bytes is None:
        return
    spare_bytes = free_bytes - AGENT_BYTES * -(-case.agents // case.wants.agents_per_process)
    level = (
        Severity.ERROR
        if spare_bytes < MEMORY_BYTES_ERROR
        else Severity.WARNING
        if spare_bytes < MEMORY_BYTES_WARNING
        else Severity.OK
    )
    cure = "end what else runs there, place fewer agents on it (cosmos_agents), or several in a process"
    yield CheckRemark(
        level=level,
        found="free memory" if level == Severity.OK else "little free memory",
        cure="" if level == Severity.OK else f"{cure} (agents.per_process)",
        figure=free_bytes / 1024**2,
        unit="MiB",
    )


def swap(case: Case) -> Iterator[CheckRemark]:
    """Memory on a disk comes back in milliseconds, on a card in many."""
    used_bytes = case.part("swap").get("used_bytes")
    moved = case.part("busy").get("swapped_pages") or 0
    if used_bytes is None:
        return
    if moved:
        yield CheckRemark(
            level=Severity.WARNING,
            found="swaps memory to the disk right now",
            cure=f"free memory there; {case.cure_by('swapoff -a')} keeps everything in memory",
        )
    elif used_bytes:
        yield CheckRemark(
            level=Severity.WARNING if used_bytes >= SWAP_BYTES_WARNING else Severity.NOTE,
            found="memory was swapped to the disk",
            cure=case.cure_by("swapoff -a"),
            figure=used_bytes / 1024**2,
            unit="MiB",
        )
    else:
        yield CheckRemark(found="nothing is swapped to the disk")


def uptime(case: Case) -> Iterator[CheckRemark]:
    """A machine that was just started is still busy with it."""
    up_s = case.facts.uptime_s
    if up_s is None:
        return
    if up_s < UPTIME_S_SETTLED:
        yield CheckRemark(
            level=Severity.NOTE,
            found="was started just now: what else starts there is not done yet",
            cure="wait a minute before a run",
        )
    elif up_s > UPTIME_S_OLD:
        yield CheckRemark(
            level=Severity.NOTE,
            found="was started long ago: updates of its kernel wait for a reboot",
            cure="restart it" if case.is_here else "`cosmos reboot`",
            figure=up_s / 86_400,
            unit="days ago",
        )
    else:
        yield CheckRemark(found="was started", figure=up_s / 3600, unit="h ago")


def radios(case: Case) -> Iterator[CheckRemark]:
    """Radios that nobody uses cost interrupts (the thesis turned them off)."""
    if case.is_here:
        return
    uses_wifi = case.facts.network.is_wireless is not False
    for kind, setting in (("wlan", "cosmos_wifi"), ("bluetooth", "cosmos_bluetooth")):
        found = [radio for radio in case.facts.radios if radio.type == kind]
        is_on = any(not (radio.is_soft_blocked or radio.is_hard_blocked) for radio in found)
        name = "Wi-Fi" if kind == "wlan" else "Bluetooth"
        if is_on and not (kind == "wlan" and uses_wifi):
            yield CheckRemark(
                level=Severity.NOTE,
                found=f"{name} is on and not needed to reach it",
                cure=case.cure(f"{setting}: false", f"sudo rfkill block {kind}"),
            )
        elif found and not is_on:
            yield CheckRemark(found=f"{name} is off")


def sudo(case: Case) -> Iterator[CheckRemark]:
    """Settings, packages and reboots need root."""
    if case.is_here or case.facts.can_become_root is None:
        return
    if case.facts.can_become_root:
        yield CheckRemark(found="becomes root without a password")
    else:
        yield CheckRemark(
            level=Severity.NOTE,
            found="cannot become root without a password: no settings, packages or reboots from here",
            cure="`USER ALL=(ALL) NOPASSWD: ALL` in a file of /etc/sudoers.d there",
            detail=case.facts.sudo_refusal,
        )
