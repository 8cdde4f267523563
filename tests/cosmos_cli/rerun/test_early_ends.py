"""What a rerun has of agents after their last ticks on record is not compared, and told."""

from cosmos_cli.diff.fields import RecordPlace
from cosmos_cli.diff.stream import Alone, StreamDifference
from cosmos_cli.rerun.early_ends import early_ends, leave_out_after_ends
from cosmos_cli.rerun.recorded_run import RecordedAgent

HZ = 10.0


def stream(source, *, by="tick", first, count=1):
    place = RecordPlace(first)
    return StreamDifference(
        table="state",
        source=source,
        by=by,
        rows_a=34,
        rows_b=34 + count,
        only_b=Alone(count=count, first=place, last=place),
    )


def test_agents_that_ended_before_the_last_one_are_known_with_their_times():
    agents = {name: RecordedAgent(ticks=None, last_s=s) for name, s in (("a", 3.4), ("b", 3.3))}

    assert early_ends(agents) == {"b": 3.3}


def test_what_comes_after_an_agents_end_is_left_out_and_told_and_nothing_else():
    after, earlier = stream("b", first=34), stream("b", first=33)
    timed, other = stream("b", by="time", first=3.4, count=2), stream("a", first=34)

    remarks = leave_out_after_ends([after, earlier, timed, other], {"b": 3.3}, HZ)

    assert (after.only_b.count, after.rows_b, after.has_same_values) == (0, 34, True)
    assert timed.only_b.count == 0
    assert (earlier.only_b.count, other.only_b.count) == (1, 1)
    assert remarks == (
        "b ended with the tick of 3.3 s: 3 records of the rerun after that are not compared",
    )


def test_remarks_name_few_of_many_agents():
    names = [f"agent-{number:02d}" for number in range(1, 41)]

    remarks = leave_out_after_ends(
        [stream(name, first=34) for name in names], dict.fromkeys(names, 3.3), HZ
    )

    assert len(remarks) == 6
    assert remarks[-1] == "35 more agents ended before the last one did, likewise"
