"""Every command, option and variable of the environment that the guides name exists, and every benchmark's."""

import ast
import re

import pytest
from guides import GUIDES, ROOT, benchmark_commands, commands, spans
from tower.faults import FAULTS

from cosmos_cli.commands.command_group import COMMANDS, each_command

ENVIRONMENT = re.compile(r"\bCOSMOS_[A-Z_]+")
OTHERS_OPTIONS = {"--privileged"}
"""Options of other programs that the guides name by themselves."""


@pytest.fixture(scope="module")
def options():
    """The options of each command, long and short."""
    found = {}
    for verb, command in each_command():
        parameters = command.params
        names = [name for each in parameters for name in (*each.opts, *each.secondary_opts)]
        found[verb] = {name for name in names if name.startswith("-")} | {"--help"}
    return found


def unknown(words, options):
    """Return what is wrong with one command."""
    verb, given = words[1], words[2:]
    if f"{verb} {' '.join(given[:1])}" in options:
        verb, given = f"{verb} {given[0]}", given[1:]
    elif any(one.startswith(f"{verb} ") for one in options) and not given:
        return []
    if verb not in options:
        return [verb]
    given = given[: given.index("--")] if "--" in given else given
    named = [re.split(r"[=\[|]", word)[0] for word in given if re.match(r"-{1,2}[a-z]", word)]
    return [name for name in named if name not in options[verb]]


@pytest.mark.parametrize("guide", GUIDES, ids=lambda path: path.name)
def test_every_command_and_option_of_a_guide_exists(guide, options):
    text = guide.read_text("utf-8")

    assert {" ".join(w): unknown(w, options) for w in commands(text) if unknown(w, options)} == {}


@pytest.mark.parametrize("guide", GUIDES, ids=lambda path: path.name)
def test_every_option_that_a_guide_names_alone_exists(guide, options):
    known = set().union(*options.values()) | OTHERS_OPTIONS
    alone = [re.split(r"[ =]", span)[0] for span in spans(guide.read_text("utf-8"))]

    assert {name for name in alone if name.startswith("--") and name not in known} - {"--"} == set()


def test_what_does_not_exist_is_found(options):
    text = (
        "`cosmos rnu x` and `cosmos run --fast x`\n\n    cosmos up -i a.yaml --diff  # --comment\n"
    )

    assert [unknown(words, options) for words in commands(text)] == [[], ["rnu"], ["--fast"]]


def test_guides_are_read_as_they_are_written():
    """A change of their form must not leave nothing to look at."""
    named = {words[1] for path in GUIDES for words in commands(path.read_text("utf-8"))}

    assert set(COMMANDS) - named == set()


def test_readme_table_has_every_command():
    readme = GUIDES[0].read_text("utf-8")
    table = readme.split("\n## Commands\n", 1)[1].split("\n## ", 1)[0]

    assert {verb for verb in COMMANDS if f"cosmos {verb}" not in table} == set()


@pytest.mark.parametrize("guide", GUIDES, ids=lambda path: path.name)
def test_every_option_of_a_benchmark_that_a_guide_gives_exists(guide):
    named = benchmark_commands(guide.read_text("utf-8"))

    assert {" ".join(words): wrong for words in named if (wrong := wrong_options(words))} == {}


def wrong_options(words):
    """Return what a command gives a benchmark that its parser does not know."""
    script, given = ROOT / words[1], words[2:]
    if not script.is_file():
        return [words[1]]
    known = {
        argument.value
        for call in ast.walk(ast.parse(script.read_text("utf-8")))
        if isinstance(call, ast.Call) and getattr(call.func, "attr", "") == "add_argument"
        for argument in call.args
        if isinstance(argument, ast.Constant)
    }
    return [word for word in given if word.startswith("-") and word.split("=")[0] not in known]


def test_what_a_benchmark_does_not_know_is_found():
    text = (
        "`python benchmarks/star.py --pair 2` or `python\nbenchmarks/star.py --pairs=2`\n\n"
        "    python benchmarks/stra.py  # --all\n"
    )

    found = [wrong_options(words) for words in benchmark_commands(text)]
    assert found == [["benchmarks/stra.py"], ["--pair"], []]


def test_benchmarks_of_guides_are_read_as_they_are_written():
    texts = [path.read_text("utf-8") for path in GUIDES]
    named = [words for text in texts for words in benchmark_commands(text)]
    mentioned = sum(len(re.findall(r"python\s+benchmarks/", text)) for text in texts)

    assert len(named) == mentioned > 20


def test_every_variable_of_the_environment_exists():
    sources = [*ROOT.glob("cosmos_cli/**/*.py"), *ROOT.glob("madns_runtime/**/*.py")]
    sources += ROOT.glob("tests/tower/*.py")
    known = {name for path in sources for name in ENVIRONMENT.findall(path.read_text("utf-8"))}
    named = {name for path in GUIDES for name in ENVIRONMENT.findall(path.read_text("utf-8"))}

    assert named
    assert named - known == set()


def test_every_fault_of_the_tower_that_a_guide_names_exists():
    texts = "".join(path.read_text("utf-8") for path in GUIDES)
    named = set(re.findall(r"fault pi\d+ ([a-z-]+)", texts))

    assert named
    assert named - set(FAULTS) == set()
