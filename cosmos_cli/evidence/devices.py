"""Devices of a run as evidence: what each came to, by the accounts of its machine or of the host, and their checks."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeGuard

from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.evidence.run_documents import read_object
from cosmos_cli.evidence.verdict import CheckResult, at_most, is_number
from cosmos_cli.ui.foreign_text import clean_line
from cosmos_cli.ui.plural import counted
from madns_runtime.config import HardwareSettings
from madns_runtime.hardware.count_table import BEYOND_LIMITS
from madns_runtime.hardware.profiles import POINT_COUNTS
from madns_runtime.plain_values import mapping_at
from madns_runtime.recording.records import DEVICE_LOSSES, WHOLE_MAX

ACCOUNT_NAME = re.compile(r"devices(?:\.([1-9][0-9]{0,8}))?\.json")
"""Accounts of a machine's devices, below machines/<machine>/: one per incarnation of its supervisor."""
NO_REPORT = "unknown"
"""Status of a device that nobody has given account of."""
WHY_MISSING = "no account of it: its supervisor did not come to its end"
LOST_BYTES = "lost_bytes"
"""Count of bytes for which a line had no room: firmware that floods."""
SPOILED = (
    "bad_checksums",
    "damaged_lines",
    "edges_lost",
    "epochs_given_up",
    "frames_lost",
    "joystick_lost",
)
"""Counts of what came and was not whole, or did not come to the driver."""
GARBAGE_SHARE_MAX = 0.05
"""Of a line's bytes: one that is opened in mid-frame has some that belong to none, and that is no fault."""
LOSSES_TOLD_MAX = 20
"""Remarks of one kind on devices."""
NEVER_PLAYED = ("skipped", "lost", "refused")
"""Counts of a profile's points that were due and never put out."""
_TOLD_APART = frozenset(
    (
        "status",
        "samples",
        "errors",
        "stale_ratio",
        "lost",
        "restarts",
        "why",
        "frozen",
        "unsafe",
        "silent_inputs",
        "least_stale_age_s",
        "report",
    )
)


def expected_devices(plan: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the full names of the devices that plan.json promises."""
    listed = mapping_at(plan, "devices").values()
    return tuple(str(name) for names in listed if isinstance(names, list) for name in names)


def read_devices(
    run: RunDirectory, plan: Mapping[str, Any], result: Mapping[str, Any] | None
) -> dict[str, dict[str, Any]]:
    """Return what became of each device, by its full name; of one without an account, that there is none."""
    incarnations: dict[str, int] = {}
    for machine, names in mapping_at(plan, "devices").items():
        accounts = _accounts(run.path / "machines" / str(machine))
        for name in names if isinstance(names, list) else ():
            incarnations[str(name)] = max(accounts, default=0)
    found = _told(run, plan, result)
    names = dict.fromkeys((*expected_devices(plan), *found))
    return {
        clean_line(name): _joined(found.get(name, ()), incarnations.get(name, 0))
        for name in sorted(names)
    }


def recorded_files(
    run: RunDirectory, plan: Mapping[str, Any], result: Mapping[str, Any] | None
) -> dict[str, tuple[str, ...]]:
    """Return the names of the files into which each device recorded, by its full name, as far as accounts of it tell."""
    found: dict[str, tuple[str, ...]] = {}
    for name, accounts in _told(run, plan, result).items():
        files: dict[str, None] = {}
        for account in accounts:
            own = mapping_at(account, "records", "streams")
            streams = own or mapping_at(account, "report", "records", "streams")
            named = (mapping_at(streams, each).get("file") for each in streams)
            files |= dict.fromkeys(name for name in named if isinstance(name, str) and name)
        found[name] = tuple(files)
    return found


def _told(
    run: RunDirectory, plan: Mapping[str, Any], result: Mapping[str, Any] | None
) -> dict[str, list[Mapping[str, Any]]]:
    """Return all accounts of each device, by its full name: of its machine's incarnations, or in lockstep of the host."""
    found: dict[str, list[Mapping[str, Any]]] = {}
    for machine in mapping_at(plan, "devices"):
        for account in _accounts(run.path / "machines" / str(machine)).values():
            for name, told in account.items():
                if isinstance(told, Mapping):
                    found.setdefault(str(name), []).append(told)
    for agent in mapping_at(result, "agents"):  # in lockstep
        for name, told in mapping_at(result, "agents", agent, "records", "devices").items():
            if isinstance(told, Mapping):
                found.setdefault(f"{agent}/{name}", []).append(told)
    return found


def device_checks(
    devices: Mapping[str, Mapping[str, Any]], limits: HardwareSettings
) -> list[CheckResult]:
    """Return the checks of all devices, each with the name of the worst; none in a run without devices."""
    if not devices:
        return []
    return [
        _check(devices, "hardware.stale_ratio", limits.stale_ratio, key="stale_ratio"),
        _check(devices, "hardware.lost", limits.lost, key="lost"),
        _check(devices, "hardware.frozen", limits.frozen, key="frozen"),
        *_lost_bytes_checks(devices, limits),
        *_stimulus_checks(devices, limits),
        *([_check(devices, "hardware.unsafe", 0, key="unsafe")] if _is_unsafe(devices) else []),
    ]


def device_remarks(
    agents: Mapping[str, Any], devices: Mapping[str, Mapping[str, Any]]
) -> tuple[str, ...]:
    """Return all remarks on devices; arguments as of `device_loss_remarks`."""
    return (
        *device_loss_remarks(agents, devices),
        *silent_input_remarks(devices),
        *stale_sample_remarks(devices),
        *refusal_remarks(devices),
        *spoiled_data_remarks(devices),
    )


def device_loss_remarks(
    agents: Mapping[str, Any], devices: Mapping[str, Mapping[str, Any]]
) -> tuple[str, ...]:
    """
    Return a remark per agent and device between which something found no room; at most LOSSES_TOLD_MAX, then how many more.

    Args:
        agents: What the host's result holds of each agent.
        devices: What became of each device, by its full name: of losses that no agent has told.
    """
    found: list[str] = []
    told: set[str] = set()
    for agent in agents:
        for device, counts in mapping_at(agents, agent, "records", DEVICE_LOSSES).items():
            words = [f"{name} {n}" for name, n in mapping_at(counts).items() if is_number(n)]
            told.add(device if "/" in device else f"{agent}/{device}")
            found.append(f"{agent}: device {device}: there was no room for all: {', '.join(words)}")
    for device, account in devices.items():
        missed = mapping_at(account, "counts").get("frames_missed", 0)
        if missed and device not in told:
            found.append(
                f"device {device}: agents did not take all in time: frames_missed {missed:g}"
            )
    return _bounded(found, "more loss", " between devices and agents")


def silent_input_remarks(devices: Mapping[str, Mapping[str, Any]]) -> tuple[str, ...]:
    """Return a remark per device that gave samples, and never a value of some input; at most LOSSES_TOLD_MAX, then how many more."""
    found = [
        f"device {device}: no value ever came of {', '.join(silent)}"
        for device, account in devices.items()
        if (silent := account.get("silent_inputs"))
    ]
    return _bounded(found, "more device", " with an input of which no value ever came")


def stale_sample_remarks(devices: Mapping[str, Mapping[str, Any]]) -> tuple[str, ...]:
    """Return a remark per device of which each sample was stale when it came; at most LOSSES_TOLD_MAX, then how many more."""
    found = [
        f"device {device}: {counted(account['samples'], 'sample')} came, the youngest {age_s:.6g} s old when it came:"
        " is taken_s time.monotonic() at the read?"
        for device, account in devices.items()
        if account.get("samples") and (age_s := account.get("least_stale_age_s"))
    ]
    return _bounded(found, "more device", " of which each sample was stale when it came")


def refusal_remarks(devices: Mapping[str, Mapping[str, Any]]) -> tuple[str, ...]:
    """Return a remark per device that refused something; at most LOSSES_TOLD_MAX, then how many more."""
    found = [
        f"device {device}: {counted(refused, 'time')} something was refused; its events.jsonl says what and why"
        for device, account in devices.items()
        if (refused := int(mapping_at(account, "counts").get("refused", 0)))
    ]
    return _bounded(found, "more device", " that refused something")


def spoiled_data_remarks(devices: Mapping[str, Mapping[str, Any]]) -> tuple[str, ...]:
    """Return a remark per device of which something was lost, not whole or beyond its limits; at most LOSSES_TOLD_MAX, then how many more."""
    found: list[str] = []
    for device, account in devices.items():
        counts = mapping_at(account, "counts")
        told = [
            f"{name} {number:g}"
            for name, number in counts.items()
            if number and (name in SPOILED or name.endswith(BEYOND_LIMITS))
        ]
        garbage, received = counts.get("garbage_bytes", 0), counts.get("received_bytes", 0)
        if garbage > GARBAGE_SHARE_MAX * received:
            told.append(f"garbage_bytes {garbage:g} of {received:g}")
        if told:
            found.append(f"device {device}: lost, spoiled or beyond limits: {', '.join(told)}")
    return _bounded(found, "more device", " with something lost, spoiled or beyond limits")


def _bounded(found: Sequence[str], noun: str, rest_of: str) -> tuple[str, ...]:
    """Return remarks, at most LOSSES_TOLD_MAX, and then how many more there are."""
    told, rest = map(clean_line, found[:LOSSES_TOLD_MAX]), len(found) - LOSSES_TOLD_MAX
    return (*told, *([f"{counted(rest, noun)}{rest_of}"] if rest > 0 else ()))


def _lost_bytes_checks(
    devices: Mapping[str, Mapping[str, Any]], limits: HardwareSettings
) -> list[CheckResult]:
    """Return the check of what serial lines have lost; none where nothing was lost."""
    lost = {name: mapping_at(told, "counts").get(LOST_BYTES, 0) for name, told in devices.items()}
    if not any(lost.values()):
        return []
    flat = {name: {LOST_BYTES: number} for name, number in lost.items()}
    return [_check(flat, "hardware.lost_bytes", limits.lost_bytes, key=LOST_BYTES)]


def _stimulus_checks(
    devices: Mapping[str, Mapping[str, Any]], limits: HardwareSettings
) -> list[CheckResult]:
    """Return the checks of profiles that were played; none where nobody played one."""
    late: dict[str, float] = {}
    underruns: dict[str, int] = {}
    for device, told in devices.items():
        for channel, counts in mapping_at(told, "stimulus").items():
            due = sum(counts[name] for name in ("played", *NEVER_PLAYED))
            wrong = sum(counts[name] for name in ("late", *NEVER_PLAYED))
            late[f"{device}.{channel}"] = wrong / due if due else 0.0
            underruns[f"{device}.{channel}"] = counts["underruns"]
    if not late:
        return []
    worst = max(late, key=lambda name: late[name])
    most = max(underruns, key=lambda name: underruns[name])
    runs_out = at_most(
        "hardware.stimulus_underruns", limits.stimulus_underruns, sum(underruns.values())
    )
    return [
        replace(
            at_most("hardware.stimulus_late", limits.stimulus_late, late[worst]),
            worst=worst if late[worst] else None,
        ),
        replace(runs_out, worst=most if underruns[most] else None),
    ]


def _is_unsafe(devices: Mapping[str, Mapping[str, Any]]) -> bool:
    """Tell whether the outputs of a device were left as they were: nobody could make them safe."""
    return any(told.get("unsafe") for told in devices.values())


def _check(
    devices: Mapping[str, Mapping[str, Any]], name: str, limit: float, *, key: str
) -> CheckResult:
    """Judge one figure: of a ratio the largest, of a count the sum; what is not measured of one is of none."""
    values = {device: told.get(key) for device, told in devices.items()}
    unknown = next((device for device, value in values.items() if not is_number(value)), None)
    if unknown is not None:
        return replace(at_most(name, limit, None), worst=unknown)
    known = {device: float(value) for device, value in values.items() if is_number(value)}
    worst = max(known, key=lambda device: known[device])
    got = known[worst] if key == "stale_ratio" else int(sum(known.values()))
    return replace(at_most(name, limit, got), worst=worst if known[worst] else None)


def _accounts(folder: Path) -> dict[int, Mapping[str, Any]]:
    """Return a machine's accounts by incarnation; one that cannot be read is as good as none."""
    found: dict[int, Mapping[str, Any]] = {}
    for path in sorted(folder.glob("devices*.json")):
        named = ACCOUNT_NAME.fullmatch(path.name)
        if named is None or path.is_symlink():
            continue
        try:
            found[int(named[1] or 1)] = read_object(path)
        except (OSError, ValueError):
            continue
    return dict(sorted(found.items()))


def _joined(told: Sequence[Mapping[str, Any]], incarnations: int) -> dict[str, Any]:
    """Return the account of one device over all incarnations; one without it counts as a loss."""
    if not told:
        missing = dict.fromkeys(
            ("samples", "errors", "stale_ratio", "lost", "restarts", "frozen"), None
        )
        return {"status": NO_REPORT, **missing, "unsafe": 0, "why": WHY_MISSING, "counts": {}}
    flat = [{**mapping_at(each, "report"), **each} for each in told]
    lost = _sum(flat, "lost")
    ratios = [each.get("stale_ratio") for each in flat]
    numbers = [float(ratio) for ratio in ratios if is_number(ratio)]
    return {
        "status": clean_line(str(flat[-1].get("status", NO_REPORT))),
        "samples": _sum(flat, "samples"),
        "errors": _sum(flat, "errors"),
        "stale_ratio": max(numbers) if len(numbers) == len(flat) else None,
        "lost": None if lost is None else lost + max(incarnations - len(told), 0),
        "restarts": _sum(flat, "restarts"),
        "frozen": _frozen(flat),
        "unsafe": int(any(each.get("unsafe") for each in flat[-1:])),
        "why": clean_line(next((str(e["why"]) for e in reversed(flat) if e.get("why")), "")),
        "counts": _counts(flat),
        **({"silent_inputs": silent} if (silent := _silent_inputs(flat)) else {}),
        **({"least_stale_age_s": age_s} if (age_s := _least_stale_age_s(flat)) else {}),
        **({"stimulus": stimulus} if (stimulus := _stimulus(flat)) else {}),
    }


def _stimulus(told: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return counts of points by output over all incarnations, and the largest of each one's figures of lateness."""
    found: dict[str, dict[str, Any]] = {}
    for each in told:
        for channel, counts in mapping_at(each, "stimulus").items():
            zeros: dict[str, Any] = {**dict.fromkeys(POINT_COUNTS, 0), "underruns": 0}
            joined = found.setdefault(clean_line(str(channel)), zeros)
            for name in zeros:
                joined[name] = int(_added(joined[name], mapping_at(counts).get(name)))
            lateness = joined.setdefault("lateness_us", {})
            for name in ("p50", "p99", "max"):
                value = mapping_at(counts, "lateness_us").get(name)
                if _is_count(value):
                    lateness[name] = max(lateness.get(name, 0), int(value))
    return found


def _silent_inputs(told: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the inputs that gave nothing in any incarnation of a device that gave samples."""
    if not _sum(told, "samples"):
        return []
    lists = [each.get("silent_inputs") for each in told]
    sets = [{str(name) for name in names} if isinstance(names, list) else set() for names in lists]
    return sorted(map(clean_line, set.intersection(*sets)))


def _least_stale_age_s(told: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the least age of a sample as it came, s; None if in any incarnation one was fresh, or none came."""
    ages = [each.get("least_stale_age_s") for each in told]
    numbers = [float(age) for age in ages if is_number(age)]
    return min(numbers) if len(numbers) == len(ages) else None


def _sum(told: Iterable[Mapping[str, Any]], key: str) -> int | None:
    values = [each.get(key) for each in told]
    numbers = [int(value) for value in values if _is_count(value)]
    total = sum(numbers)
    return total if len(numbers) == len(values) and abs(total) <= WHOLE_MAX else None


def _frozen(told: Iterable[Mapping[str, Any]]) -> int | None:
    """Return how often inputs were frozen; None if a driver's process ended without its report, or told no count."""
    total = 0
    for each in told:
        frozen = each.get("frozen")
        if not isinstance(frozen, Mapping):
            return None
        numbers = [times for times in frozen.values() if is_number(times)]
        if not all(map(_is_count, numbers)):
            return None
        total += sum(map(int, numbers))
    return total if abs(total) <= WHOLE_MAX else None


def _counts(told: Iterable[Mapping[str, Any]]) -> dict[str, float]:
    """Return all further counts, such as of samples dropped and orders refused."""
    found: dict[str, float] = {}
    for each in told:
        for key, value in each.items():
            if key not in _TOLD_APART and _is_count(value):
                name = clean_line(str(key))
                found[name] = _added(found.get(name, 0), value)
    return found


def _added(total: float, value: object) -> float:
    """Return a sum of counts with another one; as it is with what is none, or would make it none."""
    return total + value if _is_count(value) and _is_count(total + value) else total


def _is_count(value: object) -> TypeGuard[float]:
    """Tell whether a value from a file is a number that run.json can hold, and so can a sum of some."""
    return is_number(value) and abs(value) <= WHOLE_MAX
