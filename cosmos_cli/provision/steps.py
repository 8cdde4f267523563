"""
The plan of `cosmos up`: from what a machine is and what it should be, the steps between them, and notes. Pure.

Only what must change is a step. PLANNERS is the order of things: a new kind of step has its place there. On a disk
that has no room for all of it, what nobody uses is pruned first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.target import ROOT_FORBIDDEN
from cosmos_cli.models.machine_facts import NOEXEC_CURE, MachineFacts
from cosmos_cli.provision.desired import DesiredState
from cosmos_cli.provision.device_steps import boot_notes, device_steps
from cosmos_cli.provision.environment import installed_request
from cosmos_cli.provision.inventory_steps import declared_steps, package_step
from cosmos_cli.provision.settings import setting_steps
from cosmos_cli.provision.step import Kind, Step, StepRequest
from cosmos_cli.ui.sizes import size_words
from madns_runtime.plain_values import first_few

RESERVE_BYTES = 16_000_000
"""Bytes that any plan leaves free on a machine's disk: records of a run, and the system's own needs."""
TITLES_SHOWN_MAX = 3
CLOCK_OFFSET_S_MAX = 5.0
THROTTLED_NOW = {0: "its supply voltage is too low", 1: "its clock is capped", 2: "it is throttled"}
"""Bits of a Raspberry Pi's firmware that tell of this moment."""

Planner = Callable[[MachineFacts, DesiredState], Iterator[Step]]


def plan_steps(facts: MachineFacts, desired: DesiredState) -> tuple[Step, ...]:
    """
    Return what must change, in the order in which it is done.

    Raises:
        MachineFailure: Something that is wanted cannot be had on this machine.
    """
    steps = tuple(step for planner in PLANNERS for step in planner(facts, desired))
    if _needed_bytes(steps) <= facts.disk.free_bytes:
        return steps
    # What nobody uses makes room for what is wanted, and goes last only where both find it.
    first = (Kind.DIRECTORY, Kind.PRUNE)
    return tuple(sorted(steps, key=lambda step: (*first, step.kind).index(step.kind)))


def _needed_bytes(steps: tuple[Step, ...]) -> int:
    return sum(step.size_bytes for step in steps) + RESERVE_BYTES


def check_possible(facts: MachineFacts, steps: tuple[Step, ...]) -> None:
    """
    Refuse a plan that would fail midway: no room, no right to write or to run programs, nobody becomes root.

    A disk that takes nothing, or from which nothing is run, is refused where there is nothing to be done, too.

    Raises:
        MachineFailure: DISK_FULL, READ_ONLY, STEP or NO_SUDO; nothing was changed.
    """
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
    if disk.is_noexec:
        raise MachineFailure(
            FailureKind.STEP,
            f"{disk.path} is on a file system that is mounted noexec: no Python package there could be loaded",
            NOEXEC_CURE,
        )
    if not steps:
        return
    needed_bytes = _needed_bytes(steps)
    freeing = [step for step in steps if step.kind is Kind.PRUNE]
    freed_bytes = facts.prunable_bytes if freeing else 0
    only_frees = len(freeing) == len(steps)  # a full disk is a reason for it
    if needed_bytes > disk.free_bytes + freed_bytes and not only_frees:
        also = f", and pruning frees {size_words(freed_bytes)}" if freed_bytes else ""
        raise MachineFailure(
            FailureKind.DISK_FULL,
            f"about {size_words(needed_bytes)} are needed on {disk.path},"
            f" {size_words(disk.free_bytes)} are free{also}",
            "make room there (`cosmos wipe` removes runs that were collected), or move cosmos_root",
        )
    rooted = [step.title for step in steps if step.needs_root]
    if rooted and facts.can_become_root is False:
        shown = first_few(rooted, TITLES_SHOWN_MAX, "; ")
        why, cure = _root_refusal(facts)
        raise MachineFailure(FailureKind.NO_SUDO, f"{why}, which is needed for: {shown}", cure)


def _root_refusal(facts: MachineFacts) -> tuple[str, str]:
    """Return why nobody becomes root there, and what to do."""
    if facts.sudo_refusal == ROOT_FORBIDDEN:
        return ROOT_FORBIDDEN, "take what needs root out of the inventory, or ansible_become: false"
    said = f" ({facts.sudo_refusal})" if facts.sudo_refusal else ""
    return (
        f"{facts.user} cannot become root without a password{said}",
        "let the user run sudo without one (a file in /etc/sudoers.d), or take what needs root"
        " out of the inventory",
    )


def _directories(facts: MachineFacts, desired: DesiredState) -> Iterator[Step]:
    for path in desired.directories:
        kind = facts.file(path).kind
        if kind == "missing":
            request = StepRequest(verb="make_directories", arguments={"paths": [path]})
            yield Step(kind=Kind.DIRECTORY, title=f"directory {path}: make", requests=(request,))
        elif kind != "directory":
            text = f"{path}: expected a folder, got something else"
            raise MachineFailure(
                FailureKind.STEP, text, "remove it there, or choose another cosmos_root"
            )


def _packages(facts: MachineFacts, desired: DesiredState) -> Iterator[Step]:
    yield from package_step(facts, desired.packages, set())


def _declared(facts: MachineFacts, desired: DesiredState) -> Iterator[Step]:
    declared = (*device_steps(facts, desired.needs, desired.paths), *desired.declared)
    yield from declared_steps(facts, declared, desired.packages)


def _environments(facts: MachineFacts, desired: DesiredState) -> Iterator[Step]:
    for environment in desired.distinct_environments:
        if environment.key not in facts.environments:
            yield Step(
                kind=Kind.ENVIRONMENT,
                title=f"environment {environment.key}: build with {len(environment.lock)} packages",
                subject=environment,
                size_bytes=environment.size_bytes(facts.wheels),
            )


def _trees(facts: MachineFacts, desired: DesiredState) -> Iterator[Step]:
    there = set(facts.blobs)
    for tree in desired.trees:
        if tree.hash not in facts.trees:
            sent = {each.sha256: each.size_bytes for each in tree.files if each.sha256 in there}
            there.difference_update(sent)  # moved into this one: of another it is a copy
            yield Step(
                kind=Kind.TREE,
                title=f"tree {tree.label}: send {len(tree.files)} files ({tree.hash[:12]})",
                subject=tree,
                size_bytes=tree.size_bytes - sum(sent.values()),
            )


def _prune(facts: MachineFacts, desired: DesiredState) -> Iterator[Step]:
    if not facts.prunable:
        return
    request = StepRequest(verb="prune_installed", arguments=installed_question(desired))
    yield Step(
        kind=Kind.PRUNE,
        title=f"prune what nobody uses: {', '.join(facts.prunable)}",
        requests=(request,),
    )


def installed_question(desired: DesiredState, *, touch: bool = False) -> dict[str, Any]:
    """Return the arguments of the verbs "installed" and "prune_installed"; *touch* as `installed_request`."""
    return installed_request(
        desired.layout,
        trees=[tree.hash for tree in desired.trees],
        environments=[environment.key for environment in desired.distinct_environments],
        touch=touch,
        is_strict=True,
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


def notes_of(facts: MachineFacts, desired: DesiredState) -> tuple[str, ...]:
    """Return what is worth a word about a machine that is ready all the same, each with what to do."""
    return tuple(
        [
            *_disk_note(facts),
            *_clock_note(facts),
            *_throttled_note(facts),
            *_priority_note(facts, desired),
            *desired.needs.faults,
            *boot_notes(facts, desired.needs, desired.paths),
        ]
    )


def _disk_note(facts: MachineFacts) -> Iterator[str]:
    """Yield a note if what a run records would not find room; a plan that needs more is refused before."""
    disk = facts.disk
    if disk.free_bytes < RESERVE_BYTES:
        yield (
            f"{size_words(disk.free_bytes)} are free on {disk.path}: records of a run will not find room;"
            " make some there (`cosmos wipe` removes runs that were collected), or move cosmos_root"
        )


def _clock_note(facts: MachineFacts) -> Iterator[str]:
    offset_s = facts.clock_offset_s
    if abs(offset_s) > CLOCK_OFFSET_S_MAX:
        side = "ahead of" if offset_s > 0 else "behind"
        yield (
            f"its clock is {_duration_words(abs(offset_s))} {side} this computer's; runs do not mind,"
            " dates of its files and package sources do: let a time service set it"
        )


def _duration_words(seconds: float) -> str:
    for size_s, word in ((86_400, "days"), (3600, "h"), (60, "min")):
        if seconds >= 2 * size_s:
            return f"{seconds / size_s:.0f} {word}"
    return f"{seconds:.0f} s"


def _throttled_note(facts: MachineFacts) -> Iterator[str]:
    found = [words for bit, words in THROTTLED_NOW.items() if (facts.throttled or 0) & (1 << bit)]
    if found:
        yield f"{' and '.join(found)} at this moment; see `cosmos doctor`"


def _priority_note(facts: MachineFacts, desired: DesiredState) -> Iterator[str]:
    """Yield a note if a login is not granted what the inventory asks for; root needs no grant."""
    priority, granted = desired.variables.cosmos_realtime_priority, facts.realtime_priority_max
    if priority is not None and facts.uid != 0 and granted is not None and granted < priority:
        yield f"a login is granted real-time priority {granted}, not {priority}: {_priority_cause(facts)}"


def _priority_cause(facts: MachineFacts) -> str:
    """Say why a login is not granted what its limits file says, and what to do about it."""
    if facts.uses_pam is False:
        return (
            "its SSH server does not read /etc/security/limits.d; set `UsePAM yes` in"
            " /etc/ssh/sshd_config there"
        )
    if facts.uses_pam:
        return (
            "its SSH server uses PAM (`UsePAM yes`), so perhaps pam_limits is missing in"
            " /etc/pam.d/sshd there, or a later file of /etc/security/limits.d says less"
        )
    return (
        "perhaps its SSH server does not read /etc/security/limits.d; see whether"
        " /etc/ssh/sshd_config there says `UsePAM yes`, and /etc/pam.d/sshd names pam_limits"
    )
