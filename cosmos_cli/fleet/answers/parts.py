"""Shapes that several answers of the helper have in common: names, sizes, processes, facts. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from cosmos_cli.fleet.answers.shapes import (
    Shape,
    flag,
    list_of,
    map_of,
    map_with,
    maybe,
    number,
    one_of,
    record,
    row,
    text,
    whole,
)

Asked = Mapping[str, Any]
"""The arguments of a question."""

FILE_CHARACTERS_MAX = 262_144
NAME_CHARACTERS_MAX = 4096
UTC_S_MIN, UTC_S_MAX = -62_135_596_800, 253_402_300_799
"""The years 1 to 9999."""

name = text(characters_max=NAME_CHARACTERS_MAX)
names = list_of(name)
user_name = text(r"[^\x00-\x20\x7f\ud800-\udfff]{1,256}")
"""It stands in a line of a file there."""
sha256 = text("[0-9a-f]{64}")
size = whole()
utc_s = whole(UTC_S_MIN, UTC_S_MAX)
process_number = whole(1, 2**31)
signed = whole(-(2**62))

greeting = record(
    {
        "python": text(r"\d{1,3}(\.\d{1,5}){2}"),
        "executable": name,
        "machine": name,
        "bits": one_of((32, 64)),
        "libc": name,
        "uid": size,
        "home": name,
        "node": name,
        "pid": process_number,
        "boot_id": text(),
    }
)
"""First answer of a helper."""

error = record(
    {"kind": text(characters_max=64), "text": text()},
    {"advice": text()},
)
"""Of an answer that is a refusal."""

process = {
    **dict.fromkeys(("run", "role", "name", "boot_id", "node", "run_directory", "utc"), text()),
    "pid": process_number,
    "start_ticks": size,
}

file_fact = record(
    {"kind": one_of(("file", "directory", "other", "missing", "denied"))},
    {
        "mode": whole(0, 0o7777),
        "owner": name,
        "group": name,
        "owner_id": size,
        "group_id": size,
        "size_bytes": size,
        "sha256": sha256,
        "text": text(characters_max=FILE_CHARACTERS_MAX),
    },
)
prunable = record(dict.fromkeys(("trees", "environments", "wheels"), names))
changes = list_of(record({"name": name, "old": maybe(name), "new": maybe(name)}))


def keys_of(asked: Asked, key: str) -> Iterable[str]:
    """Return what was asked for under a key."""
    return asked.get(key) or ()


def look_parts(asked: Asked) -> dict[str, Shape]:
    """Return what is told of the files and conditions asked about."""
    return {
        "files": map_with(keys_of(asked, "files"), file_fact),
        "conditions": map_with(keys_of(asked, "conditions"), maybe(flag)),
    }


def facts_shape(asked: Asked) -> Shape:
    """Return what the verb "facts" answers."""
    return record(
        {
            **_FACTS,
            **look_parts(asked),
            "services": map_with(
                keys_of(asked, "services"), record({"enabled": name, "active": name})
            ),
            "stale_units": names,
            "packages": map_with(keys_of(asked, "packages"), maybe(name)),
        }
    )


_FACTS: Mapping[str, Shape] = {
    "user": record({"name": user_name, "id": size, "home": name}),
    "board": record(
        {
            "model": maybe(name),
            "machine": name,
            "bits": one_of((32, 64)),
            "node": name,
            "kernel": name,
            "processors": maybe(whole(1)),
        },
        {"is_preempt_rt": maybe(flag), "processor_kind": maybe(name)},
    ),
    "os": record(dict.fromkeys(("id", "version", "name", "code"), name)),
    "python": record(
        {
            "version": row([size, size, size]),
            "executable": name,
            "libc": name,
        }
    ),
    "clock": record({"utc_s": number, "uptime_s": maybe(number), "boot_id": maybe(name)}),
    "disk": record(
        {
            "path": name,
            "total_bytes": size,
            "free_bytes": size,
            "free_files": maybe(size),
            "is_read_only": flag,
            "is_writable": flag,
            "is_noexec": flag,
        }
    ),
    "memory": record({"total_bytes": maybe(size), "available_bytes": maybe(size)}),
    "temperature_c": maybe(number),
    "throttled": maybe(size),
    "network": record(
        {
            "receive_buffer_bytes_max": maybe(size),
            "interface": maybe(name),
            "is_wireless": maybe(flag),
            "wireless_up": names,
        }
    ),
    "realtime_priority_max": maybe(size),
    "memory_lock_bytes_max": maybe(size),
    "uses_pam": maybe(flag),
    "governors": map_of(name),
    "governors_available": names,
    "radios": list_of(
        record(
            {"name": name, "type": name, "is_soft_blocked": flag, "is_hard_blocked": flag},
        )
    ),
    "sudo": maybe(flag),
    "sudo_refusal": maybe(text()),
}
