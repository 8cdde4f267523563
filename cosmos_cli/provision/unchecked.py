"""
Content on a machine that no check has passed since `cosmos up` worked there. Pure.

A check is costly, so an `up` that finds nothing to change only looks. What it installs is therefore noted there before it
is installed, and struck out once its check has passed: a machine whose check failed, or was cut off, is checked again
by the next `up`, and not taken for ready because nothing is left to be done.
"""

from __future__ import annotations

from collections.abc import Iterable

from cosmos_cli.models.machine_facts import MachineFacts
from cosmos_cli.provision.desired import DesiredState
from cosmos_cli.provision.step import StepRequest

NAMES_MAX = 64
"""The newest count; what was left unchecked for so many changes was pruned long ago."""


def unchecked_content(facts: MachineFacts, desired: DesiredState) -> tuple[str, ...]:
    """Return the names of trees and environments that are noted there as unchecked, the newest last."""
    noted = (facts.file(desired.unchecked_path).text or "").split()
    return tuple(name for name in noted if name.isascii())[-NAMES_MAX:]


def needs_check(facts: MachineFacts, desired: DesiredState) -> bool:
    """Return whether anything that is wanted there was never seen to work."""
    return not _names(desired).isdisjoint(unchecked_content(facts, desired))


def note_unchecked(facts: MachineFacts, desired: DesiredState) -> StepRequest:
    """Return the request that notes all that is wanted there as unchecked."""
    names = _names(desired)
    others = [name for name in unchecked_content(facts, desired) if name not in names]
    return _write(desired, [*others, *sorted(names)][-NAMES_MAX:])


def strike_out(facts: MachineFacts, desired: DesiredState) -> StepRequest:
    """Return the request that strikes out what is wanted there: it was seen to work."""
    names = _names(desired)
    others = [name for name in unchecked_content(facts, desired) if name not in names]
    if others:
        return _write(desired, others)
    return StepRequest(verb="remove_file", arguments={"path": desired.unchecked_path})


def _names(desired: DesiredState) -> set[str]:
    environments = {environment.key for environment in desired.environments}
    return environments | {tree.hash for tree in desired.trees}


def _write(desired: DesiredState, names: Iterable[str]) -> StepRequest:
    return StepRequest(
        verb="write_file",
        arguments={"path": desired.unchecked_path, "mode": 0o644},
        body="".join(f"{name}\n" for name in names).encode(),
    )
