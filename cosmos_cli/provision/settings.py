"""
The settings of a tower, each optional and reversible. Pure.

Each has one file of its own that makes it hold after the next start, and perhaps values of the running
kernel. What was there before is remembered on the machine before anything changes, and put back when
the inventory no longer asks for the setting.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.provision.facts import Facts, FileFact
from cosmos_cli.provision.step import Change, Kind, Request, Step
from cosmos_cli.provision.wanted import Paths, Wanted

HEADER = "# Written by `cosmos up` for {variable}; it takes it away when the inventory no longer asks for it.\n"
MEMORY_SCHEMA = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """One setting; a new kind is a new entry in SETTINGS."""

    field: str
    """Of `Settings`; the inventory's variable is cosmos_<field>."""
    file: Callable[[Paths], str]
    """Where it is kept for the next start."""
    line: Callable[[Any, Facts], str]
    """What that file says."""
    live: Callable[[Facts, Paths], dict[str, str]]
    """The values of the running kernel, by path; empty where it has none."""
    wish: Callable[[Any], str]
    """What each of those is to be."""
    show: Callable[[str], str] = str
    """A value of the kernel in words."""
    check: Callable[[Any, Facts], None] = lambda value, facts: None
    """Raises MachineFailure where the setting must not, or cannot, be made."""

    @property
    def variable(self) -> str:
        """Its name in the inventory."""
        return f"cosmos_{self.field}"

    def text(self, value: Any, facts: Facts) -> str:
        """Return what its file is to hold."""
        return HEADER.format(variable=self.variable) + self.line(value, facts) + "\n"


def setting_files(paths: Paths) -> tuple[str, ...]:
    """Return the files of all settings."""
    return tuple(setting.file(paths) for setting in SETTINGS)


def setting_steps(facts: Facts, wanted: Wanted) -> Iterator[Step]:
    """
    Yield a step for each setting that is to be made, changed, or put back.

    Raises:
        MachineFailure: One cannot be made, or what was before is not readable any more.
    """
    plan = _Plan(facts=facts, wanted=wanted, memory=read_memory(facts.file(wanted.memory_path)))
    for setting in SETTINGS:
        value = getattr(wanted.settings, setting.field)
        yield from plan.make(setting, value) if value is not None else plan.put_back(setting)


def read_memory(fact: FileFact) -> dict[str, Any]:
    """
    Return what the machine remembers of the time before, by setting.

    Raises:
        MachineFailure: It is damaged.
    """
    if fact.kind == "missing":
        return {}
    try:
        document = json.loads(fact.text or "")
        if document["schema"] == MEMORY_SCHEMA and isinstance(document["settings"], dict):
            return dict(document["settings"])
    except (ValueError, KeyError, TypeError):
        pass
    raise MachineFailure(
        FailureKind.DATA,
        "state/settings.json in COSMoS's folder there, which remembers what settings were before,"
        " is damaged",
        "remove it; then what is set now counts as what was before",
    )


@dataclass(slots=True)
class _Plan:
    """Plans one setting after the other; each step's memory holds what those before it remembered."""

    facts: Facts
    wanted: Wanted
    memory: dict[str, Any]

    def make(self, setting: Setting, value: Any) -> Iterator[Step]:
        path, text, found = self._file_of(setting, value)
        live = setting.live(self.facts, self.wanted.paths)
        wish = setting.wish(value)
        different = [[where, wish] for where, present in live.items() if present != wish]
        if found.text == text and not different:
            return
        setting.check(value, self.facts)
        requests = []
        if setting.field not in self.memory:
            is_ours = _is_ours(setting, found.text)
            self.memory[setting.field] = {"file": None if is_ours else found.text, "values": live}
            requests.append(self._remember())
        if found.text != text:
            requests.append(_write(path, text))
        if different:
            requests.append(_set(different))
        before = _shown(setting, live.values()) or ("set otherwise" if found.text else "not set")
        is_kept = bool(live) and not different
        how = "keep" if is_kept else f"{before} ->"
        after = " after a restart, too" if is_kept else ""
        yield Step(
            kind=Kind.SETTING,
            title=f"setting {setting.variable}: {how} {_value_words(value)}{after}",
            requests=tuple(requests),
            subject=setting.field,
            change=Change(path=path, before=found.text, after=text),
        )

    def put_back(self, setting: Setting) -> Iterator[Step]:
        path, _, found = self._file_of(setting, None)
        known = self.memory.get(setting.field)
        if known is None and not _is_ours(setting, found.text):
            return
        before = (known or {}).get("file")
        values = self._former_values(setting, (known or {}).get("values") or {})
        requests = []
        if values:
            requests.append(_set(values))
        if before is not None and found.text != before:
            requests.append(_write(path, before))
        elif before is None and found.kind == "file":
            requests.append(Request(verb="remove_file", arguments={"path": path}, as_root=True))
        if known is not None:
            del self.memory[setting.field]
            requests.append(self._remember())
        shown = _shown(setting, (value for _, value in values))
        how = f"put back {shown}" if shown else "take away"
        yield Step(
            kind=Kind.SETTING,
            title=f"setting {setting.variable}: {how}",
            requests=tuple(requests),
            subject=setting.field,
            change=Change(path=path, before=found.text, after=before),
        )

    def _file_of(self, setting: Setting, value: Any) -> tuple[str, str, FileFact]:
        path = setting.file(self.wanted.paths)
        found = self.facts.file(path)
        if found.kind in ("directory", "other") or (found.kind == "file" and found.text is None):
            text = f"{path}: expected a small file of text, or none"
            raise MachineFailure(FailureKind.STEP, text, "remove it there")
        return path, "" if value is None else setting.text(value, self.facts), found

    def _former_values(self, setting: Setting, former: Mapping[str, str]) -> list[list[str]]:
        """Return the values to put back; one that has come since, or has another name now, is like its kin."""
        live = setting.live(self.facts, self.wanted.paths)
        any_ = next(iter(former.values()), None)
        wishes = {path: former.get(path, any_) for path in live}
        return [
            [path, wish] for path, wish in wishes.items() if wish is not None and live[path] != wish
        ]

    def _remember(self) -> Request:
        document = {"schema": MEMORY_SCHEMA, "settings": self.memory}
        body = (json.dumps(document, indent=1, sort_keys=True) + "\n").encode()
        return Request(
            verb="write_file", arguments={"path": self.wanted.memory_path, "mode": 0o644}, body=body
        )


def _is_ours(setting: Setting, text: str | None) -> bool:
    return text is not None and text.startswith(HEADER.format(variable=setting.variable))


def _write(path: str, text: str) -> Request:
    body = text.encode(errors="surrogateescape")
    arguments = {"path": path, "mode": 0o644}
    return Request(verb="write_file", arguments=arguments, body=body, as_root=True)


def _set(values: list[list[str]]) -> Request:
    return Request(verb="set_values", arguments={"values": values}, as_root=True)


def _shown(setting: Setting, values: Iterable[str]) -> str:
    return ", ".join(sorted({setting.show(value) for value in values}))


def _value_words(value: Any) -> str:
    return {True: "on", False: "off"}[value] if isinstance(value, bool) else str(value)


def _receive_buffer(facts: Facts, paths: Paths) -> dict[str, str]:
    present = facts.network.receive_buffer_bytes_max
    return {} if present is None else {f"{paths.proc}/sys/net/core/rmem_max": str(present)}


def _governors(facts: Facts, paths: Paths) -> dict[str, str]:
    return {
        f"{paths.sys}/devices/system/cpu/{processor}/cpufreq/scaling_governor": governor
        for processor, governor in facts.governors.items()
    }


def _check_governor(value: str, facts: Facts) -> None:
    available = facts.governors_available
    if available and value not in available:
        text = f"cosmos_cpu_governor: expected one of {', '.join(available)}, got {value}"
        raise MachineFailure(FailureKind.UNSUPPORTED, text, "correct it in the inventory")


def _radio(kind: str) -> Callable[[Facts, Paths], dict[str, str]]:
    def live(facts: Facts, paths: Paths) -> dict[str, str]:
        return {
            f"{paths.sys}/class/rfkill/{radio.name}/soft": "1" if radio.is_soft_blocked else "0"
            for radio in facts.radios
            if radio.type == kind
        }

    return live


def _soft_block(is_on: bool) -> str:
    return "0" if is_on else "1"


def _radio_words(soft_block: str) -> str:
    return "off" if soft_block == "1" else "on"


def _radio_rule(kind: str) -> Callable[[bool, Facts], str]:
    """Return a rule for udev: it holds whenever the radio appears, whatever its number is."""
    return lambda is_on, facts: (
        f'ACTION=="add", SUBSYSTEM=="rfkill", ATTR{{type}}=="{kind}", ATTR{{soft}}="{_soft_block(is_on)}"'
    )


def _check_wifi(is_on: bool, facts: Facts) -> None:
    network = facts.network
    if is_on or not (network.is_wireless or (network.interface is None and network.wireless_up)):
        return
    name = network.interface or ", ".join(network.wireless_up)
    raise MachineFailure(
        FailureKind.UNSUPPORTED,
        f"cosmos_wifi: false would cut this very connection: it comes over Wi-Fi ({name})",
        "connect the machine by cable, or give it cosmos_wifi: null in the inventory",
    )


SETTINGS: tuple[Setting, ...] = (
    Setting(
        field="receive_buffer_bytes",
        file=lambda paths: f"{paths.etc}/sysctl.d/90-cosmos.conf",
        line=lambda value, facts: f"net.core.rmem_max = {value}",
        live=_receive_buffer,
        wish=str,
    ),
    Setting(
        field="realtime_priority",
        file=lambda paths: f"{paths.etc}/security/limits.d/90-cosmos.conf",
        line=lambda value, facts: f"{facts.user} - rtprio {value}",
        live=lambda facts, paths: {},
        wish=str,
    ),
    Setting(
        field="cpu_governor",
        file=lambda paths: f"{paths.etc}/tmpfiles.d/90-cosmos.conf",
        line=lambda value, facts: (
            f"w /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor - - - - {value}"
        ),
        live=_governors,
        wish=str,
        check=_check_governor,
    ),
    Setting(
        field="wifi",
        file=lambda paths: f"{paths.etc}/udev/rules.d/90-cosmos-wifi.rules",
        line=_radio_rule("wlan"),
        live=_radio("wlan"),
        wish=_soft_block,
        show=_radio_words,
        check=_check_wifi,
    ),
    Setting(
        field="bluetooth",
        file=lambda paths: f"{paths.etc}/udev/rules.d/90-cosmos-bluetooth.rules",
        line=_radio_rule("bluetooth"),
        live=_radio("bluetooth"),
        wish=_soft_block,
        show=_radio_words,
    ),
)
