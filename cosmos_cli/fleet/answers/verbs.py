"""
Shape of each verb's answer: one table, by which `Helper` checks all that a machine says.

A shape may depend on the question: who was asked about three files tells of these three. Pure.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from cosmos_cli.fleet.answers.parts import (
    Asked,
    changes,
    error,
    facts_shape,
    look_parts,
    name,
    names,
    process,
    process_number,
    prunable,
    sha256,
    signed,
    size,
    utc_s,
)
from cosmos_cli.fleet.answers.shapes import (
    Shape,
    anything,
    either,
    exactly,
    flag,
    list_of,
    map_of,
    map_with,
    maybe,
    nothing,
    number,
    one_of,
    record,
    row,
    text,
    whole,
)
from cosmos_cli.fleet.failure import FailureKind, MachineFailure

PIECE_BYTES_MAX = 1024 * 1024
"""Bytes of a file's content in one frame."""
BODY_BYTES_MAX: Mapping[str, int] = {"fetch": PIECE_BYTES_MAX, "sample_devices": PIECE_BYTES_MAX}
"""Bytes of an answer's body, by verb; the answers of all others have none."""
LAST_WORDS_CHARACTERS_MAX = 8192
ADVICE_CHARACTERS_MAX = 2000


def answer_shape(verb: str, asked: Asked) -> Shape:
    """Return what a verb answers to a question; of one that streams, what each piece holds."""
    shape_of = _ANSWERS.get(verb)
    return anything if shape_of is None else shape_of(asked)


def is_known(verb: str) -> bool:
    """Tell whether a verb's answers have a shape."""
    return verb in _ANSWERS


def failure_of(told: Mapping[str, Any]) -> MachineFailure:
    """Return a refusal, whose shape is `error`, as the failure that it is."""
    try:
        kind = FailureKind(told["kind"])
    except ValueError:
        kind = FailureKind.STEP
    said = _cut(told["text"], LAST_WORDS_CHARACTERS_MAX) or "it was refused there without a word"
    return MachineFailure(kind, said, _cut(told.get("advice", ""), ADVICE_CHARACTERS_MAX))


def malformed(what: str, fault: str) -> MachineFailure:
    """Say of a machine that it answered with what cannot be."""
    return MachineFailure(
        FailureKind.DATA,
        f"a faulty answer to {what}: {fault}",
        "what answers there is not what was sent there: look at its Python, its memory and its disk",
    )


def _cut(said: str, characters_max: int) -> str:
    return said if len(said) <= characters_max else f"{said[:characters_max]}..."


def _always(shape: Shape) -> Callable[[Asked], Shape]:
    return lambda asked: shape


def _several(asked: Asked) -> Shape:
    refused = record({"ok": exactly(False), "error": error})
    return row(
        [
            either(
                refused,
                record(
                    {
                        "ok": exactly(True),
                        "value": answer_shape(call["verb"], call.get("arguments") or {}),
                    }
                ),
            )
            for call in asked["calls"]
        ]
    )


def _installed(asked: Asked) -> Shape:
    return record(
        {
            "folders": map_with(asked["folders"], name),
            "trees": map_with(asked["trees"], flag),
            "environments": map_with(asked["environments"], flag),
            "prunable": prunable,
            "prunable_bytes": size,
            "wheels": names,
            "blobs": names,
        }
    )


def _environment(asked: Asked) -> Shape:
    wheel = one_of({each["sha256"] for each in asked["wheels"]}, "one of the wheels asked about")
    return record({"changed": flag, "missing": list_of(record({"sha256": wheel, "have": size}))})


def _tree(asked: Asked) -> Shape:
    return record(
        {
            "changed": flag,
            "missing": list_of(
                one_of({each[1] for each in asked["files"]}, "one of the files asked about")
            ),
        }
    )


def _processes(asked: Asked) -> Shape:
    ages = {"age_s": number} if asked.get("ages") else {}
    return list_of(record({**process, **ages}))


def _round_trips(asked: Asked) -> Shape:
    """Return what is told of datagrams: three ways to have come out."""
    head: dict[str, Shape] = {"address": name, "port": whole(0, 65_535), "sent": size}
    spans = ("min_ms", "p50_ms", "max_ms")
    none = dict.fromkeys((*spans, "unasked"), nothing)
    some = {**dict.fromkeys(spans, number), "unasked": size}
    clock = {"clock_offset_s": number, "clock_uncertainty_s": number}
    may = {**dict.fromkeys((*spans, "unasked"), anything), **clock}
    return either(
        record({**head, "answered": size, "error": name}, may),
        record({**head, "answered": one_of((0,)), **none}),
        record({**head, "answered": whole(1), **some, **clock}),
    )


def _doctor(asked: Asked) -> Shape:
    """Return what it answers to a question."""
    trips = _round_trips(asked) if asked.get("round_trips") else nothing
    return record(
        {
            **_DOCTOR,
            "facts": facts_shape({}),
            "wake_ups": _WAKE_UPS if asked.get("wake_ups") else nothing,
            "round_trips": trips,
        }
    )


_RANKS_US = maybe(record(dict.fromkeys(("p50", "p99", "p999", "max"), number)))
_TIMING_FLOOR = record(
    {
        "refusal": maybe(name),
        **dict.fromkeys(("due", "missed", "sent", "answered"), size),
        "lateness_us": _RANKS_US,
        "round_trip_us": _RANKS_US,
        "is_preempt_rt": maybe(flag),
        "error": maybe(name),
    }
)
_WAKE_UPS = either(
    record({"count": whole(1), "rate_hz": number, "p99_ms": nothing}),
    record(
        {
            "count": whole(1),
            "rate_hz": number,
            "policy": one_of(("fifo", "normal")),
            "refusal": maybe(name),
            **dict.fromkeys(("p50_ms", "p99_ms", "max_ms"), number),
        }
    ),
)
_INTERFACE = record(
    {
        "name": name,
        "is_wireless": flag,
        "speed_mbit": maybe(signed),
        "duplex": maybe(name),
        "mtu": maybe(size),
        "errors": size,
        "drops": size,
        "packets": size,
        "saves_power": maybe(flag),
        "new_errors": signed,
    }
)
_DOCTOR: Mapping[str, Shape] = {
    "busy": record(
        {
            "span_s": number,
            "processors": number,
            "top": list_of(
                record({"name": name, "pid": process_number, "user": name, "processors": number})
            ),
            "steal_share": number,
            "iowait_share": number,
            "swapped_pages": signed,
            "load": list_of(number),
            "time_service": maybe(name),
        }
    ),
    "kernel": record(
        {
            "realtime_runtime_us": maybe(signed),
            "realtime_period_us": maybe(size),
            "timer_resolution_s": number,
            "clock_source": maybe(name),
            "is_clock_synchronized": flag,
        }
    ),
    "limits": record(
        {
            "capabilities": whole(0, 2**64),
            "usable_processors": whole(1),
            "processor_numbers": list_of(size),
            "cpu_quota": maybe(number),
            "is_container": flag,
        }
    ),
    "swap": record({"total_bytes": maybe(size), "used_bytes": maybe(size)}),
    "interfaces": list_of(_INTERFACE),
    "receive_drops": record({"total": maybe(size), "before": maybe(size)}),
    "disk_write": maybe(
        either(
            record({"error": name, "errno": maybe(size)}),
            record({"bytes": size, "duration_s": number, "sync_s": number}),
        )
    ),
    "cosmos": record(
        {
            "has_root": flag,
            "living": list_of(record(process)),
            "runs": names,
            "run_count": size,
            "environments": list_of(record({"name": name, "is_whole": flag})),
        }
    ),
}
_ANSWERS: Mapping[str, Callable[[Asked], Shape]] = {
    "blob": _always(nothing),
    "blobs": _always(nothing),
    "boot": _always(
        record(
            {
                "boot_id": name,
                "living": list_of(record(process)),
                "others": list_of(text()),
                "has_root": flag,
            }
        )
    ),
    "check_runtime": _always(
        record({"runtime": name, "start_ms": number, "round_trip_ms": maybe(number)})
    ),
    "command": _always(record({}, {"is_running": flag, "ran": flag, "notes": list_of(text())})),
    "discard": _always(nothing),
    "doctor": _doctor,
    "edit_line": _always(flag),
    "end_run": _always(
        record(
            {"run": name, **dict.fromkeys(("ended", "killed", "left"), list_of(record(process)))}
        )
    ),
    "environment": _environment,
    "facts": facts_shape,
    "fetch": _always(
        record(
            {"file": size},
            {"error": text(), "offset": size, "bytes": size, "packed": flag},
            is_open=True,
        )
    ),
    "group": _always(list_of(process_number)),
    "installed": _installed,
    "inventory_runs": _always(
        list_of(
            record({"name": name, "bytes": size, "files": size, "newest_s": utc_s, "living": names})
        )
    ),
    "last_words": _always(list_of(text())),
    "living": _always(names),
    "lock": _always(nothing),
    "look": lambda asked: record(look_parts(asked)),
    "make_directories": _always(names),
    "manifest": _always(
        record(
            {},
            {"gone": flag, "files": list_of(anything), "sha256": sha256, "reading": name},
            is_open=True,
        )
    ),
    "packages": _always(
        record({}, {"doing": text(), "changes": changes, "notes": list_of(text())})
    ),
    "processes": _processes,
    "prune_installed": _always(prunable),
    "reboot": _always(nothing),
    "round_trips": _round_trips,
    "release": _always(record({"released": flag})),
    "remove_file": _always(flag),
    "remove_root": _always(names),
    "root_content": _always(
        record({"is_there": flag, "bytes": map_of(size), "others": names, "living": names})
    ),
    "sample_devices": _always(record({}, {"is_running": flag, "said": text(), "file": name})),
    "service": _always(record({}, {"is_running": flag, "did": names})),
    "set_values": _always(nothing),
    "several": _several,
    "sizes": _always(record({}, {"gone": flag, "sizes": list_of(row([name, size]))})),
    "signal_group": _always(list_of(process_number)),
    "timing_floor": _always(_TIMING_FLOOR),
    "tail": _always(
        record(
            {
                "files": map_of(
                    record(
                        {"start": size, "end": size, "text": text(characters_max=PIECE_BYTES_MAX)}
                    )
                ),
                "more": flag,
                "living": flag,
            }
        )
    ),
    "tree": _tree,
    "versions": lambda asked: map_with(asked["names"], maybe(name)),
    "wheel": _always(nothing),
    "write_file": _always(flag),
}
