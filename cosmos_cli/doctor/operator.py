"""Checks of this computer alone, from which machines are reached and where the host of a run works. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from cosmos_cli.doctor.case import Case
from cosmos_cli.doctor.finding import CheckRemark, Severity
from cosmos_cli.ui.plural import counted

FILES_AT_REST = 64
FILES_A_MACHINE = 10
"""Socket, the pipes of its programs, and what is being written for it."""
FILES_AN_AGENT = 4


def open_files(case: Case) -> Iterator[CheckRemark]:
    """Every machine and every agent here takes some descriptors."""
    limit = case.part("here").get("open_files")
    if limit is None:
        return
    needed = FILES_AT_REST + FILES_A_MACHINE * case.wants.machines + FILES_AN_AGENT * case.agents
    is_small = limit < needed
    yield CheckRemark(
        level=Severity.ERROR if is_small else Severity.OK,
        found=f"open files: {limit} at most" + (f", expected {needed}" if is_small else ""),
        cure=f"ulimit -n {max(4096, needed)}" if is_small else "",
    )


def devices(case: Case) -> Iterator[CheckRemark]:
    """All that devices need, of this computer and of machines, as the inventory lists them, is there."""
    for item in case.part("here").get("devices") or case.told.get("devices") or ():
        for missing in item["missing"]:
            yield CheckRemark(
                level=Severity.ERROR,
                found=f"{item['device']}: {missing['found']}",
                cure=missing["cure"],
            )
        if not item["missing"]:
            yield CheckRemark(found=f"{item['device']}: all that it needs is there")


def ssh_agent(case: Case) -> Iterator[CheckRemark]:
    """Keys with a passphrase need somebody who holds them."""
    told = case.part("here").get("ssh_agent")
    if told is None or not case.wants.machines:
        return
    if not told["socket"]:
        yield CheckRemark(
            level=Severity.NOTE,
            found="no ssh agent: keys with a passphrase cannot be used",
            cure='eval "$(ssh-agent)" && ssh-add',
        )
    elif told["keys"] is None:
        yield CheckRemark(
            level=Severity.WARNING,
            found=f"nobody answers at SSH_AUTH_SOCK ({told['socket']})",
            cure='log in anew, or: eval "$(ssh-agent)" && ssh-add',
        )
    else:
        yield CheckRemark(found="keys in the ssh agent", figure=float(told["keys"]))


def ssh_files(case: Case) -> Iterator[CheckRemark]:
    """Check permission to write there: it decides which machines are believed."""
    problems: list[Mapping[str, Any]] = case.part("here").get("ssh_files") or []
    for item in problems:
        yield CheckRemark(level=Severity.WARNING, found=item["found"], cure=item["cure"])


def uv(case: Case) -> Iterator[CheckRemark]:
    """`cosmos up` resolves and installs with it."""
    here = case.part("here")
    if "uv" not in here or not case.wants.machines:
        return
    if here["uv"]:
        yield CheckRemark(found="uv is installed")
    else:
        yield CheckRemark(
            level=Severity.WARNING,
            found="uv is not installed: `cosmos up` cannot prepare environments for machines",
            cure="pip install 'cosmos-madns[host]'",
        )


def container(case: Case) -> Iterator[CheckRemark]:
    """Check for a container: its limits are decided outside of it."""
    if not case.part("limits").get("is_container"):
        return
    as_root = " as root" if case.facts.uid == 0 else ""
    yield CheckRemark(
        level=Severity.NOTE,
        found=f"works{as_root} in a container: limits, clock and network are its host's to give"
        + ("; what is written belongs to root" if as_root else ""),
        cure="--cap-add SYS_NICE --cap-add IPC_LOCK --network host when it is started, if anything is refused",
    )


def cut_off(case: Case) -> Iterator[CheckRemark]:
    """Runs that were cut off, or ran detached, and are not collected."""
    names: list[str] = case.part("here").get("cut_off") or []
    if names:
        yield CheckRemark(
            level=Severity.NOTE,
            found=f"runs that were cut off, or ran detached, and are not collected: {', '.join(names)}",
            cure=f"`cosmos collect {names[-1].partition('-')[0].lstrip('0')}`",
        )


def feasibility(case: Case) -> Iterator[CheckRemark]:
    """The four inequalities of real time, with the network as it was measured, and what is predicted besides."""
    told = case.part("here").get("feasibility")
    if not told:
        return
    broken = [item for item in told["inequalities"] if not item["holds"]]
    for item in broken:
        limit = item["breaks_at_agents"]
        yield CheckRemark(
            level=Severity.ERROR,
            found=f"{counted(told['agents'], 'agent')} cannot keep real time: inequality {item['equation']} is broken"
            f" ({item['name']}: {item['left']:.4g} {item['relation']} {item['right']:.4g} {item['unit']})",
            cure="`cosmos plan` shows all four"
            + (f"; fewer than {limit:g} agents keep it" if limit and limit > 1 else ""),
        )
    if broken:
        return
    agents = counted(told["agents"], "agent")
    capacity = case.part("here").get("capacity")
    if capacity and capacity["agents"] is not None and told["agents"] > capacity["agents"]:
        yield CheckRemark(
            level=Severity.WARNING,
            found=f"{agents} may not keep real time: the four inequalities hold, but up to {capacity['agents']:g} are"
            f" predicted, by {capacity['binding']}",
            cure="`cosmos plan` shows all limits, `cosmos bench capacity` measures",
        )
    else:
        yield CheckRemark(found=f"{agents} can keep real time (the four inequalities hold)")
