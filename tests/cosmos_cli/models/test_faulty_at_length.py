"""
Files with faults without end: the work grows as the file does, and a hundred faults are shown.

Work is counted in the interpreter's instructions, not timed.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from harness.nights import by_night

from cosmos_cli import app
from cosmos_cli.errors import FAULTS_SHOWN_MAX, Fault, InputError
from cosmos_cli.models.document import GUESSES_MAX, read_document
from cosmos_cli.models.inventory import Machine
from cosmos_cli.models.inventory.load import read_inventory
from cosmos_cli.models.limit import select_machines
from cosmos_cli.models.loading import load_scenario
from cosmos_cli.models.overrides import apply_overrides
from cosmos_cli.models.placement import PlacementRule, claim_agents
from cosmos_cli.models.yaml_source import YamlSource
from madns_runtime.simulations.constellation.check_vehicles import glob_faults
from madns_runtime.simulations.constellation.truth import omm_files
from madns_runtime.simulations.constellation.vehicles import fits

FEW, GROWTH = 300, 4
SLACK = 1.3
"""Beyond linear: dictionaries that grow, sorting."""

SCENARIO = "name: a\nsimulation: counter\nagents: {count: 1}\n"
INVENTORY = "all:\n  hosts: {a: {}}\n"


def lines(text: str, count: int, indent: int = 0) -> str:
    return "".join(f"{' ' * indent}{text.replace('#', str(n))}\n" for n in range(count))


SCENARIOS: dict[str, Callable[[int], str]] = {
    "unknown keys": lambda n: SCENARIO + lines("k#: 1", n),
    "unknown parameters": lambda n: f"{SCENARIO}parameters:\n{lines('k#: 1', n, 2)}",
    "unknown keys of one line": lambda n: SCENARIO.replace(
        "count: 1", "count: 1, " + ", ".join(f"k{i}: 1" for i in range(n))
    ),
    "duplicates": lambda n: SCENARIO + "x: 1\n" * n,
    "numbers without a value": lambda n: f"{SCENARIO}description:\n{lines('- .nan', n, 2)}",
    "wrong types": lambda n: f"{SCENARIO}requirements:\n{lines('- 1', n, 2)}",
    "names": lambda n: SCENARIO.replace("count: 1", f"count: 1, names: [{'b, ' * n}b]"),
    "taken over": lambda n: (
        f"x: &x\n{lines('k#: 1', n, 2)}y:\n  <<: *x\n{lines('k#: 2', n, 2)}{SCENARIO}"
    ),
    "taken over often": lambda n: (
        f"x: &x\n{lines('k#: 1', n, 2)}e: &e {{}}\ny:\n  <<: [*x{', *e' * n}]\n{SCENARIO}"
    ),
    "placement": lambda n: f"{SCENARIO}placement:\n{lines('- {agents: [x#]}', n, 2)}",
}
INVENTORIES: dict[str, Callable[[int], str]] = {
    "unknown keys": lambda n: INVENTORY + lines("k#: 1", n, 2),
    "unknown variables": lambda n: f"{INVENTORY}  vars:\n{lines('cosmos_k#: 1', n, 4)}",
    "readings": lambda n: f"{INVENTORY}  vars:\n{lines('k#: no', n, 4)}",
    "hosts": lambda n: f"all:\n  hosts:\n{lines(chr(34) + '-h#' + chr(34) + ': {}', n, 4)}",
    "one line": lambda n: (
        INVENTORY + "  vars: {" + ", ".join(f"cosmos_k{i}: no" for i in range(n)) + "}\n"
    ),
}


def instructions(work: Callable[[], Any]) -> int:
    """Return how many instructions the interpreter carried out."""
    count = 0

    def trace(frame: FrameType, event: str, _argument: object) -> Any:
        nonlocal count
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        count += event == "opcode"
        return trace

    earlier = sys.gettrace()
    sys.settrace(trace)
    try:
        work()
    finally:
        sys.settrace(earlier)
    return count


def refusal(load: Callable[[Path], Any], path: Path, text: str) -> InputError:
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load(path)
    return caught.value


def check_growth(load: Callable[[Path], Any], path: Path, make: Callable[[int], str]) -> None:
    refusal(load, path, make(1))  # what is made once for all is not counted
    few = instructions(lambda: refusal(load, path, make(FEW)))
    many = instructions(lambda: refusal(load, path, make(GROWTH * FEW)))

    assert many < SLACK * GROWTH * few, f"{few} instructions became {many}"


@pytest.mark.slow
@pytest.mark.parametrize("kind", by_night(SCENARIOS, day=[*SCENARIOS][2::3]))
def test_work_grows_as_a_faulty_scenario_does(tmp_path, kind):
    check_growth(load_scenario, tmp_path / "a.yaml", SCENARIOS[kind])


@pytest.mark.slow
@pytest.mark.parametrize("kind", by_night(INVENTORIES, day=[*INVENTORIES][::3]))
def test_work_grows_as_a_faulty_inventory_does(tmp_path, kind):
    check_growth(read_inventory, tmp_path / "a.yaml", INVENTORIES[kind])


@pytest.mark.parametrize(
    ("load", "make"),
    [
        (load_scenario, SCENARIOS["unknown keys"]),
        (load_scenario, SCENARIOS["duplicates"]),
        (read_inventory, INVENTORIES["unknown keys"]),
    ],
)
def test_a_hundred_faults_are_shown_and_the_others_counted(tmp_path, load, make):
    error = refusal(load, tmp_path / "a.yaml", make(1001))
    # The first of many equal keys is no duplicate.
    others = 1001 - FAULTS_SHOWN_MAX - (make is SCENARIOS["duplicates"])

    assert len(error.faults) == FAULTS_SHOWN_MAX
    assert str(error).endswith(f"\nand {others} more faults")
    assert str(error).count("\n    ^") + str(error).count("   ^") >= FAULTS_SHOWN_MAX


def check_linear(work: Callable[[int], Any]) -> None:
    work(1)
    few, many = (instructions(lambda n=n: work(n)) for n in (FEW, GROWTH * FEW))

    assert many < SLACK * GROWTH * few, f"{few} instructions became {many}"


def agents(count: int) -> list[str]:
    return [f"agent-{n:04d}" for n in range(count)]


def unknown(count: int) -> tuple[str, ...]:
    return tuple(f"x{n}" for n in range(count))


def machines(count: int) -> list[Machine]:
    return [Machine(name=name, address=name, groups=("all",)) for name in agents(count)]


def limited(count: int, pattern: Path) -> str:
    pattern.write_text("\n".join(unknown(count)))
    with pytest.raises(InputError) as caught:
        select_machines(machines(count), f"@{pattern}")
    return str(caught.value)


def claimed(count: int) -> None:
    rules = [PlacementRule(agents=(name,)) for name in unknown(count)]
    rules += [PlacementRule(agents=(name,)) for name in agents(count)[::2]]
    claims = claim_agents(agents(count), [*rules, *[PlacementRule(count=1)] * (count // 2)])

    assert (len(claims.faults), claims.left) == (count, ())


def described(count: int) -> None:
    """Tell which of as many names as there are agents fits each agent, and which fit none."""
    globs = (*unknown(count), *agents(count)[1:])
    pairs = [(name, f"S{name}") for name in agents(count)]

    assert len(glob_faults("f", globs, pairs)) == count
    assert [fits(globs, *pair) for pair in pairs] == [False] + [True] * (count - 1)


@pytest.mark.parametrize("work", [claimed, described], ids=["placement", "vehicles"])
def test_names_are_looked_up_and_not_matched_with_everybody(monkeypatch, work):
    monkeypatch.setattr("cosmos_cli.models.placement.did_you_mean", lambda word, known: "")

    check_linear(work)


def test_names_of_a_limit_are_looked_up_and_a_hundred_told(tmp_path, monkeypatch):
    monkeypatch.setattr("cosmos_cli.models.limit.did_you_mean", lambda word, known: "?")
    path = tmp_path / "names"

    check_linear(lambda count: limited(count, path))
    assert limited(4000, path).count("; ") == FAULTS_SHOWN_MAX
    assert limited(4000, path).endswith(f"; and {4000 - FAULTS_SHOWN_MAX} more")


def test_guesses_among_many_names_are_few(tmp_path, monkeypatch):
    compared = 0

    def guess(word: str, known: Sequence[str]) -> str:
        nonlocal compared
        compared += len(known)
        return "?"

    monkeypatch.setattr("cosmos_cli.models.placement.did_you_mean", guess)
    monkeypatch.setattr("cosmos_cli.models.limit.did_you_mean", guess)
    claim_agents(agents(3000), [PlacementRule(agents=unknown(3000))])
    limited(3000, tmp_path / "names")

    assert 2 * 3000 <= compared <= 2 * (GUESSES_MAX + 3001)


def test_fields_of_element_sets_that_come_twice_are_counted_once():
    compared = 0

    class Name(str):
        __slots__ = ()

        def __eq__(self, other: object) -> bool:
            nonlocal compared
            compared += 1
            return str.__eq__(self, other)

        __hash__ = str.__hash__

    assert omm_files._twice([Name(f"k{n % 1000}") for n in range(1500)]) == {
        f"k{n}" for n in range(500)
    }
    assert compared < 10 * 1500


@pytest.mark.slow
def test_a_hundred_thousand_unknown_keys_are_told_in_a_page(tmp_path, capsys):
    path = tmp_path / "a.yaml"
    path.write_text(SCENARIO + lines("k#: 1", 100_000))
    code = app.run(["validate", str(path), "--json"])
    told = json.loads(capsys.readouterr().out)["error"]

    assert code == 2
    assert len(told["faults"]) == FAULTS_SHOWN_MAX
    assert told["faults_omitted"] == 100_000 - FAULTS_SHOWN_MAX
    assert len(json.dumps(told)) < 100_000


def test_faults_of_two_files_are_counted_together(tmp_path):
    for name in ("a.yaml", "b.yaml"):
        (tmp_path / name).write_text(SCENARIO + lines("k#: 1", 150))
    with pytest.raises(InputError) as caught:
        _validate([tmp_path / "a.yaml", tmp_path / "b.yaml"])

    assert (len(caught.value.faults), caught.value.omitted) == (FAULTS_SHOWN_MAX, 200)


def _validate(paths: list[Path]) -> None:
    from cosmos_cli.commands.validate import validate

    validate(paths, None, json=False, quiet=True)


@pytest.mark.slow
def test_the_caret_stands_below_its_key_in_a_line_of_megabytes(tmp_path):
    keys = ", ".join(f"key{n}: 1" for n in range(100_000))
    error = refusal(load_scenario, tmp_path / "a.yaml", f"{SCENARIO}x: {{{keys}}}\nodd: 1\n")
    path = tmp_path / "b.yaml"
    far = refusal(
        load_scenario, path, f"name: a\nagents: {{count: 1}}\nsimulation: [{'a, ' * 100_000}.nan]\n"
    )
    shown = next(line for line in str(far).splitlines() if ".nan]" in line)
    caret = str(far).splitlines()[str(far).splitlines().index(shown) + 1]

    assert len(str(error)) < 2000
    assert shown[caret.index("^") :].startswith(".nan")


def test_a_fault_of_megabytes_is_told_in_few_words(tmp_path):
    error = refusal(load_scenario, tmp_path / "a.yaml", f"{SCENARIO}? {'k' * 2_000_000}\n: 1\n")

    assert "unknown key" in str(error)
    assert len(str(error)) < 5000
    assert Fault(text="short").render() == "short"


@pytest.mark.parametrize(
    "text",
    [
        "a0: &a0 [1]\n" + "".join(f"a{n}: &a{n} [*a{n - 1}]\n" for n in range(1, 3000)),
        "a0: &a0 {k0: 1}\n"
        + "".join(f"a{n}: &a{n}\n  <<: *a{n - 1}\n  k{n}: 1\n" for n in range(1, 3000)),
    ],
    ids=["values", "taken over"],
)
def test_aliases_that_nest_three_thousand_deep_are_a_fault(tmp_path, text):
    error = refusal(load_scenario, tmp_path / "a.yaml", text + SCENARIO)

    assert "expected at most 64 " in str(error)


def test_what_is_taken_over_gives_way_to_the_stronger(tmp_path):
    document = read_document(
        YamlSource.of(
            "a",
            "a: &a {x: 1, y: {z: 1}}\nb: &b {x: 2, w: 2}\n"
            "c:\n  <<: [*a, *b]\n  y: 3\nd: {<<: *b, <<: *a}\n",
        )
    )

    assert document.value["c"] == {"x": 1, "w": 2, "y": 3}
    assert ("c", "y", "z") not in document.value_places
    assert document.value_places[("c", "y")].line == 5
    assert document.value_places[("c", "w")].line == 2


def test_too_many_values_on_the_command_line_are_refused():
    document = read_document(YamlSource.of("a", SCENARIO))
    faults = apply_overrides(document, [f"k{n}=1" for n in range(2000)])

    assert [fault.text for fault in faults] == [
        "expected at most 1000 of --set, got 2000; write a file"
    ]
