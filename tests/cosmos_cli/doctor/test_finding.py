"""One finding of many machines is one line."""

from __future__ import annotations

from cosmos_cli.doctor.finding import HERE, CheckRemark, Finding, Severity, grouped


def finding(machine: str, check: str = "governor", **remark: object) -> Finding:
    values = {"level": Severity.WARNING, "found": "slow", "cure": "faster"} | remark
    return Finding(machine=machine, check=check, remark=CheckRemark(**values))  # type: ignore[arg-type]


def test_same_finding_of_many_machines_is_one_group() -> None:
    (group,) = grouped([finding(f"pi{n:02d}") for n in range(1, 25)])

    assert (group.names, group.found, group.cure) == ("pi[01:24]", "slow", "faster")


def test_this_computer_comes_first() -> None:
    (group,) = grouped([finding("aa"), finding(HERE), finding("bb")])

    assert group.names == f"{HERE}, aa, bb"


def test_figures_become_a_range() -> None:
    (group,) = grouped(
        [finding("a", figure=71.23, unit="°C"), finding("b", figure=78.0, unit="°C")]
    )

    assert group.found == "slow: 71.2 to 78 °C"


def test_equal_figures_are_told_once() -> None:
    (group,) = grouped([finding("a", figure=0.0), finding("b", figure=0.0)])

    assert group.found == "slow: 0"


def test_details_are_told_with_their_machine() -> None:
    (group,) = grouped([finding("a", detail="apt"), finding("b", detail="cron")])

    assert group.found == "slow (a: apt; b: cron)"


def test_equal_details_are_told_once() -> None:
    (group,) = grouped([finding("a", detail="apt"), finding("b", detail="apt")])

    assert group.found == "slow (apt)"


def test_many_details_are_cut() -> None:
    (group,) = grouped([finding(f"pi{n}", detail=str(n)) for n in range(9)])

    assert group.found == "slow (pi0: 0; pi1: 1; pi2: 2; ...)"


def test_details_of_what_is_well_are_left_out() -> None:
    (group,) = grouped([finding(n, level=Severity.OK, detail=n) for n in "ab"])

    assert group.found == "slow"


def test_worst_comes_first() -> None:
    groups = grouped(
        [
            finding("a", "one", level=Severity.OK),
            finding("a", "two", level=Severity.ERROR),
            finding("a", "three", level=Severity.NOTE),
            finding("a", "four", level=Severity.WARNING),
            finding("a", "five", level=Severity.ERROR),
        ]
    )

    assert [group.check for group in groups] == ["two", "five", "four", "three", "one"]


def test_json_tells_each_machine_its_own() -> None:
    assert finding("a", figure=71.23, unit="°C", detail="x").to_mapping() == {
        "check": "governor",
        "level": "warning",
        "found": "slow: 71.2 °C (x)",
        "figure": 71.23,
        "unit": "°C",
        "cure": "faster",
    }
