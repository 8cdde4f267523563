"""What the operator is asked to start, and what it hands back: plain values."""

from __future__ import annotations

import dataclasses
import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Literal, Protocol

from cosmos_cli.launch.deadlines import MANUAL_READY_S
from cosmos_cli.launch.events import AgentChanged, Listening, Progress
from cosmos_cli.launch.places import Place, config_at
from cosmos_cli.problem import Problem
from madns_runtime.config import AgentLaunch, HostLaunch, RunConfig, to_mapping

RUN_KEY_BYTES = 32
SESSION_BYTES = 8


def make_session() -> str:
    """Return what tells this run from all others on the wire and on machines; it is no secret."""
    return secrets.token_hex(SESSION_BYTES)


@dataclass(frozen=True, slots=True, kw_only=True)
class Life:
    """Which of a machine's supervisors one is: a machine that was lost may return and get another."""

    number: int = 1
    incarnations: Mapping[str, int] = field(default_factory=dict)
    """The number of an agent's first process of this life; 1 where none is named."""


FIRST_LIFE = Life()


@dataclass(frozen=True, slots=True, kw_only=True)
class LaunchRequest:
    """One run, on this computer and on others."""

    config: RunConfig
    directory: Path
    """The run directory; it exists."""
    machines: Mapping[str, tuple[str, ...]]
    """Each machine's agents."""
    places: Mapping[str, Place] = field(default_factory=dict)
    """What is different on which machine; one that is not named is this computer."""
    host_machine: str | None = None
    """Who runs the host; None for this computer."""
    manual: tuple[str, ...] = ()
    """Agents that a person starts by hand; they are in nobody's list of *machines*' children."""
    is_detached: bool = False
    """Once it runs, the run goes on without its operator."""
    nice: int = 0
    """How much the operator steps back behind its children once they are started."""
    run_key_hex: str = field(default_factory=lambda: secrets.token_hex(RUN_KEY_BYTES), repr=False)
    session_hex: str = field(default_factory=make_session)

    def place_of(self, machine: str | None) -> Place:
        """Return where a machine's part of the run lives."""
        here = Place(directory=str(self.directory))
        return here if machine is None else self.places.get(machine, here)

    def host_launch(self) -> dict[str, Any]:
        """Return the host's launch line; it holds the run key."""
        place = self.place_of(self.host_machine)
        launch = HostLaunch(
            config=config_at(self.config, place),
            run_key_hex=self.run_key_hex,
            session_hex=self.session_hex,
            directory=str(PurePosixPath(place.directory, "host")),
            is_detached=self.is_detached,
        )
        return to_mapping(launch)

    def agent_launch(
        self,
        machine: str,
        agents: tuple[str, ...],
        listening: Listening,
        life: Life = FIRST_LIFE,
    ) -> dict[str, Any]:
        """
        Return the launch line of a supervisor; it holds the run key.

        Args:
            machine: Where.
            agents: Whom it runs.
            listening: Where the host listens.
            life: Which of that machine's supervisors it is.
        """
        place = self.place_of(machine)
        launch = AgentLaunch(
            config=config_at(self.config, place),
            run_key_hex=self.run_key_hex,
            session_hex=self.session_hex,
            machine=machine,
            agents=agents,
            host_address=place.host_address or listening.address,
            host_port=listening.port,
            directory=place.directory,
            is_detached=self.is_detached,
            life=life.number,
            first_incarnations=life.incarnations,
        )
        return to_mapping(launch)


@dataclass(frozen=True, slots=True, kw_only=True)
class LaunchOutcome:
    """How it ended, for the collector to judge."""

    host_result: Mapping[str, Any] | None
    """What the host said at its end; None if it could not."""
    interruption: Literal["no", "clean", "at once"] = "no"
    problems: tuple[Problem, ...] = ()
    """What did not go as it should, each a sentence that names who and why."""
    leftovers: tuple[int, ...] = ()
    """Processes that even SIGKILL did not end."""
    is_detached: bool = False
    """It has not ended: it goes on without its operator."""


class View(Protocol):
    """Where the operator's talk goes."""

    def say(self, text: str, level: str = "info") -> None:
        """Show a sentence."""

    def state(self, state: str) -> None:
        """The host is in another state."""

    def agent(self, change: AgentChanged) -> None:
        """An agent has come further."""

    def progress(self, progress: Progress) -> None:
        """Show how the run fares."""

    def work(self, what: str, share: float) -> None:
        """Show what is done with the records after the run, and how far it is, 0 to 1."""

    def close(self) -> None:
        """Leave the terminal as it was; harmless when repeated."""


def with_manual_agents(config: RunConfig, manual: tuple[str, ...]) -> RunConfig:
    """Return *config* with time enough to start agents by hand."""
    if not manual or config.timeouts.agents_ready_s >= MANUAL_READY_S:
        return config
    timeouts = dataclasses.replace(config.timeouts, agents_ready_s=MANUAL_READY_S)
    return dataclasses.replace(config, timeouts=timeouts)
