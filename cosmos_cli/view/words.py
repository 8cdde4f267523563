"""Progress of a run in words. Pure."""

from __future__ import annotations

from collections.abc import Mapping

from cosmos_cli.launch.events import Progress

STATE_WORDS: Mapping[str, str] = {
    "HOST_STARTUP": "waiting for agents",
    "SIMULATION_SETUP": "setting up",
    "HOST_SIMULATION_READY": "agents are setting up",
    "SIMULATION_START": "running",
    "SIMULATION_COMPLETE": "complete",
    "BEGIN_SHUTDOWN": "shutting down",
    "EMERGENCY_SHUTDOWN": "emergency shutdown",
    "COLLECTING": "collecting",
}
"""States that are worth a line; the rest of shutdown passes in a blink."""


def state_words(state: str) -> str | None:
    """Return a state in words, None for one that is not worth showing."""
    return STATE_WORDS.get(state)


def clock_words(progress: Progress, duration_s: float) -> str:
    """Return how far simulated time is, such as `12.0 / 180 s`."""
    return f"{simulated_s(progress):.1f} / {duration_s:g} s"


def simulated_s(progress: Progress) -> float:
    """Return the simulated time, 0 before it runs, s."""
    return max(0.0, progress.t_s or 0.0)


def rtf_words(progress: Progress) -> str:
    """Return the real-time factor; a dash before there is one."""
    if progress.is_lockstep:
        return "- x real time" if progress.rtf is None else f"{progress.rtf:.4g} x real time"
    return "RTF -" if progress.rtf is None else f"RTF {progress.rtf:.4f}"


def agent_words(progress: Progress) -> str:
    """Return how many agents are where; ready, complete and lost ones only when there are any."""
    parts = [f"{progress.running} running"]
    if progress.ready:
        parts.insert(0, f"{progress.ready} ready")
    if progress.complete:
        parts.append(f"{progress.complete} complete")
    return f"agents: {', '.join([*parts, f'{progress.lost} lost'])}"


def tick_words(progress: Progress) -> str:
    """Return how many ticks were missed, of all that were due."""
    return f"missed {progress.missed} of {progress.ticks + progress.missed} ticks"


def lateness_words(progress: Progress) -> str:
    """Return median and 99th percentile of lateness, ms."""
    values = (progress.lateness_us_p50, progress.lateness_us_p99)
    p50, p99 = ("-" if value is None else f"{value / 1000:.2f}" for value in values)
    return f"lateness p50 {p50} p99 {p99} ms"


def timing_words(progress: Progress) -> tuple[str, ...]:
    """Return how simulated time goes: in lockstep its speed alone, for no tick is ever late or missed."""
    if progress.is_lockstep:
        return (rtf_words(progress), f"{progress.ticks} ticks")
    return rtf_words(progress), tick_words(progress), lateness_words(progress)


def value_words(value: float | str | None) -> str:
    """Return a recorded value: a float to four digits, from 1000 on to tenths; a dash for none."""
    if not isinstance(value, float):
        return "-" if value is None else str(value)
    return f"{value:.1f}" if 1e3 <= abs(value) < 1e12 else f"{value:.4g}"


def loss_words(progress: Progress) -> str:
    """Return lost messages, and dropped records where there are any."""
    text = f"{progress.lost_messages} messages lost"
    if progress.records_dropped:
        text += f", {progress.records_dropped} records dropped"
    return text


def has_trouble(progress: Progress) -> bool:
    """Tell whether something was lost that should not be."""
    return bool(progress.lost or progress.lost_messages or progress.records_dropped)


def progress_line(progress: Progress, duration_s: float) -> str:
    """Return all of it on one line."""
    speed, *timing = timing_words(progress)
    parts = (
        clock_words(progress, duration_s),
        speed,
        agent_words(progress),
        *timing,
        loss_words(progress),
    )
    return "; ".join(parts)
