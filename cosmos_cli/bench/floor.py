"""The floor of machines: lateness of a bare loop's wake-ups and round trips of bare datagrams, as asked there and shown here."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

from cosmos_cli.doctor.probe import Responder
from cosmos_cli.fleet.connection import NO_ADDRESS, NO_ADDRESS_CURE, Connection
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.liveness import SilenceWatch
from cosmos_cli.models.inventory import Machine
from cosmos_cli.ui.console import Column
from madns_runtime.config import Scheduling

PARTS = ("files", "links", "dpkg", "facts", "udp_probe", "timing_floor")
RATES_HZ: Final = (100.0, 1000.0)
LINK_RATE_HZ: Final = 100.0
"""Over the network: the answers of this computer's one responder to all machines are not to be what is measured."""
TIMEOUT_S = 30.0
"""For an answer, beside the time of the measurement."""
FIGURES = ("p50", "p99", "p999", "max")
Policy = Literal["normal", "fifo"]
POLICIES: tuple[Policy, ...] = ("normal", "fifo")
POLICY_WORDS: Mapping[Policy, str] = {"normal": "normal", "fifo": "SCHED_FIFO"}
KERNEL_WORDS: Mapping[bool | None, str] = {True: "PREEMPT_RT", False: "ordinary", None: ""}
"""Words for whether a machine's kernel is PREEMPT_RT; None where that is not known."""
COLUMNS = (
    Column("machine"),
    Column("kernel"),
    Column("way"),
    Column("Hz", is_number=True),
    Column("scheduling"),
    *(Column(f"late {name} us", is_number=True) for name in ("p50", "p99", "p99.9", "max")),
    Column("missed", is_number=True),
    *(Column(f"trip {name} us", is_number=True) for name in ("p50", "p99", "p99.9", "max")),
    Column("lost", is_number=True),
)

Told = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class FloorQuestion:
    """One measurement."""

    way: Literal["loopback", "network"]
    """From where datagrams come back: the same machine, or this computer."""
    rate_hz: float
    policy: Policy


def questions(*, has_network: bool) -> list[FloorQuestion]:
    """Return all measurements of a machine, in their order."""
    found = [
        FloorQuestion(way="loopback", rate_hz=rate_hz, policy=policy)
        for rate_hz, policy in itertools.product(RATES_HZ, POLICIES)
    ]
    if has_network:
        found += [
            FloorQuestion(way="network", rate_hz=LINK_RATE_HZ, policy=policy) for policy in POLICIES
        ]
    return found


def measure_floor(
    connection: Connection,
    seconds: float,
    *,
    responder: Responder | None = None,
    machine: Machine | None = None,
    say: Callable[[str], None],
) -> list[Told]:
    """
    Measure one machine.

    Args:
        connection: To the machine.
        seconds: Length of each measurement.
        responder: Answers datagrams of the network; None to leave these out.
        machine: Its entry in the inventory, if it has one.
        say: Told of each measurement that begins.

    Returns:
        One mapping per measurement: way, rate_hz, policy, and what the machine told.

    Raises:
        MachineFailure: It cannot be asked.
    """
    found: list[Told] = []
    with Helper.start(connection, PARTS, watch=SilenceWatch(connection)) as helper:
        for question in questions(has_network=responder is not None):
            words = f"{question.way} at {question.rate_hz:g} Hz, {POLICY_WORDS[question.policy]}"
            count = max(1, round(seconds * question.rate_hz))
            link = None
            if responder is not None and question.way == "network":
                link = responder.question(connection, machine, count)
                if link is None:
                    say(f"{connection.target.name}: {words}: not measured: {NO_ADDRESS}")
                    found.append(_told_of(question, _not_measured(found)))
                    continue
            say(f"{connection.target.name}: {words}")
            arguments = {
                "count": count,
                "rate_hz": question.rate_hz,
                "policy": question.policy,
                "priority": Scheduling().priority,
                "link": link,
            }
            told = helper.call("timing_floor", arguments, timeout_s=seconds + TIMEOUT_S).value
            found.append(_told_of(question, told))
    return found


def _told_of(question: FloorQuestion, told: Mapping[str, Any]) -> Told:
    return {
        "way": question.way,
        "rate_hz": question.rate_hz,
        "policy": question.policy,
        **told,
    }


def _not_measured(others: Sequence[Told]) -> Told:
    """Return what stands for a measurement over the network of a machine whose way to this computer is not known."""
    return {
        "refusal": None,
        **dict.fromkeys(("due", "missed", "sent", "answered"), 0),
        **dict.fromkeys(("lateness_us", "round_trip_us")),
        "error": f"{NO_ADDRESS}: {NO_ADDRESS_CURE}",
        "is_preempt_rt": others[0]["is_preempt_rt"] if others else None,
    }


def rows_of(machine: str, measured: Sequence[Told]) -> Iterator[tuple[str, ...]]:
    """Yield one row of the table per measurement."""
    for told in measured:
        late, trip = told["lateness_us"], told["round_trip_us"]
        policy = POLICY_WORDS[told["policy"]]
        words = f"{policy}: {told['refusal'] or told['error']}" if late is None else policy
        yield (
            machine,
            KERNEL_WORDS[told["is_preempt_rt"]],
            told["way"],
            f"{told['rate_hz']:g}",
            words,
            *_figures(late),
            "" if late is None else str(told["missed"]),
            *_figures(trip),
            "" if late is None else str(told["sent"] - told["answered"]),
        )


def _figures(told: Mapping[str, float] | None) -> list[str]:
    return [""] * len(FIGURES) if told is None else [f"{told[name]:.0f}" for name in FIGURES]
