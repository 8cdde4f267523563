"""Checks of what decides when a loop wakes up: scheduling, clocks, and who else wants the processors. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from cosmos_cli.doctor.case import Case
from cosmos_cli.doctor.finding import CheckRemark, Severity
from cosmos_cli.ui.plural import counted
from madns_runtime.timing.pack_split import PACK_AGENTS_MAX

CAP_IPC_LOCK = 14
REALTIME_SHARE_WARNING = 0.9
TIMER_RESOLUTION_S_MAX = 1e-6
SLOW_CLOCK_SOURCES = frozenset(("hpet", "acpi_pm", "jiffies", "pit"))
BUSY_PROCESSORS_WARNING = 0.5
BUSY_PROCESSORS_NOTE = 0.1
STEAL_SHARE_WARNING = 0.01
LIMITS = "/etc/security/limits.d/90-cosmos.conf"


def governor(case: Case) -> Iterator[CheckRemark]:
    """A processor that sleeps deeply or runs slowly wakes up late."""
    governors = sorted(set(case.facts.governors.values()))
    if governors == ["performance"]:
        yield CheckRemark(found="processors run at full speed")
    elif governors:
        path = "/sys/devices/system/cpu/cpu*/cpufreq/scaling_governor"
        yield CheckRemark(
            level=Severity.WARNING,
            found=f"CPU governor is {', '.join(governors)}: expected performance",
            cure=case.cure(
                "cosmos_cpu_governor: performance", f"echo performance | sudo tee {path}"
            ),
        )


def preempt_rt(case: Case) -> Iterator[CheckRemark]:
    """A kernel that can be interrupted everywhere; what it is worth there says `cosmos bench floor`."""
    if case.facts.board.is_preempt_rt is not None:
        kind = "PREEMPT_RT" if case.facts.board.is_preempt_rt else "not PREEMPT_RT"
        yield CheckRemark(found=f"kernel {case.facts.board.kernel} is {kind}")


def realtime(case: Case) -> Iterator[CheckRemark]:
    """SCHED_FIFO: with it the tail of the lateness is shorter by far (15 / 171 us against 16 / 6200)."""
    measured = case.part("wake_ups")
    if case.wants.policy == "normal":
        yield CheckRemark(found="normal scheduling, as the scenario asks for")
    elif measured.get("policy") == "fifo":
        yield CheckRemark(found=f"SCHED_FIFO with priority {priority_of(case)} is permitted")
    elif measured.get("refusal"):
        line = f"'{case.facts.user} - rtprio {priority_of(case)}'"
        cure = f"echo {line} | sudo tee -a {LIMITS}, then log in anew"
        yield CheckRemark(
            level=Severity.WARNING,
            found=f"SCHED_FIFO with priority {priority_of(case)} is refused: {measured['refusal']}",
            cure=case.cure(f"cosmos_realtime_priority: {priority_of(case)}", cure),
        )


def priority_of(case: Case) -> int:
    """Return the priority that is asked for there; the host runs here, and one above the agents."""
    return case.wants.priority + (1 if case.is_here else 0)


def realtime_throttling(case: Case) -> Iterator[CheckRemark]:
    """The kernel takes the processor from real-time loops that use more than their share."""
    runtime_us = case.part("kernel").get("realtime_runtime_us")
    period_us = case.part("kernel").get("realtime_period_us")
    if runtime_us is None or not period_us:
        return
    cure = case.cure_by("sysctl -w kernel.sched_rt_runtime_us=950000")
    if runtime_us == 0:
        yield CheckRemark(
            level=Severity.ERROR,
            found="real-time loops get no time at all (kernel.sched_rt_runtime_us = 0)",
            cure=cure,
        )
    elif 0 < runtime_us < REALTIME_SHARE_WARNING * period_us:
        yield CheckRemark(
            level=Severity.WARNING,
            found="real-time loops are stopped beyond a share of",
            cure=cure,
            figure=100 * runtime_us / period_us,
            unit="%",
        )
    else:
        share = "no limit" if runtime_us < 0 else f"{100 * runtime_us / period_us:.0f} %"
        yield CheckRemark(found=f"share of real-time loops: {share}")


def memory_lock(case: Case) -> Iterator[CheckRemark]:
    """The host asks for resident memory, agents never do."""
    limit_bytes = case.facts.memory_lock_bytes_max
    if not case.is_here:
        return
    if limit_bytes is None or case.has_capability(CAP_IPC_LOCK):
        yield CheckRemark(found="the host may keep its memory resident")
    else:
        line = f"'{case.facts.user} - memlock unlimited'"
        yield CheckRemark(
            level=Severity.NOTE,
            found="the host's memory may be paged out: at most so much may be locked",
            cure=f"echo {line} | sudo tee -a {LIMITS}, then log in anew",
            figure=limit_bytes / 1024**2,
            unit="MiB",
        )


def timer(case: Case) -> Iterator[CheckRemark]:
    """Without fine timers every wake-up waits for the next tick of the kernel."""
    resolution_s = case.part("kernel").get("timer_resolution_s")
    if resolution_s is None:
        return
    is_fine = resolution_s <= TIMER_RESOLUTION_S_MAX
    yield CheckRemark(
        level=Severity.OK if is_fine else Severity.WARNING,
        found="timer resolution",
        cure="" if is_fine else "a kernel with high-resolution timers (CONFIG_HIGH_RES_TIMERS)",
        figure=resolution_s * 1e9,
        unit="ns",
    )


def clock_source(case: Case) -> Iterator[CheckRemark]:
    """A clock that is read through a slow device costs microseconds each time."""
    source = case.part("kernel").get("clock_source")
    if source in SLOW_CLOCK_SOURCES:
        yield CheckRemark(
            level=Severity.WARNING,
            found=f"its clock is read from {source}, which is slow",
            cure="choose tsc in /sys/devices/system/clocksource/clocksource0/current_clocksource;"
            " `dmesg` says why the kernel did not",
        )
    elif source:
        yield CheckRemark(found=f"its clock is read from {source}")


def wake_up(case: Case) -> Iterator[CheckRemark]:
    """Lateness of a loop that does nothing, against what the run allows."""
    told = case.part("wake_ups")
    if told.get("p99_ms") is None:
        return
    lateness_ms = case.wants.lateness_ms
    level = (
        Severity.ERROR
        if told["p50_ms"] > lateness_ms
        else Severity.WARNING
        if told["p99_ms"] > lateness_ms
        else Severity.NOTE
        if told["max_ms"] > lateness_ms
        else Severity.OK
    )
    by = "SCHED_FIFO" if told["policy"] == "fifo" else "normal scheduling"
    how = f"{told['count']} wake-ups at {told['rate_hz']:g} Hz, {by}"
    over = "" if level == Severity.OK else f", and {lateness_ms:g} ms are tolerated"
    yield CheckRemark(
        level=level,
        found=f"lateness of {how}{over}; 99 % within",
        cure="" if level == Severity.OK else _lateness_cure(told["policy"]),
        figure=told["p99_ms"],
        unit="ms",
        detail=f"median {told['p50_ms']:.3g} ms, longest {told['max_ms']:.3g} ms",
    )


def _lateness_cure(policy: str) -> str:
    others = "end what else is busy there (`busy`, `governor`, `steal` tell)"
    return others if policy == "fifo" else f"permit SCHED_FIFO (`realtime` tells how); {others}"


def busy(case: Case) -> Iterator[CheckRemark]:
    """Other people's processes."""
    told = case.part("busy")
    used = told.get("processors")
    if used is None:
        return
    level = (
        Severity.WARNING
        if used >= BUSY_PROCESSORS_WARNING
        else Severity.NOTE
        if used >= BUSY_PROCESSORS_NOTE
        else Severity.OK
    )
    top = ", ".join(
        f"{item['name']} (pid {item['pid']}, {item['user'] or '?'}) {100 * item['processors']:.0f} %"
        for item in told.get("top") or ()
    )
    yield CheckRemark(
        level=level,
        found="other processes use, of one processor",
        cure=""
        if level == Severity.OK
        else "end them for the run, or keep agents off their processors (cosmos_cpu_affinity)",
        figure=100 * used,
        unit="%",
        detail="" if level == Severity.OK else top,
    )


def steal(case: Case) -> Iterator[CheckRemark]:
    """A virtual machine whose processors are given to others stands still meanwhile."""
    share = case.part("busy").get("steal_share")
    if not share:
        return
    yield CheckRemark(
        level=Severity.WARNING if share >= STEAL_SHARE_WARNING else Severity.OK,
        found="its hypervisor gave its processors to others for",
        cure="processors of its own for this virtual machine, or a real one"
        if share >= STEAL_SHARE_WARNING
        else "",
        figure=100 * share,
        unit="%",
    )


def cpu_quota(case: Case) -> Iterator[CheckRemark]:
    """A quota stops everything in the container for tens of milliseconds when it is used up."""
    quota = case.part("limits").get("cpu_quota")
    if quota is not None:
        yield CheckRemark(
            level=Severity.WARNING,
            found="its control group is stopped when it used, of the processors",
            cure="run it without a quota (no --cpus or --cpu-quota; processors of its own: --cpuset-cpus)",
            figure=quota,
        )


def processors(case: Case) -> Iterator[CheckRemark]:
    """Agents that the scenario places there, against those that its processors are predicted to bear."""
    agents, usable = case.agents, case.part("limits").get("usable_processors")
    bound = case.wants.bounds.get(case.machine)
    if not agents or not usable or bound is None:
        return
    per_process = case.wants.agents_per_process
    found = (
        f"{counted(agents, 'agent')} at {case.wants.tick_hz:g} Hz on {counted(usable, 'processor')}"
    )
    if agents <= bound.agents:
        yield CheckRemark(found=found)
        return
    cures = ["a lower tick_hz"]
    if bound.is_of_process:
        cures.append("fewer agents in a process (agents.per_process)")
    else:
        cures.insert(0, "fewer agents there (cosmos_agents, placement)")
        if per_process < PACK_AGENTS_MAX:
            cures.append("more agents in a process (agents.per_process)")
    yield CheckRemark(
        level=Severity.WARNING,
        found=f"{found}: up to {bound.agents:.0f} are predicted with agents.per_process {per_process}",
        cure=" or ".join([", ".join(cures[:-1]), cures[-1]]),
    )


def cpu_affinity(case: Case) -> Iterator[CheckRemark]:
    """Processors that agents are to use there, against those that there are."""
    wanted = case.wants.affinity.get(case.machine, ())
    numbers = case.part("limits").get("processor_numbers")
    if not wanted or not numbers:
        return
    lacking = [number for number in wanted if number not in numbers]
    if lacking:
        yield CheckRemark(
            level=Severity.WARNING,
            found=f"agents are to use its {_processor_words(lacking)}, and it has {_listed(numbers)}",
            cure="correct cosmos_cpu_affinity in the inventory, or scheduling.cpu_affinity in the scenario",
        )
    else:
        yield CheckRemark(found=f"agents use its {_processor_words(wanted)}")


def _processor_words(numbers: Sequence[int]) -> str:
    return f"processor{'' if len(numbers) == 1 else 's'} {_listed(numbers)}"


def _listed(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers))
