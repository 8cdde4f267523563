import pytest

from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.models.inventory import Machine
from cosmos_cli.models.limit import select_machines

TOWER = [
    Machine(
        name=f"pi{index:02d}",
        address=f"10.0.0.{index}",
        groups=("all", "tower", *(["chiefs"] if index in (1, 4) else [])),
        positions={"all": index - 1, "tower": 6 - index, "chiefs": index},
    )
    for index in range(1, 7)
]


def names(pattern, **options):
    return [machine.name for machine in select_machines(TOWER, pattern, **options)]


@pytest.mark.parametrize(
    ("pattern", "expected"),
    [
        ("pi03", "3"),
        ("pi06,pi02", "26"),
        ("tower:!chiefs", "2356"),
        ("!chiefs", "2356"),
        ("tower:&chiefs", "14"),
        ("~pi0[12]$", "12"),
        ("~^(pi03|chiefs)$", "134"),
        ("p?0*:!pi01", "23456"),
        (" pi01 , pi02 ", "12"),
    ],
)
def test_pattern_means_machines_in_the_order_of_the_inventory(pattern, expected):
    assert names(pattern) == [f"pi0{digit}" for digit in expected]


def test_places_in_a_group_are_counted_in_its_own_order():
    assert names("tower[0]") == ["pi06"]
    assert names("tower[-1]") == ["pi01"]
    assert names("tower[1:2]") == ["pi04", "pi05"]
    assert names("tower[4:]") == ["pi01", "pi02"]
    assert names("all[0]") == ["pi01"]


def test_group_without_machines_is_known_where_it_is_told():
    assert names("pi01:spare", groups=("spare",)) == ["pi01"]
    with pytest.raises(InputError, match="no machine or group is named spare"):
        names("pi01:spare")


@pytest.mark.parametrize(
    ("pattern", "told"),
    [
        ("twer", "--limit twer: no machine or group is named twer, did you mean tower?"),
        ("xyz", "no machine or group is named xyz; there are all, tower, chiefs, pi01, pi02"),
        ("a,twer,b", "no machine or group is named a; "),
        ("tower:!chief", "no machine or group is named chief, did you mean chiefs?"),
        ("x*", "no machine or group is like x*; there are all, tower"),
        ("~x", "no machine or group is like ~x; there are"),
        ("~(", "~(: not a regular expression"),
        (
            "~a{99999999999}",
            "~a{99999999999}: not a regular expression: the repetition number is too large",
        ),
        (
            "~" + "(" * 1500 + ")" * 1500,
            "not a regular expression: its brackets are nested too deeply",
        ),
        (
            "pi0[1:2]",
            "--limit pi0[1:2]: pi0[1:2] counts places in a group, and none is named pi0;"
            " for machines write pi01:pi02, or a glob such as pi0?",
        ),
        ("pi[01:06]", "for machines write pi01:pi02:...:pi06, or a glob such as pi??"),
        ("pi0[5:]", "for machines write pi05:pi06, or a glob such as pi0?"),
        ("pi0[3]", "for machines write pi03, or a glob such as pi0?"),
        (
            "pi0[-1]",
            "counts places in a group, and none is named pi0; there are all, tower, chiefs",
        ),
        ("twer[0:1]", "counts places in a group, and none is named twer, did you mean tower?"),
        ("tower[1-3]", "write tower[1:3] for places, ~tower[1-3] for names"),
        ("tower[9]", "tower[9]: tower has 6 machines"),
        ("tower[7:9]", "means no machine; there are pi01"),
        ("tower:!all", "means no machine; there are pi01"),
        ("pi01:&pi02", "means no machine"),
        ("tower[0", "a bracket is never closed, or was never opened"),
        ("@names.txt", "@names.txt: no such file"),
        ("", "expected a machine, a group or a pattern, got nothing"),
        (" : ", "got nothing"),
        ("tower:!", "expected a name after '!'"),
    ],
)
def test_pattern_that_means_nothing_is_bad_input(pattern, told):
    with pytest.raises(InputError) as caught:
        names(pattern)

    assert told in str(caught.value)
    assert caught.value.exit_code == ExitCode.BAD_INPUT


def test_every_unknown_name_is_told_at_once():
    with pytest.raises(InputError) as caught:
        names("twer,pi01,cheifs")

    assert "twer" in str(caught.value)
    assert "cheifs, did you mean chiefs?" in str(caught.value)
