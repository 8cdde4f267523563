"""
Records of a device and of its playback: the same values and ages to the microsecond, and the same outputs.

Samples that no tick could find, after the last one, are counted and not compared. Frames are compared in their order,
values of an output by the times at which they were due, or in their order where those are the ticks' own. What a driver
refused, and the safe value of a profile that had run out, a recording neither refuses nor gives: by the device's events
these are counted and not compared.
"""

from __future__ import annotations

import re
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any, Final

from cosmos_cli.rerun.recorded_run import FlownRun, RecordedAgent, UsedDevice
from madns_runtime.hardware.contract import Channel
from madns_runtime.hardware.kinds.playback import HEAD, OUTPUT_HEAD, streams_of
from madns_runtime.plain_values import is_real
from madns_runtime.recording.reader import read_stream
from madns_runtime.recording.records import EVENTS
from madns_runtime.recording.stream_file import files_of

SAME_TIME_S: Final = 1.5e-6
"""Times are recorded in whole microseconds."""
SAME_DUE_S: Final = 2e-4
"""Times at which values were due are by the clock of the device's process in real time, which agrees with the agent's so far."""
SAME_AGE_US: Final = 1
REFUSED_WITHIN_S: Final = 1.0
"""A driver refuses what was due so long before at most."""
Row = Sequence[Any]
Pair = tuple[Row | None, Row | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class FirstDifference:
    """The first record that differs, as it is told."""

    t_s: float
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelComparison:
    """One channel of one device in both runs."""

    name: str
    """Device and channel, such as pi22/imu.gyro."""
    agent: str
    direction: str
    records: int
    """On record that were to be played, or put out."""
    compared: int
    different: int
    """Compared records that differ, and those that only one run has."""
    left_out: int
    """Records after the agent's last tick, and outputs of after it, or that were refused, or safe: no rerun has them."""
    in_ticks: int
    """Samples that came while a tick was under way: it may have found them, or the next one did as in the rerun."""
    first: FirstDifference | None = None

    @property
    def is_same(self) -> bool:
        """Whether nothing differs."""
        return not self.different


def compare_devices(
    recorded: FlownRun, rerun: Path, ends: Collection[str]
) -> list[ChannelComparison]:
    """
    Compare the records of all devices with those of their playback.

    Args:
        recorded: The run.
        rerun: Directory of the rerun.
        ends: Agents that ended before others: what the rerun has of their devices after that is left out.

    Raises:
        MachineError: A stream cannot be read.
    """
    found = []
    for used in recorded.devices:
        played = rerun / "devices" / used.agent / used.name
        for channel, _ in streams_of(used.folder):
            if channel.direction == "out" and not used.may_write:
                continue
            found.append(_compare(recorded, used, channel, played, is_early=used.agent in ends))
    return found


def _compare(
    recorded: FlownRun, used: UsedDevice, channel: Channel, played: Path, *, is_early: bool
) -> ChannelComparison:
    """Compare one channel with what is in the folder of its device in the rerun."""
    a, b = _rows(used.folder, channel.name), _rows(played, channel.name)
    agent = recorded.agents[used.agent]
    if channel.direction == "in":
        kept = [row for row in a if None not in row[len(HEAD) :]]
        seen = [row for row in kept if row[0] + row[2] * 1e-6 <= agent.last_wake_s + SAME_TIME_S]
        if agent.ticks is None:  # a fault behind the last tick has lockstep's devices go on to it
            b = [row for row in b if row[0] + row[2] * 1e-6 <= agent.last_s + SAME_TIME_S]
        pairs: list[Pair] = _in_order(seen, b)
        is_same, left_out = _is_same_input, len(kept) - len(seen)
    else:
        # Before time zero only lockstep records what is put out.
        a, b = ([row for row in rows if row[0] >= 0.0] for rows in (a, b))
        refused_s, safe_s, fault_s = _told_times(used.folder, channel)
        in_time = sum(row[0] <= agent.last_s for row in a)
        kept_b = _without_refused(a[:in_time], b, refused_s) if channel.is_frame else b
        pairs = _in_order(a, kept_b) if channel.is_frame else _by_time(a, b)
        explained = _leave_out_explained(pairs, refused_s, safe_s) + len(b) - len(kept_b)
        # What was put out after the last step of lockstep has no partner, at the end.
        whole = len(pairs)
        has_gone_on = agent.ticks is None and max(fault_s, default=0.0) > agent.last_s
        while pairs and _is_of_end(pairs[-1], agent.last_s, has_gone_on=has_gone_on):
            pairs.pop()
        is_same, left_out = _is_same_output, whole - len(pairs) + explained
    if is_early:
        _leave_out_after(pairs, agent, is_input=channel.direction == "in")
    differing = [pair for pair in pairs if None in pair or not is_same(*pair)]
    return ChannelComparison(
        name=f"{used.full_name}.{channel.name}",
        agent=used.agent,
        direction=channel.direction,
        records=len(a),
        compared=len(pairs),
        different=len(differing),
        left_out=left_out,
        in_ticks=_count_in_ticks(agent, a) if channel.direction == "in" else 0,
        first=_told(differing[0], channel) if differing else None,
    )


def _is_of_end(pair: Pair, last_s: float, *, has_gone_on: bool) -> bool:
    """
    Tell whether a value on record alone was put out after the last step of lockstep.

    Where a fault behind that step had the device go on, what the step itself wrote was put out, too.
    """
    row, of_rerun = pair
    if row is None or of_rerun is not None:
        return False
    if has_gone_on:
        return bool(row[0] + row[1] * 1e-6 > last_s - SAME_TIME_S)
    return bool(row[0] > last_s)


def _told_times(folder: Path, channel: Channel) -> tuple[list[float], list[float], list[float]]:
    """Return when a device's events tell that an output refused values, that its profile had run out, and of faults, s."""
    refused = re.compile(rf"(?:[^\s:]+: )?{re.escape(channel.name)}: ")
    times: tuple[list[float], list[float], list[float]] = ([], [], [])
    for event in _rows(folder, EVENTS.name):
        told: Mapping[str, Any] = event if isinstance(event, Mapping) else {}
        t_s = told.get("t_s")
        if not is_real(t_s):
            continue
        if told.get("event") == "refused" and refused.match(str(told.get("why"))):
            times[0].append(t_s)
        elif told.get("event") == "underrun" and told.get("channel") == channel.name:
            times[1].append(t_s)
        elif told.get("event") == "fault":
            times[2].append(t_s)
    return times


def _without_refused(a: Sequence[Row], b: Sequence[Row], refused_s: Sequence[float]) -> list[Row]:
    """
    Return the frames of the rerun without those that the recorded device refused.

    Of several that were due at one time the first one goes that is not what is on record in its place.
    """
    kept = list(b)
    for at_s in sorted(refused_s):
        if len(kept) <= len(a):
            break
        last = bisect_right(kept, at_s + SAME_DUE_S, key=itemgetter(0)) - 1
        if last < 0 or not _is_refused(kept[last], at_s):
            continue
        first = bisect_left(kept, kept[last][0] - SAME_DUE_S, key=itemgetter(0))
        others = (
            place
            for place in range(first, last + 1)
            if place >= len(a) or not _is_same_output(a[place], kept[place])
        )
        del kept[next(others, last)]
    return kept


def _is_refused(row: Row, at_s: float) -> bool:
    """Tell whether a value may be that which was refused at some time."""
    return bool(-SAME_DUE_S <= at_s - row[0] <= REFUSED_WITHIN_S)


def _is_safe(row: Row, at_s: float) -> bool:
    """Tell whether a value may be the safe one of a profile that had run out at some time: it is put out right then."""
    done_s = row[0] + row[1] * 1e-6
    return bool(row[0] - SAME_DUE_S <= at_s <= done_s + 2.0 * SAME_TIME_S)


def _leave_out_explained(
    pairs: list[Pair], refused_s: Sequence[float], safe_s: Sequence[float]
) -> int:
    """Leave out what one run alone has, by the recorded device's events; return how many."""
    ways: tuple[tuple[int, Sequence[float], Callable[[Row, float], bool]], ...] = (
        (0, safe_s, _is_safe),
        (1, refused_s, _is_refused),
    )
    gone: set[int] = set()
    for side, times_s, fits in ways:
        alone = {
            place: row
            for place, pair in enumerate(pairs if times_s else ())
            if pair[1 - side] is None and (row := pair[side]) is not None
        }
        for at_s in times_s:
            fitting = [place for place, row in alone.items() if fits(row, at_s)]
            if fitting:
                place = max(fitting, key=lambda each: alone[each][0])
                gone.add(place)
                del alone[place]
    pairs[:] = [pair for place, pair in enumerate(pairs) if place not in gone]
    return len(gone)


def _leave_out_after(pairs: list[Pair], agent: RecordedAgent, *, is_input: bool) -> None:
    """Leave out the last rows that the rerun alone has, of after an agent's last tick on record."""
    while pairs and pairs[-1][0] is None and (row := pairs[-1][1]) is not None:
        handed_s = row[0] + row[2] * 1e-6 if is_input else row[0]
        if handed_s <= (agent.last_wake_s if is_input else agent.last_s) + SAME_TIME_S:
            return
        pairs.pop()


def _count_in_ticks(agent: RecordedAgent, rows: Sequence[Row]) -> int:
    """Count the samples of which the record does not tell whether the tick then under way found them."""
    woke_s = [woke_s for woke_s, _ in agent.under_way]
    count = 0
    for row in rows:
        handed_s = row[0] + row[2] * 1e-6
        place = bisect_left(woke_s, handed_s) - 1
        count += place >= 0 and handed_s <= agent.under_way[place][1]
    return count


def _rows(folder: Path, stream: str) -> list[Row]:
    """Return the records of a stream, those of all processes that the device had."""
    return [row for path in files_of(folder, stream) for row in read_stream(path).records()]


def _in_order(a: Sequence[Row], b: Sequence[Row]) -> list[Pair]:
    longest = max(len(a), len(b))
    return [
        (a[place] if place < len(a) else None, b[place] if place < len(b) else None)
        for place in range(longest)
    ]


def _by_time(a: Sequence[Row], b: Sequence[Row]) -> list[Pair]:
    """
    Pair what was due at the same time, as far as clocks agree, several of one time in their order.

    In their order all that mostly was not: then each tick wrote in its own time.
    """
    pairs: list[Pair] = []
    left, right = (deque(sorted(rows, key=itemgetter(0))) for rows in (a, b))
    while left and right:
        later_s = left[0][0] - right[0][0]
        row = left.popleft() if later_s <= SAME_DUE_S else None
        pairs.append((row, right.popleft() if later_s >= -SAME_DUE_S else None))
    if sum(None not in pair for pair in pairs) * 2 < min(len(a), len(b)):
        return _in_order(a, b)
    return [*pairs, *((row, None) for row in left), *((None, row) for row in right)]


def _is_same_input(a: Any, b: Any) -> bool:
    has_same_time = abs(a[0] - b[0]) <= SAME_TIME_S and abs(a[2] - b[2]) <= SAME_AGE_US
    return has_same_time and list(a[len(HEAD) :]) == list(b[len(HEAD) :])


def _is_same_output(a: Any, b: Any) -> bool:
    return list(a[len(OUTPUT_HEAD) :]) == list(b[len(OUTPUT_HEAD) :])


def _told(pair: Pair, channel: Channel) -> FirstDifference:
    a, b = pair
    row: Row = a if a is not None else b if b is not None else (0.0,)
    if a is None or b is None:
        text = "only on record" if b is None else "only in the rerun"
    else:
        head = len(HEAD if channel.direction == "in" else OUTPUT_HEAD)
        text = f"{_shown(a, head)} on record, {_shown(b, head)} in the rerun"
        if list(a[head:]) == list(b[head:]):
            text = f"t = {a[0]} s and age {a[2]} us on record, {b[0]} s and {b[2]} us in the rerun"
    return FirstDifference(t_s=row[0], text=text)


def _shown(row: Row, head: int) -> str:
    return ", ".join(f"{value}"[:80] for value in row[head : head + 4])
