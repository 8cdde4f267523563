import pytest
from constellation_fakes import FakeContext, parameters

from madns_runtime.errors import PluginError
from madns_runtime.simulations.constellation.host_side.job_table import JobTable


def make_table():
    return JobTable(FakeContext("host", ("agent-01",), parameters()))


def test_each_value_goes_to_the_owner_of_its_job():
    table, first, second = make_table(), [], []
    one = table.submit(first.append, max, 1, 2)
    other = table.submit(second.append, min, 1, 2)

    table.take(other, "b")
    table.take(one, "a")

    assert (first, second) == (["a"], ["b"])


def test_a_job_given_up_tells_nobody_and_one_that_is_done_cannot_be_given_up():
    table, taken = make_table(), []
    late, done = (table.submit(taken.append, max, 1, 2) for _ in range(2))
    table.take(done, "done")

    assert table.give_up(late)
    assert not table.give_up(done)
    table.take(late, "late")
    assert taken == ["done"]


def test_a_value_of_no_job_is_refused():
    table, taken = make_table(), []
    job = table.submit(taken.append, max, 1, 2)
    table.take(job, "once")

    with pytest.raises(PluginError, match=f"job {job} is not under way"):
        table.take(job, "twice")
