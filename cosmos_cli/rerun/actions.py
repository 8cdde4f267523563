"""Actions that took place in one of two runs alone: those ordered live, and those of conditions that were met in one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Final

import orjson

from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.report.timeline import ActionTold, read_actions
from cosmos_cli.rerun.carried_over import is_stand_in
from cosmos_cli.ui.foreign_text import clean_line
from cosmos_cli.ui.plural import counted
from madns_runtime.plain_values import first_few
from madns_runtime.timeline.kinds import DEVICE_FAULT, STOP

SHOWN_MAX: Final = 5
ENDS_OR_PLAYED: Final = (DEVICE_FAULT.word, STOP.word)
"""Words of what a rerun has otherwise, and has told."""


def action_remarks(
    recorded: RunDirectory, rerun: RunDirectory, left_out: Sequence[str] = ()
) -> tuple[str, ...]:
    """
    Say which actions took place on record alone, and which in the rerun alone; one that was refused did not take place.

    Args:
        recorded: The run.
        rerun: The same, flown again.
        left_out: Words of actions that were not carried over, and told so.
    """
    skipped = {*ENDS_OR_PLAYED, *left_out}
    before, after = (
        [
            each
            for each in read_actions(run)
            if each.word not in skipped
            and not each.refusal
            and not is_stand_in(each.word, each.parameters)
        ]
        for run in (recorded, rerun)
    )
    found = ((_alone(before, after), "on record"), (_alone(after, before), "in the rerun"))
    return tuple(_told(alone, where) for alone, where in found if alone)


def _alone(ours: Sequence[ActionTold], theirs: Sequence[ActionTold]) -> list[ActionTold]:
    left = Counter(map(_key, theirs))
    alone = []
    for each in ours:
        if left[_key(each)]:
            left[_key(each)] -= 1
        else:
            alone.append(each)
    return alone


def _key(action: ActionTold) -> tuple[str, tuple[str, ...], bytes]:
    parameters = orjson.dumps(dict(action.parameters), option=orjson.OPT_SORT_KEYS)
    return action.word, tuple(map(str, action.agents)), parameters


def _told(alone: Sequence[ActionTold], where: str) -> str:
    lines = [
        clean_line(f"{each.what} {each.whom}".rstrip() + f" at {each.begin_s:g} s")
        for each in alone
    ]
    why = ", ordered live or by a condition" if where == "on record" else ""
    shown = first_few(lines, SHOWN_MAX, "; ")
    return f"{counted(len(alone), 'action')} only {where}{why}: {shown}"
