"""Facts of a machine as plain frozen values; read from the answer of the helper there. Pure."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal


@dataclass(frozen=True, slots=True, kw_only=True)
class SystemPaths:
    """Places of a machine's settings; tests point them elsewhere."""

    etc: str = "/etc"
    sys: str = "/sys"
    proc: str = "/proc"
    boot: str = "/boot"

    @property
    def boot_configurations(self) -> tuple[str, ...]:
        """Places of a Raspberry Pi's config.txt: that of newer systems, then that of older ones."""
        return (f"{self.boot}/firmware/config.txt", f"{self.boot}/config.txt")


@dataclass(frozen=True, slots=True, kw_only=True)
class FileFact:
    """Facts of one path."""

    kind: Literal["file", "directory", "other", "missing", "denied"] = "missing"
    """denied: the user is not shown it, and root was not asked."""
    mode: int | None = None
    owner: str | None = None
    group: str | None = None
    owner_id: int | None = None
    """The same as a number, which the inventory may name as well."""
    group_id: int | None = None
    size_bytes: int | None = None
    sha256: str | None = None
    text: str | None = None
    """The content where it was asked for; bytes that are no UTF-8 stand in it as surrogates."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServiceFact:
    """State of a service in systemd's own words; "unknown" when it says nothing."""

    enabled: str = "unknown"
    active: str = "unknown"


@dataclass(frozen=True, slots=True, kw_only=True)
class Radio:
    """One switch of a radio transmitter."""

    name: str
    type: str
    """wlan, bluetooth or another."""
    is_soft_blocked: bool
    is_hard_blocked: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Computer:
    """The computer and its system."""

    model: str | None = None
    """Such as Raspberry Pi 4 Model B Rev 1.4."""
    machine: str = ""
    """Architecture of the kernel, such as aarch64."""
    bits: int = 64
    """Of its Python: a 32-bit system may run on a 64-bit kernel."""
    node: str = ""
    kernel: str = ""
    processors: int | None = None
    is_preempt_rt: bool | None = None
    """Whether its kernel is PREEMPT_RT."""
    processor_kind: str | None = None
    """A word that processors of the same kind and abilities share; None: not known."""
    os_name: str = ""
    """Such as Debian GNU/Linux 12 (bookworm)."""
    os_id: str = ""
    os_version: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Interpreter:
    """The Python that works there."""

    version: tuple[int, int, int]
    executable: str
    libc: str = ""
    """Such as glibc 2.36; empty when it is another."""


NOEXEC_CURE = "choose another cosmos_root, or mount it with the option exec (`user` and `users` in /etc/fstab mean noexec)"


@dataclass(frozen=True, slots=True, kw_only=True)
class Disk:
    """The file system that COSMoS's folder is on, or will be."""

    path: str
    total_bytes: int
    free_bytes: int
    is_read_only: bool = False
    is_writable: bool = True
    """Whether the user may write in the last folder of the path that exists."""
    is_noexec: bool = False
    """Whether it is mounted so that no program and no compiled module can be run from it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkFacts:
    """The network of a machine."""

    receive_buffer_bytes_max: int | None = None
    interface: str | None = None
    """The one by which the operator came; None when nobody knows."""
    is_wireless: bool | None = None
    """Whether that is Wi-Fi."""
    wireless_up: tuple[str, ...] = ()
    """All Wi-Fi interfaces that are up."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineFacts:
    """All that is known of one machine."""

    user: str
    uid: int
    home: str
    board: Computer
    python: Interpreter
    disk: Disk
    network: NetworkFacts = field(default_factory=NetworkFacts)
    clock_offset_s: float = 0.0
    """Its clock less the operator's: what is certain of it, however long the answer took."""
    uptime_s: float | None = None
    boot_id: str | None = None
    memory_total_bytes: int | None = None
    memory_available_bytes: int | None = None
    temperature_c: float | None = None
    throttled: int | None = None
    """The bits of a Raspberry Pi's firmware; None where there is none to ask."""
    realtime_priority_max: int | None = None
    """Highest priority of this login; None for no limit."""
    memory_lock_bytes_max: int | None = None
    uses_pam: bool | None = None
    """Whether its SSH server is told to use PAM, which grants limits; None where nobody asked or knows."""
    governors: Mapping[str, str] = field(default_factory=dict)
    """By processor, such as cpu0; empty where nothing scales its clock."""
    governors_available: tuple[str, ...] = ()
    radios: tuple[Radio, ...] = ()
    can_become_root: bool | None = None
    """None: nobody asked."""
    sudo_refusal: str = ""
    """Words of sudo on a user who may not; empty where it says nothing."""
    files: Mapping[str, FileFact] = field(default_factory=dict)
    services: Mapping[str, ServiceFact] = field(default_factory=dict)
    stale_units: frozenset[str] = frozenset()
    """Of the units that were asked for: those whose files systemd has not read since they were changed."""
    packages: Mapping[str, str | None] = field(default_factory=dict)
    """Version of each package that was asked for; None when it is not installed."""
    conditions: Mapping[str, bool | None] = field(default_factory=dict)
    """Whether a command was done already, by the key of its condition; None: only root can say."""
    trees: frozenset[str] = frozenset()
    """Hashes of wanted trees that are there, whole and unchanged."""
    environments: frozenset[str] = frozenset()
    """Keys of wanted environments that are there, whole and unchanged."""
    prunable: tuple[str, ...] = ()
    """Trees, environments and wheels that nobody uses, such as trees/<hash>, and what was left half made."""
    prunable_bytes: int = 0
    """Room that these take on the disk, at least."""
    wheels: frozenset[str] = frozenset()
    """Names of the dist-info folders of wheels that are there, if a wanted environment is not."""
    blobs: frozenset[str] = frozenset()
    """Hashes of files that were sent there and belong to no tree yet, if a wanted tree is not there."""

    @classmethod
    def from_mapping(
        cls, told: Mapping[str, Any], *, asked_utc_s: float = 0.0, answered_utc_s: float = 0.0
    ) -> MachineFacts:
        """
        Read what the helper told.

        Args:
            told: The answer of the verb "facts".
            asked_utc_s: The operator's clock when it asked.
            answered_utc_s: And when the answer had come.
        """
        user, board, system = told["user"], told["board"], told["os"]
        clock, memory, python = told["clock"], told["memory"], told["python"]
        radios = [
            {**radio, "is_hard_blocked": radio.get("is_hard_blocked", False)}
            for radio in told.get("radios") or ()
        ]
        return cls(
            user=user["name"],
            uid=user["id"],
            home=user["home"],
            board=Computer(
                **{key: board[key] for key in _BOARD_KEYS if key in board},
                os_name=system.get("name", ""),
                os_id=system.get("id", ""),
                os_version=system.get("version", ""),
            ),
            python=Interpreter(**{**python, "version": tuple(python["version"])}),
            disk=Disk(**{key: told["disk"][key] for key in _DISK_KEYS if key in told["disk"]}),
            network=NetworkFacts(
                **{
                    **told["network"],
                    "wireless_up": tuple(told["network"].get("wireless_up") or ()),
                }
            ),
            # Between these two; what is nearest to zero.
            clock_offset_s=min(
                max(clock["utc_s"] - answered_utc_s, 0.0), clock["utc_s"] - asked_utc_s
            ),
            uptime_s=clock.get("uptime_s"),
            boot_id=clock.get("boot_id"),
            memory_total_bytes=memory.get("total_bytes"),
            memory_available_bytes=memory.get("available_bytes"),
            temperature_c=told.get("temperature_c"),
            throttled=told.get("throttled"),
            realtime_priority_max=told.get("realtime_priority_max"),
            memory_lock_bytes_max=told.get("memory_lock_bytes_max"),
            uses_pam=told.get("uses_pam"),
            governors=dict(told.get("governors") or {}),
            governors_available=tuple(told.get("governors_available") or ()),
            radios=tuple(Radio(**radio) for radio in radios),
            can_become_root=told.get("sudo"),
            sudo_refusal=told.get("sudo_refusal") or "",
            files=files_of(told),
            packages=dict(told.get("packages") or {}),
            services={k: ServiceFact(**v) for k, v in (told.get("services") or {}).items()},
            stale_units=frozenset(told.get("stale_units") or ()),
            conditions=dict(told.get("conditions") or {}),
        )

    def file(self, path: str) -> FileFact:
        """Return what is known of a path; one that nobody asked for counts as missing."""
        return self.files.get(path, MISSING)

    def to_mapping(self) -> dict[str, Any]:
        """Return what the machine is like as plain values for --json, without what only the plan needed."""
        return {
            "model": self.board.model,
            "architecture": self.board.machine,
            "bits": self.board.bits,
            "processors": self.board.processors,
            "node": self.board.node,
            "kernel": self.board.kernel,
            "preempt_rt": self.board.is_preempt_rt,
            "os": self.board.os_name,
            "python": ".".join(map(str, self.python.version)),
            "python_executable": self.python.executable,
            "user": self.user,
            "clock_offset_s": round(self.clock_offset_s, 3),
            "uptime_s": self.uptime_s,
            "boot_id": self.boot_id,
            "disk_total_bytes": self.disk.total_bytes,
            "disk_free_bytes": self.disk.free_bytes,
            "memory_total_bytes": self.memory_total_bytes,
            "memory_available_bytes": self.memory_available_bytes,
            "temperature_c": self.temperature_c,
            "throttled": None if self.throttled is None else hex(self.throttled),
            "receive_buffer_bytes_max": self.network.receive_buffer_bytes_max,
            "realtime_priority_max": self.realtime_priority_max,
            "governors": sorted(set(self.governors.values())),
            "radios": {radio.name: _radio_words(radio) for radio in self.radios},
            "can_become_root": self.can_become_root,
        }


MISSING = FileFact()
_BOARD_KEYS = (
    *("model", "machine", "bits", "node", "kernel", "processors"),
    *("is_preempt_rt", "processor_kind"),
)
_DISK_KEYS = ("path", "total_bytes", "free_bytes", "is_read_only", "is_writable", "is_noexec")


def files_of(told: Mapping[str, Any]) -> dict[str, FileFact]:
    """Read the part about files, of the verbs "facts" and "look"."""
    return {path: FileFact(**fact) for path, fact in (told.get("files") or {}).items()}


def condition_key(condition: Mapping[str, Any]) -> str:
    """Return the key by which a condition is asked and answered."""
    return json.dumps(condition, sort_keys=True)


def _radio_words(radio: Radio) -> str:
    state = "off" if radio.is_soft_blocked or radio.is_hard_blocked else "on"
    return f"{radio.type}: {state}"
