"""Contexts of plug-ins: the implementation of those that `plugin.api` declares."""

from __future__ import annotations

import dataclasses
import math
import traceback
import zlib
from collections.abc import Callable, Container, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

# By its name: imported once, before agents are forked, not in each of them.
from numpy.random import default_rng

from madns_runtime.config import RunConfig
from madns_runtime.errors import (
    BlamedError,
    ConfigurationError,
    MissingExtraError,
    PluginError,
)
from madns_runtime.medium.carrier import Carrier
from madns_runtime.medium.mailbox import Mailbox
from madns_runtime.medium.outcomes import LinkOutcome
from madns_runtime.plain_values import is_real, shown
from madns_runtime.plugin.code_places import error_text, line_of
from madns_runtime.plugin.device_view import DeviceView
from madns_runtime.protocol.codec import pack, unpack
from madns_runtime.protocol.messages import Service, Transmission
from madns_runtime.recording.records import FRAMEWORK_STREAMS, Field, StreamSchema
from madns_runtime.recording.run_journal import RunJournal
from madns_runtime.recording.stream_rules import check_agent_name, check_name

FRAMEWORK = Path(__file__).parents[1]
"""Where code stands that is nobody's plug-in, but for what is shipped below simulations."""
TEXT_CHARACTERS_MAX = 2000
"""Characters kept of what a plug-in's exception says; the whole is in the log."""
LINE_CHARACTERS_MAX = 1500
"""Characters kept of the first line of that: with the call and the place it is no longer than a text may be."""


class Sender(Protocol):
    """Way of a context's `send` to the session."""

    def __call__(
        self,
        to: str,
        message: Any,
        service: Service = Service.RELIABLE,
        *,
        deadline_s: float | None = None,
    ) -> int | None:
        """Send *message*; see `plugin.api.Context.send`."""


class HalfState(Protocol):
    """State of the host's half that its context tells."""

    lateness_s: float
    carrier: Carrier


class RunContext:
    """
    Either half's view of the run.

    Args:
        name: host, or the agent's name.
        config: The run.
        parameters: The simulation's, parsed.
        journal: What it logs to; its streams go beside.
        now_s: Returns the simulated time.
        send: Takes messages.
    """

    def __init__(  # noqa: PLR0913 - the collaborators of a seam, all keyword-only
        self,
        *,
        name: str,
        config: RunConfig,
        parameters: Any,
        journal: RunJournal,
        now_s: Callable[[], float],
        send: Sender,
    ) -> None:
        self.name = name
        self.is_lockstep = config.time.is_lockstep
        self.agents = config.agents.resolved_names()
        self.workers = config.executor.workers
        self.parameters = parameters
        self.tick_hz = config.agents.tick_hz
        self.duration_s = config.time.duration_s
        self.base_directory = Path(config.base_directory)
        self.random = default_rng([config.seed, zlib.crc32(name.encode())])
        self.now_s = now_s
        # The framework's own methods, without a layer between: they are called every tick.
        recorder = journal.recorder
        self.record = recorder.record
        self.send = send
        self.keep_text = recorder.keep_text
        self._recorder = recorder
        self._journal = journal

    def open_stream(self, name: str, fields: Sequence[Field]) -> None:
        """Declare a record stream; see `plugin.api.Context.open_stream`."""
        check_name(name)
        if name in FRAMEWORK_STREAMS:
            raise PluginError(f"stream {name!r} belongs to the framework; choose another name")
        self._recorder.open_stream(StreamSchema(name, tuple(fields)))

    def log(self, level: str, text: str) -> None:
        """Log a sentence; see `plugin.api.Context.log`."""
        self._journal.log(level, text, self.now_s())


class PeerContext(RunContext):
    """An agent's view: it can also send to other agents."""

    def __init__(
        self, *, mailbox: Mailbox, hardware: Mapping[str, DeviceView], **of_every_half: Any
    ) -> None:
        super().__init__(**of_every_half)
        self.hardware = hardware
        self.transmit = mailbox.transmit
        self.message_counts = mailbox.counts

    def open_stream(self, name: str, fields: Sequence[Field]) -> None:
        """Declare a record stream; see `plugin.api.Context.open_stream`."""
        if isinstance(name, str):
            check_agent_name(name)
        super().open_stream(name, fields)


class JobContext(RunContext):
    """The host's view: it can also hand long work to the executor, and knows of messages between agents."""

    def __init__(
        self,
        *,
        half: HalfState,
        submit: Callable[..., int],
        wake: Callable[[float], None],
        agent_parameters: Mapping[str, Any],
        **of_every_half: Any,
    ) -> None:
        super().__init__(**of_every_half)
        self._half = half
        self.agent_parameters = agent_parameters
        self.submit = submit
        self.wake = wake
        self.account = half.carrier.account

    def enter(
        self, sender: Any, transmission: Any, outcomes: Sequence[LinkOutcome]
    ) -> Sequence[LinkOutcome]:
        """See to a message of a place that is no agent; see `plugin.api.HostContext.enter`."""
        if not isinstance(sender, str) or not isinstance(transmission, Transmission):
            raise PluginError(
                f"enter({shown(sender)}, a {type(transmission).__name__}, ...): expected a place's name and a"
                " Transmission of madns_runtime.plugin.api"
            )
        # Whoever sent it may go on to change it; what a message cannot carry is told here.
        payload = unpack(pack(transmission.payload))
        return self._half.carrier.enter(
            sender, dataclasses.replace(transmission, payload=payload), outcomes
        )

    @property
    def timer_lateness_s(self) -> float:
        """Delay of the timer's last call behind the time asked for; see `plugin.api.HostContext`."""
        return self._half.lateness_s


def check_sending(
    to: Any,
    receivers: Container[str],
    service: Service,
    deadline_s: float | None,
    *,
    is_running: bool,
) -> None:
    """
    Refuse what cannot be sent, or what nobody could keep account of.

    Args:
        to: The receiver.
        receivers: Who there is.
        service: The class of service.
        deadline_s: Simulated time by which it must be there, s.
        is_running: Whether simulated time has begun.

    Raises:
        PluginError: There is no such receiver or class of service, or the deadline is none.
    """
    if not isinstance(to, str) or to not in receivers:
        raise PluginError(
            f"expected a receiver (an agent sends to 'host', the host to an agent's name), got {shown(to)}"
        )
    if not isinstance(service, Service):
        raise PluginError(f"expected a Service, such as Service.RELIABLE, got {shown(service)}")
    if deadline_s is None:
        return
    if service is not Service.SYNC:
        raise PluginError(f"deadline_s goes with Service.SYNC, not with {service!r}")
    if not is_real(deadline_s) or not math.isfinite(deadline_s):
        raise PluginError(
            f"deadline_s: expected a simulated time in seconds, got {shown(deadline_s)}"
        )
    if not is_running:
        raise PluginError("deadline_s is simulated time, which has not begun")


def describe_exception(
    error: BaseException, doing: str, called: Callable[..., Any] | None = None
) -> str:
    """
    Return which call of a plug-in raised what, and in which file and line: all of it in the first line.

    Further lines of the error follow, for verdicts show no more than one. The place is the innermost line of the
    plug-in's own folder, not that of a library which it called; of what was raised before its first line, as by
    arguments that it does not take, where it is written. Errors that blame the user's file say all by themselves.

    Args:
        error: What was caught, one call above the plug-in.
        doing: The call, such as FleetHost.setup.
        called: What was called, where it is known.
    """
    if isinstance(error, BlamedError | ConfigurationError | MissingExtraError):
        return clean_text(error_text(error))
    frames = traceback.extract_tb(error.__traceback__)
    place = ""
    if called is not None and not frames[1:]:
        place = line_of(called)
    elif frames:
        # A medium of the framework's calls the plug-in, too, and refuses what that returns: this says whose it is.
        outside = [frame for frame in frames[1:] if not _is_framework(Path(frame.filename))]
        home = Path((outside or frames[1:] or frames)[0].filename).parent
        own = [frame for frame in frames[1:] if _is_below(Path(frame.filename), home)]
        frame = own[-1] if own else frames[-1]
        if outside or not isinstance(error, PluginError):
            place = f"{Path(frame.filename).name}:{frame.lineno}"
    first, *rest = clean_text(error_text(error).strip()).splitlines() or [""]
    if len(first) > LINE_CHARACTERS_MAX:
        first = f"{first[:LINE_CHARACTERS_MAX]} [cut]"
    text = f": {first}" if first else ""
    line = f"{doing} raised {type(error).__name__}{text}{place and f' ({place})'}"
    return "\n".join((line, *rest))


def clean_text(text: str) -> str:
    """Return *text* as a message and a record can carry it: no lone surrogates, and bounded."""
    text = text.encode("utf-8", "backslashreplace").decode("utf-8")
    return text if len(text) <= TEXT_CHARACTERS_MAX else f"{text[:TEXT_CHARACTERS_MAX]} [cut]"


def _is_framework(path: Path) -> bool:
    return path.is_relative_to(FRAMEWORK) and not path.is_relative_to(FRAMEWORK / "simulations")


def _is_below(path: Path, home: Path) -> bool:
    # A virtual environment may lie beside a plug-in.
    return path.is_relative_to(home) and "site-packages" not in path.relative_to(home).parts
