"""
The plan of `cosmos up`: from what a machine is and what it should be, the steps between them. Pure.

Only what must change is a step. PLANNERS is the order of things: a new kind of step has its place there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.provision.declared import declared_steps
from cosmos_cli.provision.environment import installed_request
from cosmos_cli.provision.facts import Facts
from cosmos_cli.provision.packages import package_step
from cosmos_cli.provision.settings import setting_steps
from cosmos_cli.provision.step import Kind, Request, Step
from cosmos_cli.provision.wanted import Wanted

RESERVE_BYTES = 16_000_000
"""Left free on a machine's disk by any plan: records of a run, and the system's own needs."""
TITLES_SHOWN_MAX = 3

Planner = Callable[[Facts, Wanted], Iterator[Step]]


def plan_steps(facts: Facts, wanted: Wanted) -> tuple[Step, ...]:
    """
    Return what must change, in the order in which it is done.

    Raises:
        MachineFailure: Something that is wanted cannot be had on this machine.
    """
    return tuple(step for planner in PLANNERS for step in planner(facts, wanted))


def check_possible(facts: Facts, steps: tuple[Step, ...]) -> None:
    """
    Refuse a plan that would fail midway: no room, no right to write, nobody becomes root.

    Raises:
        MachineFailure: DISK_FULL, READ_ONLY, STEP or NO_SUDO; nothing was changed.
    """
    if not steps:
        return
    disk = facts.disk
    if disk.is_read_only:
        raise MachineFailure(
            FailureKind.READ_ONLY,
            f"{disk.path} is on a file system that is mounted read-only",
            "check the card or disk there (a worn SD card turns read-only), then restart it",
        )
    if not disk.is_writable:
        raise MachineFailure(
            FailureKind.STEP,
            f"{facts.user} may not write in {disk.path}",
            "choose another cosmos_root, or make that folder and give it to the user",
        )
    needed_bytes = sum(step.size_bytes for step in steps) + RESERVE_BYTES
    if needed_bytes > disk.free_bytes:
        raise MachineFailure(
            FailureKind.DISK_FULL,
            f"about {megabytes(needed_bytes)} are needed on {disk.path},"
            f" {megabytes(disk.free_bytes)} are free",
            "make room there (`cosmos wipe` removes runs that were collected), or move cosmos_root",
        )
    rooted = [step.title for step in steps if step.needs_root]
    if rooted and facts.can_become_root is False:
        shown = "; ".join(rooted[:TITLES_SHOWN_MAX])
        more = len(rooted) - TITLES_SHOWN_MAX
        raise MachineFailure(
            FailureKind.NO_SUDO,
            f"{facts.user} cannot become root without a password, which is needed for: {shown}"
            + (f"; and {more} more" if more > 0 else ""),
            "let the user run sudo without one (a file in /etc/sudoers.d), or take what needs root"
            " out of the inventory",
        )


def megabytes(size_bytes: int) -> str:
    """Return a size such as 214 MB."""
    return f"{size_bytes / 1e6:.0f} MB"


def _directories(facts: Facts, wanted: Wanted) -> Iterator[Step]:
    for path in wanted.directories:
        kind = facts.file(path).kind
        if kind == "missing":
            request = Request(verb="make_directories", arguments={"paths": [path]})
            yield Step(kind=Kind.DIRECTORY, title=f"directory {path}: make", requests=(request,))
        elif kind != "directory":
            text = f"{path}: expected a folder, got something else"
            raise MachineFailure(
                FailureKind.STEP, text, "remove it there, or choose another cosmos_root"
            )


def _packages(facts: Facts, wanted: Wanted) -> Iterator[Step]:
    yield from package_step(facts, wanted.packages, set())


def _declared(facts: Facts, wanted: Wanted) -> Iterator[Step]:
    yield from declared_steps(facts, wanted.declared, wanted.packages)


def _environments(facts: Facts, wanted: Wanted) -> Iterator[Step]:
    for environment in wanted.distinct_environments:
        if environment.key not in facts.environments:
            yield Step(
                kind=Kind.ENVIRONMENT,
                title=f"environment {environment.key}: build with {len(environment.lock)} packages",
                subject=environment,
                size_bytes=environment.size_bytes,
            )


def _trees(facts: Facts, wanted: Wanted) -> Iterator[Step]:
    for tree in wanted.trees:
        if tree.hash not in facts.trees:
            yield Step(
                kind=Kind.TREE,
                title=f"tree {tree.label}: send {len(tree.files)} files ({tree.hash[:12]})",
                subject=tree,
                size_bytes=tree.size_bytes,
            )


def _prune(facts: Facts, wanted: Wanted) -> Iterator[Step]:
    if not facts.prunable:
        return
    request = Request(verb="prune_installed", arguments=installed_question(wanted))
    yield Step(
        kind=Kind.PRUNE,
        title=f"prune what nobody uses: {', '.join(facts.prunable)}",
        requests=(request,),
    )


def installed_question(wanted: Wanted, *, touch: bool = False) -> dict[str, Any]:
    """Return the arguments of the verbs "installed" and "prune_installed"; *touch* as `installed_request`."""
    return installed_request(
        wanted.layout,
        trees=[tree.hash for tree in wanted.trees],
        environments=[environment.key for environment in wanted.distinct_environments],
        touch=touch,
    )


PLANNERS: tuple[Planner, ...] = (
    _directories,
    _packages,
    setting_steps,
    _declared,
    _environments,
    _trees,
    _prune,
)
