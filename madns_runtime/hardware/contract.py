"""
The contract between the framework and a device.

A kind of device is a `DeviceKind` descriptor, found by the entry point `madns.devices`, as `module:NAME` or as
`./file.py:NAME`. It names a class that is made with the kind's parameters and whose methods are called by the
device's own process, one at a time: none of them may hold up a tick, however long it takes.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal

__all__ = ["Channel", "Device", "DeviceKind", "Needs", "Sample", "SimulatedDevice", "Value"]

Value = float | Sequence[float] | bytes
"""Value of a channel: a number, a sequence of as many as its shape has, or the bytes of a frame."""

ELEMENTS_MAX = 4096
"""Numbers of one channel: a camera's picture is no sample."""
FRAME_BYTES_MAX = 8192
NAME_CHARACTERS_MAX = 40
"""Of a channel: its file, and what is counted of it in a page of bounded size, bear its name."""
NAME = re.compile(rf"[A-Za-z][A-Za-z0-9_]{{0,{NAME_CHARACTERS_MAX - 1}}}")
COLUMNS_TAKEN: Mapping[str, tuple[str, ...]] = {
    "in": ("t_s", "number", "age_us"),
    "out": ("t_s", "lateness_us"),
}
"""By direction: names of what is recorded before a channel's numbers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Channel:
    """One quantity that a device measures or takes."""

    name: str
    unit: str = ""
    """Symbol of the values' unit, such as rad/s."""
    shape: tuple[int, ...] = ()
    """Of its values; () is one number. Arrays are handed over row by row."""
    components: tuple[str, ...] = ()
    """Names of the elements, such as x, y, z; empty for 1, 2, 3, ..."""
    direction: Literal["in", "out"] = "in"
    """in: the device measures it; out: the device takes it."""
    is_frame: bool = False
    """Whether its values are bytes, of at most `frame_bytes_max`."""
    is_line: bool = False
    """Of frames: whether each is a line without its end, so that not all bytes can be in one, and none tells where it ends."""
    frame_bytes_max: int = 1024
    passing: Literal["newest", "queue"] = "newest"
    """newest: who is late finds the newest value alone; queue: each value arrives once, in order."""
    rate_hz_max: float | None = None
    """Largest rate at which the device gives or takes it, Hz; None where it knows none."""
    limits: tuple[float, float] | None = None
    """Least and largest value: outputs are held to them, inputs beyond are counted."""
    safe: float | tuple[float, ...] | None = None
    """Value of an output in which it harms nobody; None if only `Device.make_safe` knows it."""
    underrun: Literal["hold", "safe"] = "hold"
    """Value of an output whose profile has run out: hold keeps the newest one, safe takes the safe one."""

    @property
    def size(self) -> int:
        """Number of its elements."""
        return math.prod(self.shape)

    def column_names(self) -> tuple[str, ...]:
        """Return a name per element: the channel's own for a number, gyro_x, gyro_y, ... for a vector."""
        if not self.shape:
            return (self.name,)
        names = self.components or tuple(str(number) for number in range(1, self.size + 1))
        return tuple(f"{self.name}_{name}" for name in names)

    def faults(self) -> list[str]:
        """Return what is wrong with the declaration."""
        found = []
        if not NAME.fullmatch(self.name):
            found.append(
                f"expected a name such as gyro, a letter and then at most {NAME_CHARACTERS_MAX - 1} letters, digits and _,"
                f" got {self.name!r:.80}"
            )
        if any(length < 1 for length in self.shape) or self.size > ELEMENTS_MAX:
            found.append(
                f"{self.name}: expected 1 to {ELEMENTS_MAX} elements, got the shape {self.shape}"
            )
        if self.components and len(self.components) != self.size:
            found.append(
                f"{self.name}: {self.size} elements, and {len(self.components)} components"
            )
        found += self._column_faults()
        if self.is_frame and (self.shape or not 1 <= self.frame_bytes_max <= FRAME_BYTES_MAX):
            found.append(f"{self.name}: frames have no shape and 1 to {FRAME_BYTES_MAX} bytes")
        if self.limits is not None and not self.limits[0] <= self.limits[1]:
            found.append(f"{self.name}: limits {self.limits} are no range")
        if self.safe is not None and self.direction == "in":
            found.append(f"{self.name}: only an output has a safe value")
        elif self.safe is not None:
            found += self._safe_faults()
        if self.underrun == "safe" and (self.safe is None or self.is_frame):
            found.append(f"{self.name}: underrun: safe needs a safe value of numbers")
        return found

    def _column_faults(self) -> Iterator[str]:
        """Yield what keeps its values from standing in a record beside their time."""
        if self.is_frame:
            return
        names = self.column_names()
        if len(set(names)) < len(names):
            yield f"{self.name}: expected components with distinct names, got {', '.join(names)}"
        if taken := sorted(set(names) & set(COLUMNS_TAKEN[self.direction])):
            yield f"{self.name}: no number may be called {taken[0]}, as what is recorded beside it is"

    def _safe_faults(self) -> Iterator[str]:
        """Yield what is wrong with the safe value of an output."""
        values = self.safe if isinstance(self.safe, tuple) else (self.safe or 0.0,)
        if isinstance(self.safe, tuple) and len(values) != self.size:
            yield f"{self.name}: {self.size} elements, and {len(values)} safe values"
        if not all(map(math.isfinite, values)):
            yield f"{self.name}: expected a finite safe value, got {self.safe}"
        elif self.limits and not all(self.limits[0] <= v <= self.limits[1] for v in values):
            yield f"{self.name}: safe value {self.safe} is beyond the limits {self.limits}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """Values that a device gave at one instant."""

    values: Mapping[str, Value]
    """By channel; only channels that were read."""
    taken_s: float
    """Time at which they were true, on this machine's monotonic clock (`time.monotonic`), s."""
    device_s: float | None = None
    """The same on the device's own clock, s; None if it has none."""
    handed_s: float | None = None
    """Simulated time at which it was handed on when it was recorded, s: of a recording in lockstep, see `playback`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Needs:
    """Needs of a device that its machine has to meet; `cosmos up` installs them, `cosmos doctor` looks for them."""

    packages: tuple[str, ...] = ()
    """Packages of the system, by Debian's names."""
    groups: tuple[str, ...] = ()
    """Groups whose members may open it, such as i2c."""
    boot_lines: tuple[str, ...] = ()
    """Lines of a Raspberry Pi's boot configuration (config.txt), such as dtparam=i2c_arm=on."""
    files: tuple[str, ...] = ()
    """Files that must be there, such as /dev/i2c-1; patterns as a shell's."""
    requirements: tuple[str, ...] = ()
    """Python requirements that pip installs."""
    system_modules: tuple[str, ...] = ()
    """Python modules that only the system's own packages bring (there is no wheel): the environment sees these."""
    exclusive: tuple[str, ...] = ()
    """Parts of the machine that no other run may have meanwhile, such as i2c-1 0x1e, by whatever name it lists them."""


class Device:
    """
    One device: subclass it and override what is needed.

    It is made with an instance of its kind's parameters, and then touches nothing: a process that stands by to make it safe
    has made one, too, while it is driven. Whatever a method raises is told by machine and device; the
    device is then closed and opened anew, after 0.1 s at first and 1 s at most.
    """

    kind: DeviceKind
    may_move: bool = True
    """Whether outputs may move in this run; without it `open` leaves them as they are. Set before `open`."""
    place: str = ""
    """The machine's name, or that of the agent whose own it is. Set before `open`."""

    inserted_faults: Mapping[str, float] = MappingProxyType({})
    """Faults that are in force around it, with their values (not a number where they take none). Set before `open`."""
    count: Callable[[str, int], object] = staticmethod(lambda name, number: None)
    """Adds to a count of the run by name, such as lost_bytes; it outlives the device and its process. Set before `open`."""
    carries_out: frozenset[str] = frozenset()
    """Inserted faults that it carries out itself, in what it emulates: its samples are not altered by them."""

    def __init__(self, parameters: Any) -> None:
        self.parameters = parameters

    def open(self) -> str:
        """Open the device, and return its identity, such as a serial number; "" if it has none."""
        return ""

    def read(self) -> Sample | None:
        """
        Return what it measures now, or None if there is nothing new.

        A sample without a value says of a device of outputs alone that it is there; of others it is counted, and no news.
        Called at the device's rate; with a `fileno`, whenever that is readable, and as often as it gives samples.
        """
        return None

    def write(self, values: Mapping[str, Value], due_s: float) -> None:
        """
        Put out values, by channel; called when they are due, with values inside the channels' limits.

        Args:
            values: Of outputs.
            due_s: When they were due, on this machine's monotonic clock, s.

        Raises:
            PluginError: The device takes no such value, or has no room for it now: it is refused and counted, and
                the device stays open. Whatever else is raised closes it, and it is opened anew.
        """
        raise NotImplementedError(f"{type(self).__name__} has outputs and no write(values, due_s)")

    def health(self) -> Mapping[str, float | int | str | bool | None]:
        """Return what else is known of its state, such as a supply voltage; asked once per second at most."""
        return {}

    def make_safe(self) -> None:
        """
        Bring all outputs into their safe state.

        Called before the device is closed, and on a device that was opened for nothing else.
        """

    def close(self) -> None:
        """Let go of the device; called once after each `open`, also one that failed."""

    def fileno(self) -> int | None:
        """Return a descriptor that becomes readable when there is something to read; None to be asked at a rate."""
        return None


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceKind:
    """Names the parts of a kind of device; importing it imports no library of the device's."""

    name: str
    summary: str
    """Description, in one line."""
    channels: tuple[Channel, ...] | Callable[[Any], tuple[Channel, ...]]
    """Channels that it measures and takes, or a function of the parameters that tells."""
    device: str | type[Device] = ""
    """The class: module:Class, :Class in the descriptor's own file, or the class itself; a class that bears the kind
    as its `kind` is meant where nothing is said."""
    parameters: type = type(None)
    """A frozen stdlib dataclass as a simulation's; NoneType for a kind without parameters."""
    needs: Needs | Callable[[Any], Needs] = field(default_factory=Needs)
    files: tuple[str, ...] = ()
    """Parameters that name a file which has to be there before a run; one below the scenario's folder is looked for."""
    rate_hz: float = 10.0
    """Rate at which it is read where nobody says another, Hz."""
    rate_hz_max: float = 1000.0
    can_block: bool = True
    """Whether a call may take longer than a millisecond: False lets such devices of a machine share one process."""
    needs_hardware: bool = True
    """Whether it is bound to a machine: False lets a scenario give one to each agent."""
    follows_simulated_time: bool = False
    """Whether its class is a `SimulatedDevice`: it then runs in lockstep, too."""


class SimulatedDevice(Device):
    """A device whose values depend on simulated time alone: the same in real time and in lockstep."""

    is_finite = False
    """Whether its samples come to an end by themselves, as a recording's do: any number of them may be of one time."""

    def sample_at(self, t_s: float) -> Sample | None:
        """
        Return what it measures at simulated time *t_s*, s; None if there is nothing new.

        Called with times that never go back: at the device's rate, or whenever `next_s` says. `taken_s` of the
        sample is simulated time, too.
        """
        return None

    def next_s(self) -> float | None:
        """Return the simulated time at which it has something new, s; infinity for never, None for its rate."""
        return None
