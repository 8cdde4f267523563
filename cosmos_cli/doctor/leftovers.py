"""Checks of what COSMoS runs or left on a machine. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from cosmos_cli.doctor.case import Case
from cosmos_cli.doctor.finding import CheckRemark, Severity

ENVIRONMENTS_KEPT = 4
NAMES_SHOWN_MAX = 3


def living(case: Case) -> Iterator[CheckRemark]:
    """A run that goes on, and processes of one that does not."""
    entries: Sequence[Mapping[str, Any]] = case.part("cosmos").get("living") or ()
    by_run: dict[str, set[str]] = {}
    for entry in entries:
        by_run.setdefault(entry["run"], set()).add(entry["role"])
    # Agents whose supervisor is gone have nobody who would end them; all else ends by itself.
    left = sorted(run for run, roles in by_run.items() if roles == {"agent"})
    alive = sorted(run for run in by_run if run not in left)
    if left:
        yield CheckRemark(
            level=Severity.WARNING,
            found=f"processes of a dead run: {_shown(left)}",
            cure=f"`cosmos down {left[0]}{'' if case.is_here else ' -i INVENTORY'}`",
        )
    if alive:
        yield CheckRemark(
            level=Severity.NOTE,
            found=f"a run goes on, and disturbs what is measured here: {_shown(alive)}",
            cure="`cosmos ps` tells of it, `cosmos down` ends it",
        )
    if not entries:
        yield CheckRemark(found="no run lives there")


def uncollected(case: Case) -> Iterator[CheckRemark]:
    """Records that wait to be collected."""
    names: Sequence[str] = case.part("cosmos").get("runs") or ()
    alive = {
        str(e["run_directory"]).rpartition("/")[2] for e in case.part("cosmos").get("living") or ()
    }
    waiting = [name for name in names if name not in alive]
    # The oldest of very many.
    unnamed = max(0, case.part("cosmos").get("run_count", 0) - len(names))
    count = len(waiting) + unnamed
    if waiting:
        where = "" if case.is_here else " here; `cosmos wipe --uncollected` if nobody wants them"
        yield CheckRemark(
            level=Severity.NOTE,
            found=f"records that were not collected: {_shown(waiting, count)}",
            cure=f"`cosmos collect RUN`{where}",
            figure=float(count),
            unit="run" if count == 1 else "runs",
        )


def environments(case: Case) -> Iterator[CheckRemark]:
    """Check environments that `cosmos up` made there, and those that it left unfinished."""
    told = case.part("cosmos")
    if case.is_here:
        return
    if not told.get("has_root"):
        yield CheckRemark(
            level=Severity.NOTE,
            found="not set up yet: COSMoS's folder is not there",
            cure="`cosmos up`",
        )
        return
    found: Sequence[Mapping[str, Any]] = told.get("environments") or ()
    whole = [item for item in found if item["is_whole"]]
    if len(whole) < len(found):
        yield CheckRemark(
            level=Severity.NOTE,
            found="environments that were not finished",
            cure="`cosmos up` finishes or removes them",
            figure=float(len(found) - len(whole)),
        )
    if len(whole) > ENVIRONMENTS_KEPT:
        yield CheckRemark(
            level=Severity.NOTE,
            found="old environments take room",
            cure="`cosmos up` removes those that nobody uses",
            figure=float(len(whole)),
        )
    elif not whole:
        yield CheckRemark(
            level=Severity.NOTE, found="no environment is ready there", cure="`cosmos up`"
        )
    else:
        yield CheckRemark(found="environments that are ready", figure=float(len(whole)))


def _shown(names: Sequence[str], count: int | None = None) -> str:
    """Return the first of some names, and how many more there are; *count* of all where not all are known."""
    more = (len(names) if count is None else count) - min(len(names), NAMES_SHOWN_MAX)
    return ", ".join(names[:NAMES_SHOWN_MAX]) + (f" and {more} more" if more > 0 else "")
