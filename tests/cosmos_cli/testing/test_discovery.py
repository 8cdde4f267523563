"""Scenarios in files and folders, and the tests that are made of those that are meant."""

import errno
import os
import time

import pytest
from harness.nested_folders import nested_folders

from cosmos_cli.errors import InputError
from cosmos_cli.models.loading import load_scenario
from cosmos_cli.testing.case import CaseSettings
from cosmos_cli.testing.discovery import choose_cases, find_scenarios
from cosmos_cli.testing.expression import parse_expression
from cosmos_cli.testing.terminal import collected_line

SCENARIO = """\
name: {name}
simulation: counter
agents: {{count: 2, tick_hz: 10}}
time: {{duration_s: 600, mode: {mode}}}
test: {{set: {{time.duration_s: 5}}, tags: [{tag}]}}
"""


@pytest.fixture
def folder(tmp_path):
    for place, name, mode, tag in (
        ("a.yaml", "alpha", "realtime", "quick"),
        ("deep/b.yml", "beta", "lockstep", "quick"),
        ("deep/c.yaml", "gamma", "lockstep", "long"),
        (".hidden/d.yaml", "delta", "lockstep", "quick"),
    ):
        path = tmp_path / place
        path.parent.mkdir(exist_ok=True)
        path.write_text(SCENARIO.format(name=name, mode=mode, tag=tag))
    (tmp_path / "inventory.yaml").write_text("all: {hosts: {pi01: {}}}\n")
    (tmp_path / "list.yaml").write_text("[1, 2]\n")
    (tmp_path / "template.yml").write_text("{{ of: another program }}: [\n")
    (tmp_path / "notes.txt").write_text("name: x\nsimulation: y\n")
    (tmp_path / "deep/loop").symlink_to(tmp_path)
    return tmp_path


def chosen(found, expression="", seeds=(None,), **settings):
    return choose_cases(
        found,
        CaseSettings(**settings),
        seeds_of=lambda path: seeds,
        is_meant=parse_expression(expression) if expression else lambda names: True,
        warn=print,
    )


def test_a_folders_scenarios_are_found_and_what_is_none_is_counted(folder):
    found = find_scenarios([folder])

    assert [outline.name for outline in found.outlines] == ["alpha", "beta", "gamma"]
    assert [path.name for path in found.others] == ["inventory.yaml", "list.yaml", "template.yml"]
    assert found.faults == []


BROKEN = "name: f\nsimulation: counter\nagents: {count: 2}\nagents: {count: 3}\n"
"""A scenario with a duplicate key."""


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"\xef\xbb\xbf" + BROKEN.partition("\n")[2].encode(), "duplicate key"),
        (BROKEN.replace("simulation", '"simulation"').encode(), "duplicate key"),
        (b"{name: f, simulation: counter, agents: {count: 2}, agents: {}}\n", "duplicate key"),
        (b"--- {name: f, 'extends': a.yaml, name: g}\n", "duplicate key"),
        ("".join(f"  {line}\n" for line in BROKEN.splitlines()).encode(), "duplicate key"),
        (BROKEN.replace("\n", "\r").encode(), "duplicate key"),
        (BROKEN.encode("utf-16"), "got UTF-16"),
        (BROKEN.encode("utf-16-le"), "got binary data"),
        (BROKEN.replace("simulation:", "  simulation:").encode(), ""),
        (BROKEN.replace("simulation:", "simulaton:").encode(), "duplicate key"),
        (b"name: f\nsimulaton: counter\nagents: {count: 2}\n", "did you mean simulation"),
        (b"nmae: f\nsimulation: counter\nagents: {count: 2}\n", "did you mean name"),
        (b"name: f\nagents: {names: [a]}\n", "simulation: "),
    ],
)
def test_a_broken_scenario_of_a_folder_is_at_fault_however_it_is_written(folder, content, told):
    """It was judged as long as it was right: dropping it would end a suite well that it should end with 2."""
    (folder / "broken.yaml").write_bytes(content)

    with pytest.raises(InputError) as caught:
        chosen(find_scenarios([folder]))
    with pytest.raises(InputError) as validated:
        load_scenario(folder / "broken.yaml", [], warn=print)
    assert caught.value.faults == validated.value.faults
    assert any(told in f"{fault.path}: {fault.text}" for fault in caught.value.faults)


@pytest.mark.parametrize(
    "content",
    [
        "name: ci\non: push\njobs: {a: {runs-on: x}}\n",
        "name: app\nservices:\n  a:\n    extends: b\n",
        "name: app\nservices:\n  a:\n    extends: b\n    extends: c\n",
        "name: build\nagents: {queue: x}\nsteps: []\n",
        "simulation: counter\nagents: {count: 2}\n",
        "figures: {a: {path: seed}}\nfigures: {}\n",
    ],
)
def test_files_of_other_programs_are_left_out(folder, content):
    (folder / "other.yaml").write_text(content)
    found = find_scenarios([folder])

    assert found.faults == []
    assert folder / "other.yaml" in found.others
    assert str(folder / "other.yaml") in chosen(found).left_out


def test_a_file_of_very_many_blank_lines_is_looked_through_at_once(folder):
    (folder / "other.yaml").write_text("{ a: [\n" + "\n" * 40_000 + "x")
    began_s = time.process_time()

    found = find_scenarios([folder])

    assert folder / "other.yaml" in found.others
    # It took more than a minute while each line was looked at from each one before it.
    assert time.process_time() - began_s < 10


BASE = "name: base\nagents: {count: 2, tick_hz: 10}\ntime: {duration_s: 5, mode: lockstep}\n"


def test_a_named_base_without_a_simulation_is_no_test_of_a_folder(folder):
    (folder / "base.yaml").write_text(BASE)
    (folder / "middle.yaml").write_text("extends: base.yaml\nname: middle\n")
    (folder / "zeta.yaml").write_text("extends: middle.yaml\nname: zeta\nsimulation: counter\n")

    found = find_scenarios([folder])

    assert len(chosen(found).cases) == 4
    assert {outline.name for outline in found.outlines} == {"alpha", "beta", "gamma", "zeta"}
    assert {folder / "base.yaml", folder / "middle.yaml"} <= set(found.others)


@pytest.mark.parametrize("is_extended", [True, False])
def test_a_base_that_is_named_or_of_nothing_that_runs_is_at_fault(folder, is_extended):
    (folder / "base.yaml").write_text(BASE)
    if is_extended:
        (folder / "zeta.yaml").write_text("extends: base.yaml\nsimulation: counter\n")
    paths = [folder, folder / "base.yaml"] if is_extended else [folder]

    with pytest.raises(InputError, match="simulation"):
        chosen(find_scenarios(paths))


def test_links_to_folders_are_told_as_left_out(folder):
    found = find_scenarios([folder])

    assert found.links == [folder / "deep/loop"]
    assert chosen(found).left_out[-1] == str(folder / "deep/loop")
    assert "3 YAML files not of scenarios / 1 link to folders not followed (3 scenarios)" in (
        collected_line(3, found, deselected=0)
    )


def test_a_link_to_itself_is_no_scenario(folder):
    before = find_scenarios([folder])
    (folder / "loop.yaml").symlink_to("loop.yaml")
    found = find_scenarios([folder])

    assert found.outlines == before.outlines


def test_the_copies_that_runs_keep_and_installed_packages_are_no_tests(folder):
    for place in ("runs/0001-a", "runs/tests/0002-a", "venv"):
        copy = folder / place / "flown/a.yaml"
        copy.parent.mkdir(parents=True)
        copy.write_text(SCENARIO.format(name="copy", mode="lockstep", tag="quick"))
        (folder / place / ("pyvenv.cfg" if place == "venv" else "plan.json")).touch()
    names = [outline.name for outline in find_scenarios([folder]).outlines]
    named = find_scenarios([folder / "runs/0001-a/flown"]).outlines

    assert names == ["alpha", "beta", "gamma"]
    assert [outline.name for outline in named] == ["copy"]


def test_a_scenario_that_extends_another_has_what_that_says_and_its_own_test(folder):
    (folder / "base.yaml").write_text(
        "simulation: counter\nvars: {s: 7}\nagents: {count: 2, tick_hz: 10}\n"
    )
    (folder / "top.yaml").write_text(
        "extends: base.yaml\nname: top\ntest: {set: {time.duration_s: '${s}'}, tags: [top]}\n"
    )
    found = find_scenarios([folder])
    (case,) = chosen(found, "top").cases

    assert "base.yaml" in [path.name for path in found.others]
    assert case.work == 2 * 10 * 7


def test_a_scenario_that_is_meant_twice_is_one_test(folder):
    found = find_scenarios([folder / "a.yaml", folder, folder / "deep"])

    assert [outline.name for outline in found.outlines] == ["alpha", "beta", "gamma"]


def test_scenarios_lie_in_the_folder_of_that_name_or_here(folder, monkeypatch):
    monkeypatch.chdir(folder)
    assert len(find_scenarios([]).outlines) == 3
    (folder / "scenarios").mkdir()
    assert find_scenarios([]).outlines == []


def test_folders_that_nest_too_deeply_are_told(folder):
    with (
        nested_folders(folder, "a", 1200),
        pytest.raises(InputError, match=f"{folder}: folders nest too deeply there"),
    ):
        find_scenarios([folder])


def test_a_folder_that_may_not_be_read_is_told(folder, monkeypatch):
    """Its tests would be left out of a suite that passes."""
    scandir = os.scandir

    def denied(path):
        if os.fspath(path) == str(folder / "deep"):
            raise PermissionError(errno.EACCES, "Permission denied", os.fspath(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", denied)

    with pytest.raises(InputError, match="deep: cannot be read: Permission denied"):
        find_scenarios([folder])


def test_missing_paths_are_told_together(folder):
    with pytest.raises(InputError, match=r"x.yaml, .*y: no such file or folder"):
        find_scenarios([folder, folder / "x.yaml", folder / "y"])


def test_every_fault_of_every_scenario_that_is_meant_comes_at_once(folder):
    (folder / "bad1.yaml").write_text("name: e\nsimulation: counter\nagents: [\n")
    (folder / "bad2.yaml").write_text("name: f\nsimulation: counter\nagents: {count: 0}\n")
    (folder / "bad3.yaml").write_text("name: g\nsimulation: counter\ntest: {tags: x}\n")
    (folder / "bad4.yaml").write_text(SCENARIO.format(name="h", mode="sideways", tag="quick"))

    with pytest.raises(InputError) as caught:
        chosen(find_scenarios([folder]))
    files = {fault.file.rpartition("/")[2] for fault in caught.value.faults}
    assert files == {"bad1.yaml", "bad2.yaml", "bad3.yaml", "bad4.yaml"}


def test_tests_are_chosen_by_name_file_and_tag(folder):
    found = find_scenarios([folder])

    def names(expression):
        picked = chosen(found, expression)
        assert len(picked.cases) + picked.deselected == 3
        return [case.scenario_name for case in picked.cases]

    assert names("quick") == ["alpha", "beta"]
    assert names("quick and not alpha") == ["beta"]
    assert names("c.yaml or ALPHA") == ["alpha", "gamma"]
    assert names("nothing") == []


def test_faults_of_scenarios_that_are_not_meant_do_not_matter(folder):
    (folder / "bad.yaml").write_text(SCENARIO.format(name="h", mode="sideways", tag="broken"))

    assert len(chosen(find_scenarios([folder]), "quick").cases) == 2


def test_each_seed_is_a_test_with_its_own_settings(folder):
    cases = chosen(find_scenarios([folder / "a.yaml"]), "seed=3 or seed=1", seeds=(1, 2, 3)).cases

    assert [case.name.rpartition("/")[2] for case in cases] == ["a.yaml[seed=1]", "a.yaml[seed=3]"]
    many = chosen(find_scenarios([folder / "a.yaml"]), "a.yaml[seed=1]", seeds=(1, 10, 21)).cases
    assert [case.seed for case in many] == [1]
    assert cases[1].arguments()[1:] == ["--set", "time.duration_s=5", "--set", "seed=3"]


def test_file_called_like_an_option_is_given_to_its_run_as_a_file(folder, monkeypatch):
    monkeypatch.chdir(folder)
    (folder / "a.yaml").rename(folder / "--runs.yaml")

    (case,) = chosen(find_scenarios([]), "alpha").cases

    assert case.name == "--runs.yaml"
    assert case.arguments()[0] == "./--runs.yaml"
    assert case.repeat_command.startswith("cosmos run ./--runs.yaml ")


def test_at_full_length_nothing_is_shortened_but_real_time(folder):
    settings = {"is_shortened": False, "realtime_s_max": 60.0}
    alpha, beta, _ = chosen(find_scenarios([folder]), **settings).cases

    assert alpha.overrides == ("time.duration_s=60.0",)
    assert beta.overrides == ()
    assert beta.deadline_s > 600  # from its length


def test_what_a_cut_leaves_no_room_for_is_told_as_the_cuts(folder):
    path = folder / "late.yaml"
    path.write_text(
        (folder / "a.yaml").read_text() + "timeline: [{at_s: 500, action: annotate, text: x}]\n"
    )

    with pytest.raises(InputError, match="as --realtime-max 60 cuts it; -k leaves it out"):
        chosen(find_scenarios([path]), is_shortened=False, realtime_s_max=60.0)


def test_a_deadline_is_the_tests_own_or_follows_from_its_length(folder):
    path = folder / "a.yaml"
    (shorter,) = chosen(find_scenarios([path])).cases
    (longer,) = chosen(find_scenarios([path]), overrides=("time.duration_s=1000",)).cases
    path.write_text(path.read_text().replace("set:", "deadline_s: 33, set:"))
    (own,) = chosen(find_scenarios([path])).cases

    assert longer.deadline_s - shorter.deadline_s == pytest.approx(995 * 1.5)
    assert own.deadline_s == 33
