"""A scenario that extends others: what results, from which folder its files are found, and what is refused where."""

import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.models.extending import FILES_MAX, read_scenario_source
from cosmos_cli.models.loading import load_scenario

BASE = """\
name: base
simulation: counter
agents: {count: 3, tick_hz: 20}
time: {duration_s: 60}
placement:
  - {agents: [agent-01], machines: pi00}
parameters: {payload_bytes: 8, service: best}
"""


@pytest.fixture
def write(tmp_path):
    def write(**texts):
        for name, text in texts.items():
            path = tmp_path / (name.replace("__", "/") + ".yaml")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return tmp_path

    return write


def refusal(path, *overrides):
    with pytest.raises(InputError) as caught:
        load_scenario(path, overrides)
    return str(caught.value).replace(f"{path.parent}/", "")


def test_mappings_merge_and_lists_and_scalars_replace(write):
    folder = write(
        base=BASE,
        a="extends: base.yaml\nname: a\nagents: {tick_hz: 5}\nplacement: []\nparameters: {service: sync}\n",
    )

    found = load_scenario(folder / "a.yaml")

    assert (found.scenario.name, found.scenario.agents.count) == ("a", 3)
    assert (found.scenario.agents.tick_hz, found.scenario.time.duration_s) == (5, 60)
    assert found.scenario.placement == ()
    assert (found.parameters["payload_bytes"], found.parameters["service"]) == (8, "sync")
    assert found.files == (str(folder / "a.yaml"), str(folder / "base.yaml"))


def test_a_mapping_of_another_kind_replaces_that_of_the_base(write):
    truth = "parameters:\n  propagator: {kind: NAME}\n"
    folder = write(
        base="vars: {}\nparameters:\n  propagator: {kind: sgp4, extra: 1}\n",
        same="extends: base.yaml\nparameters:\n  propagator: {kind: sgp4, more: 2}\n",
        other="extends: base.yaml\n" + truth.replace("NAME", "two_body"),
    )
    same, other = (read_scenario_source(folder / f"{n}.yaml") for n in ("same", "other"))

    assert same.document.value["parameters"]["propagator"] == {
        "kind": "sgp4",
        "extra": 1,
        "more": 2,
    }
    assert other.document.value["parameters"]["propagator"] == {"kind": "two_body"}


def test_set_applies_to_what_results(write):
    folder = write(base=BASE, a="extends: base.yaml\n")

    found = load_scenario(folder / "a.yaml", ["agents.count=7", "name=b"])

    assert (found.scenario.agents.count, found.scenario.name) == (7, "b")


def test_a_chain_is_read_to_its_end_the_nearer_file_stronger(write):
    folder = write(
        base=BASE,
        middle="extends: base.yaml\nname: middle\nseed: 3\ntime: {duration_s: 5}\n",
        a="extends: middle.yaml\nname: a\n",
    )

    scenario = load_scenario(folder / "a.yaml").scenario

    assert (scenario.name, scenario.seed, scenario.time.duration_s) == ("a", 3, 5)


def test_relative_files_are_found_from_the_root_whichever_file_names_them(write):
    folder = write(base=BASE, in__a="extends: ../base.yaml\nroot: ..\nname: a\n")

    found = load_scenario(folder / "in/a.yaml")

    assert found.base_directory == folder.resolve()
    assert found.run_config("0001-a").base_directory == str(folder.resolve())
    assert load_scenario(folder / "base.yaml").base_directory == folder.resolve()


def test_a_root_that_only_the_base_names_is_taken_from_where_the_base_lies(write):
    folder = write(
        base=BASE, in__middle="extends: ../base.yaml\nroot: ..\n", in__a="extends: middle.yaml\n"
    )

    assert load_scenario(folder / "in/a.yaml").base_directory == folder.resolve()


def test_fault_in_a_base_names_that_file_and_stands_behind_those_of_the_scenario(write):
    folder = write(
        base=BASE.replace("count: 3", "count: 0").replace("60", "-1"),
        a="extends: base.yaml\nname: A\n",
    )

    assert refusal(folder / "a.yaml") == (
        "a.yaml:2:7: name: expected lower-case letters, digits and hyphens, got 'A'\n"
        "    name: A\n"
        "          ^\n"
        "base.yaml:3:17: agents.count: expected >= 1, got 0\n"
        "    agents: {count: 0, tick_hz: 20}\n"
        "                    ^\n"
        "base.yaml:4:20: time.duration_s: expected > 0, got -1\n"
        "    time: {duration_s: -1}\n"
        "                       ^"
    )


def test_fault_of_the_simulation_names_the_file_where_the_parameter_stands(write):
    folder = write(
        base=BASE.replace("payload_bytes: 8", "payload_byte: 8"), a="extends: base.yaml\n"
    )

    assert (
        "base.yaml:7:14: parameters.payload_byte: unknown key, did you mean payload_bytes?"
        in refusal(folder / "a.yaml")
    )


@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        ({"a": "extends: a.yaml\n"}, "a.yaml:1:10: extends: expected a chain that ends, got a.yaml -> a.yaml"),
        (
            {"a": "extends: b.yaml\n", "b": "extends: in/c.yaml\n", "in__c": "extends: ../b.yaml\n"},
            "in/c.yaml:1:10: extends: expected a chain that ends, got b.yaml -> in/c.yaml -> b.yaml",
        ),
        ({"a": "extends: bse.yaml\n", "base": BASE}, "a.yaml:1:10: extends: bse.yaml: no such file, did you mean base.yaml?"),
        ({"a": "extends: in\n", "in__b": BASE}, "a.yaml:1:10: extends: in: "),
        ({"a": "extends: base.yaml\n", "base": "a: [\n"}, "base.yaml:2:1: expected a value, or the bracket"),
        ({"a": "extends: base.yaml\n", "base": ""}, "a.yaml:1:10: extends: base.yaml: expected a mapping, got an empty file"),
        ({"a": "extends: [base.yaml]\n"}, "a.yaml:1:10: extends: expected the path of a file, got a list"),
        ({"a": "extends:\n"}, "a.yaml:1:9: extends: expected the path of a file, got nothing"),
        ({"a": "vars: {b: base}\nextends: ${b}.yaml\n"}, "a.yaml:2:10: extends: expected a file's name, got '${b}.yaml'"),
        ({"a": "extends: /tmp/base.yaml\n"}, "a.yaml:1:10: extends: expected the path of a scenario from this file's folder"),
        ({"a": "root: up\n"}, "a.yaml:1:7: root: expected ., .., ../..: this file's folder, or one of the two above it; got 'up'"),
        ({"a": "root: ../../..\n"}, "a.yaml:1:7: root: expected ., .., ../.."),
        ({"a": "root: 3\n"}, "a.yaml:1:7: root: expected ., .., ../.., got 3"),
        (
            {"a": "extends: in/b.yaml\n", "in__b": "root: .\n"},
            "in/b.yaml:1:7: root: expected the folder of a.yaml or one of the two above it",
        ),
    ],
)  # fmt: skip
def test_a_chain_that_cannot_be_is_refused_with_its_place(write, texts, expected):
    folder = write(**texts)

    assert expected in refusal(folder / "a.yaml")


def test_a_base_outside_of_the_root_is_refused_with_the_cure(write):
    folder = write(
        base=BASE,
        in__a="extends: ../base.yaml\n",
        in__deep__b="extends: ../../base.yaml\nroot: ..\n",
    )

    assert (
        "a.yaml:1:10: extends: " in (told := refusal(folder / "in/a.yaml"))
        and "lies outside of" in told
        and "say root: .. in a.yaml" in told
    )
    assert "say root: ../.. in b.yaml" in refusal(folder / "in/deep/b.yaml")


def test_a_link_that_leads_out_of_the_root_is_outside(write, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "base.yaml"
    elsewhere.write_text(BASE)
    folder = write(a="extends: base.yaml\n")
    (folder / "base.yaml").symlink_to(elsewhere)

    assert "lies outside of" in refusal(folder / "a.yaml")


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("loop.yaml", "loop.yaml: cannot be read: Too many levels of symbolic links"),
        ("extends.yaml", "extends: loop.yaml: cannot be read: Too many levels"),
        pytest.param(
            "plugin.yaml", "loop.py: cannot be read: Too many levels", marks=pytest.mark.process
        ),
    ],
)
def test_a_link_to_itself_is_told_as_a_file_that_cannot_be_read(write, name, told):
    folder = write(
        extends="extends: loop.yaml\n",
        plugin="name: a\nsimulation: ./loop.py:simulation\nagents: {count: 1}\n",
    )
    for loop in ("loop.yaml", "loop.py"):
        (folder / loop).symlink_to(loop)

    assert told in refusal(folder / name)


def test_a_chain_has_a_bound(write):
    chain = {f"c{n}": f"extends: c{n + 1}.yaml\n" for n in range(FILES_MAX)}
    folder = write(**chain, **{f"c{FILES_MAX}": BASE})

    assert f"expected at most {FILES_MAX} files" in refusal(folder / "c0.yaml")
    assert load_scenario(folder / "c1.yaml").scenario.name == "base"


@pytest.mark.parametrize("key", ["root", "extends"])
def test_set_cannot_say_what_is_read(write, key):
    folder = write(a=BASE)

    assert f"--set {key}: expected in the file alone" in refusal(folder / "a.yaml", f"{key}=..")
