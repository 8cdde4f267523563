"""
The settings of a machine, each optional and reversible: its variable, and how it is made true there. Pure.

Each has one file of its own that makes it hold after the next start, and perhaps values of the running
kernel. `cosmos_cli.provision.settings` plans how they are made and put back.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel, ConfigDict, Field
from pydantic.fields import FieldInfo

from cosmos_cli.models.text_forms import like

if TYPE_CHECKING:  # only a plan knows facts
    from cosmos_cli.models.machine_facts import MachineFacts, SystemPaths

PREFIX = "cosmos_"
BLOCKED = "1"
"""Of rfkill: the radio is off."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """Way in which a variable's value is made true on a machine."""

    file: Callable[[SystemPaths], str]
    """File that keeps it for the next start; no other setting has that file."""
    line: Callable[[Any, MachineFacts], str]
    """Line of that file."""
    is_own: Callable[[str, MachineFacts], bool] = lambda line, facts: True
    """Whether a line of that file is of who logs in; those of others stay."""
    kernel_files: Callable[[SystemPaths], tuple[str, ...]] = lambda paths: ()
    """Files of the running kernel that must be read before `live` can answer."""
    live: Callable[[MachineFacts, SystemPaths], dict[str, str]] = lambda facts, paths: {}
    """The values of the running kernel, by path; empty where it has none."""
    wish: Callable[[Any], str] = str
    """Desired value of each of those."""
    show: Callable[[str], str] = str
    """A value of the kernel in words."""
    refusal: Callable[[Any, MachineFacts], tuple[str, str] | None] = lambda value, facts: None
    """Why the setting must not, or cannot, be made there, and what to do."""
    put_back_refusal: Callable[[str, MachineFacts], tuple[str, str] | None] = lambda value, facts: (
        None
    )
    """Why a value of the kernel from before must not be put back there, and what to do."""
    variable: str = ""
    """Its name in the inventory; that of the field it is declared at."""

    @property
    def key(self) -> str:
        """Its name in plans, and in what a machine remembers."""
        return self.variable.removeprefix(PREFIX)


def _declared(setting: Setting) -> Any:
    """Return the default of a setting's variable: None, which leaves the machine's own and puts it back."""
    field = FieldInfo(default=None)
    field.metadata.append(setting)
    return field


def _sysctl(name: str, file: str) -> Setting:
    """Return the setting of a value of the kernel, such as net.core.rmem_max; *file* is of /etc/sysctl.d."""

    def kernel_files(paths: SystemPaths) -> tuple[str, ...]:
        return (f"{paths.proc}/sys/{name.replace('.', '/')}",)

    def live(facts: MachineFacts, paths: SystemPaths) -> dict[str, str]:
        found = {path: facts.file(path).text for path in kernel_files(paths)}
        return {path: text.strip() for path, text in found.items() if text is not None}

    return Setting(
        file=lambda paths: f"{paths.etc}/sysctl.d/{file}",
        line=lambda value, facts: f"{name} = {value}",
        kernel_files=kernel_files,
        live=live,
    )


def _governors(facts: MachineFacts, paths: SystemPaths) -> dict[str, str]:
    return {
        f"{paths.sys}/devices/system/cpu/{processor}/cpufreq/scaling_governor": governor
        for processor, governor in facts.governors.items()
    }


def _governor_refusal(value: str, facts: MachineFacts) -> tuple[str, str] | None:
    available = facts.governors_available
    if not available or value in available:
        return None
    text = f"cosmos_cpu_governor: expected one of {', '.join(available)}, got {value}"
    return text, "correct it in the inventory"


def _radio(
    kind: str,
    file: str,
    refusal: Callable[[Any, MachineFacts], tuple[str, str] | None] = lambda value, facts: None,
    put_back_refusal: Callable[[str, MachineFacts], tuple[str, str] | None] = (
        lambda value, facts: None
    ),
) -> Setting:
    """Return the setting of radios of a kind of rfkill's: a rule for udev holds whenever one appears, whatever its number."""

    def soft_block(is_on: bool) -> str:
        return "0" if is_on else BLOCKED

    def live(facts: MachineFacts, paths: SystemPaths) -> dict[str, str]:
        return {
            f"{paths.sys}/class/rfkill/{radio.name}/soft": soft_block(not radio.is_soft_blocked)
            for radio in facts.radios
            if radio.type == kind
        }

    return Setting(
        file=lambda paths: f"{paths.etc}/udev/rules.d/{file}",
        line=lambda is_on, facts: (
            f'ACTION=="add", SUBSYSTEM=="rfkill", ATTR{{type}}=="{kind}",'
            f' ATTR{{soft}}="{soft_block(is_on)}"'
        ),
        live=live,
        wish=soft_block,
        show=lambda value: "off" if value == BLOCKED else "on",
        refusal=refusal,
        put_back_refusal=put_back_refusal,
    )


def _wifi_refusal(is_on: bool, facts: MachineFacts) -> tuple[str, str] | None:
    if is_on or not _comes_over_wifi(facts):
        return None
    return (
        f"cosmos_wifi: false {_cut_words(facts)}",
        "connect the machine by cable, or give it cosmos_wifi: null in the inventory",
    )


def _wifi_put_back_refusal(value: str, facts: MachineFacts) -> tuple[str, str] | None:
    if value != BLOCKED or not _comes_over_wifi(facts):
        return None
    return (
        f"to put cosmos_wifi back, which was off before, {_cut_words(facts)}",
        "connect the machine by cable, or give it cosmos_wifi: true in the inventory",
    )


def _comes_over_wifi(facts: MachineFacts) -> bool:
    network = facts.network
    return bool(network.is_wireless or (network.interface is None and network.wireless_up))


def _cut_words(facts: MachineFacts) -> str:
    name = facts.network.interface or ", ".join(facts.network.wireless_up)
    return f"would cut this very connection: it comes over Wi-Fi ({name})"


class SettingVariables(BaseModel):
    """The variables that set something on a machine; None leaves the machine's own, and puts it back where it was set."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    cosmos_receive_buffer_bytes: Annotated[int, Field(gt=0, le=2**31 - 1)] | None = _declared(
        _sysctl("net.core.rmem_max", "90-cosmos.conf")
    )
    """Largest socket receive buffer that the kernel is to grant; as it is if not given."""
    cosmos_realtime_priority: Annotated[int, Field(ge=1, le=99)] | None = _declared(
        Setting(
            file=lambda paths: f"{paths.etc}/security/limits.d/90-cosmos.conf",
            line=lambda value, facts: f"{facts.user} - rtprio {value}",
            is_own=lambda line, facts: line.split()[0] == facts.user,
        )
    )
    """Highest real-time priority that the user may take; as it is if not given."""
    cosmos_cpu_governor: (
        Annotated[str, like(r"[a-z_]+", "a governor such as performance")] | None
    ) = _declared(
        Setting(
            file=lambda paths: f"{paths.etc}/tmpfiles.d/90-cosmos.conf",
            line=lambda value, facts: (
                f"w /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor - - - - {value}"
            ),
            live=_governors,
            refusal=_governor_refusal,
        )
    )
    """Governor of the processors' clock, such as performance; as it is if not given."""
    cosmos_wifi: bool | None = _declared(
        _radio(
            "wlan",
            "90-cosmos-wifi.rules",
            refusal=_wifi_refusal,
            put_back_refusal=_wifi_put_back_refusal,
        )
    )
    """false switches the radio off, true on; as it is if not given."""
    cosmos_bluetooth: bool | None = _declared(_radio("bluetooth", "90-cosmos-bluetooth.rules"))
    """false switches the radio off, true on; as it is if not given."""


SETTINGS: tuple[Setting, ...] = tuple(
    dataclasses.replace(setting, variable=name)
    for name, field in SettingVariables.model_fields.items()
    for setting in field.metadata
    if isinstance(setting, Setting)
)
"""In the order in which they are made."""


def setting_files(paths: SystemPaths) -> tuple[str, ...]:
    """Return the files that a plan of settings must know: their own, and those of the kernel."""
    return tuple(
        path for each in SETTINGS for path in (each.file(paths), *each.kernel_files(paths))
    )
