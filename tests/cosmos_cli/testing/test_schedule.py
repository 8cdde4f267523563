"""Order of a suite: lockstep beside each other, real time alone."""

from suite_cases import make_case

from cosmos_cli.testing.schedule import SuiteSchedule


def names(cases):
    return [case.scenario_name for case in cases]


def test_lockstep_runs_beside_each_other_and_real_time_alone():
    cases = [
        make_case("r1", is_lockstep=False),
        make_case("l1", work=1),
        make_case("l2", work=3),
        make_case("r2", is_lockstep=False),
        make_case("l3", work=2),
    ]
    schedule = SuiteSchedule(cases, jobs=2)

    first, second = schedule.begin(), schedule.begin()
    assert names([first, second]) == ["l2", "l3"]  # the most work first
    assert schedule.begin() is None  # two jobs
    schedule.end(second)
    third = schedule.begin()
    assert names([third]) == ["l1"]
    schedule.end(first)
    assert schedule.begin() is None  # one in lockstep still runs
    schedule.end(third)
    fourth = schedule.begin()
    assert names([fourth]) == ["r1"]
    assert schedule.begin() is None  # real time is alone
    schedule.end(fourth)
    fifth = schedule.begin()
    assert names([fifth]) == ["r2"]
    assert not schedule.is_done
    schedule.end(fifth)
    assert schedule.is_done
